"""Model files for a running session: read in a process of their own, and told of when they are wrong by a lot."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest

from palpate.model_file import ModelFileError, ReducedModel, SurfaceModel, load_model, save_model
from palpate_server.recording.snapshot import identity
from palpate_server.session.loading import accuracy_warnings
from palpate_server.session.model_process import load_model_elsewhere


@pytest.fixture
def model_file(make_spring_mass_model: Callable[..., ReducedModel], tmp_path: Path) -> Path:
    save_model(make_spring_mass_model(2, 5), tmp_path / "model.npz")
    return tmp_path / "model.npz"


def test_a_model_read_elsewhere_is_the_same(model_file: Path) -> None:
    here, elsewhere = load_model(model_file), load_model_elsewhere(model_file, threading.Event())
    assert elsewhere.summary() == here.summary()
    for part in ("continuous", "discrete", "full", "surface"):
        for field in fields(getattr(here, part)):
            expected = getattr(getattr(here, part), field.name)
            np.testing.assert_array_equal(getattr(getattr(elsewhere, part), field.name), expected)


def test_a_model_read_elsewhere_is_as_stiff_as_asked_for(
    make_surface_model: Callable[..., SurfaceModel], model_file: Path, tmp_path: Path
) -> None:
    model, path = make_surface_model(), tmp_path / "surface.npz"
    save_model(model, path)
    read = load_model_elsewhere(path, threading.Event(), 2.5)
    assert isinstance(read, SurfaceModel)
    np.testing.assert_array_equal(read.residual, model.residual / np.float32(2.5))
    np.testing.assert_array_equal(read.squared_frequencies, model.squared_frequencies * 2.5)
    assert identity(read) == identity(model) | {"stiffness_factor": 2.5}
    with pytest.raises(ModelFileError, match=r"stiffness_factor is 2\.5, expected 1"):
        load_model_elsewhere(model_file, threading.Event(), 2.5)


def test_a_damaged_file_is_refused_in_the_words_of_its_reader(model_file: Path) -> None:
    model_file.write_bytes(model_file.read_bytes()[:1000])
    with pytest.raises(ModelFileError) as here:
        load_model(model_file)
    with pytest.raises(ModelFileError) as elsewhere:
        load_model_elsewhere(model_file, threading.Event())
    assert str(elsewhere.value) == str(here.value)


def test_a_missing_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ModelFileError, match="no such model file"):
        load_model_elsewhere(tmp_path / "missing.npz", threading.Event())


def test_when_the_server_stops_nothing_is_waited_for(model_file: Path) -> None:
    stopping = threading.Event()
    stopping.set()
    with pytest.raises(ModelFileError, match="could not be read"):
        load_model_elsewhere(model_file, stopping)


@pytest.mark.parametrize(
    ("error", "told"), [(0.0, None), (0.1, None), (1.43, "143 %"), (5e14, "5e+16 %"), (float("nan"), "nan %")]
)
def test_a_model_that_is_wrong_in_its_band_is_told_of(
    make_spring_mass_model: Callable[..., ReducedModel], error: float, told: str | None
) -> None:
    model = make_spring_mass_model()
    wrong = replace(model, accuracy=replace(model.accuracy, error_in_band=error))
    warnings = accuracy_warnings(wrong)
    if told is None:
        assert not warnings
    else:
        assert told in warnings[0]
        assert model.name in warnings[0]
