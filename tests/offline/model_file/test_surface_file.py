"""A surface model is read back to the bit; a file that is wrong in itself is refused by the name of its field."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from palpate.model_file import (
    ModelFileError,
    SurfaceAccuracy,
    SurfaceModel,
    ToolShape,
    load_model,
    load_patch_model,
    save_model,
)


def _small() -> SurfaceModel:
    rng = np.random.default_rng(5)
    normals = rng.normal(size=(4, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    held = np.array([False, False, False, True])
    shapes = rng.normal(size=(4, 3, 2)).astype(np.float32)
    factor = rng.normal(size=(12, 12))
    factor[9:] = shapes[3] = 0
    return SurfaceModel(
        name="slab",
        period_s=1e-3,
        n_nodes=30,
        tools=(
            ToolShape("tip", 0.005, 0.2, (0.0, 0.0, 0.1)),
            ToolShape("other", 0.004, 0.0, (0.1, 0.0, 0.1)),
        ),
        points=rng.normal(size=(4, 3)),
        normals=normals,
        triangles=np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]], np.int32),
        held=held,
        squared_frequencies=np.array([40.0, 90.0]),
        shapes=shapes,
        residual=_symmetric((factor @ factor.T).astype(np.float32)),
        gamma=np.array([0.5]),
        tau_s=np.array([0.1]),
        band_hz=(0.0, 30.0),
        config='{"name": "slab"}',
        config_sha256="00" * 32,
        built_with="palpate 0.1.0",
        accuracy=SurfaceAccuracy(
            contact_radius_m=0.003,
            error_static=1e-6,
            error_static_median=1e-7,
            error_in_band=0.2,
            error_in_band_median=0.03,
            error_in_working_area=0.05,
            passivity_margin=1e-5,
            passivity_margin_sampled=1e-6,
            largest_stiffness_n_per_m=300.0,
            residual_shift_m_per_n=1e-9,
            resolved_frequency_hz=23.0,
            error_map=np.array([0.2, 0.03, 0.01, 0.0], np.float32),
        ),
    )


def _symmetric(matrix: np.ndarray) -> np.ndarray:
    return np.tril(matrix) + np.tril(matrix, -1).T


@pytest.fixture
def path(tmp_path: Path) -> Path:
    save_model(_small(), tmp_path / "surface.npz")
    return tmp_path / "surface.npz"


def test_a_surface_model_comes_back_to_the_bit(path: Path, assert_same: Callable[[Any, Any], None]) -> None:
    assert_same(load_model(path), _small())


def test_numpy_alone_reads_it_and_its_residual_is_the_lower_triangle_row_by_row(path: Path) -> None:
    with np.load(path, allow_pickle=False) as archive:
        np.testing.assert_array_equal(archive["residual"], _small().residual[np.tril_indices(12)])
        np.testing.assert_array_equal(archive["held"], [0, 0, 0, 1])
        np.testing.assert_array_equal(archive["shapes"], _small().shapes)


def test_a_summary_says_what_it_is() -> None:
    summary = _small().summary()
    assert (summary["kind"], summary["order"], summary["n_points"], summary["n_held_points"]) == (
        "surface",
        2,
        4,
        1,
    )
    assert summary["highest_mode_hz"] == pytest.approx(np.sqrt(90.0) / (2 * np.pi))
    assert "config" not in summary


def test_a_program_for_patches_refuses_it_and_takes_a_patch_model(path: Path, model_path: Path) -> None:
    with pytest.raises(ModelFileError, match=r"surface\.npz: field 'kind' is 'surface': expected 'patch'"):
        load_patch_model(path)
    assert load_patch_model(model_path).name == "slab"


def meta(field: str, value: Any) -> Callable[[Any, Any], None]:
    return lambda metadata, arrays: metadata.__setitem__(field, value)


def tool(field: str, value: Any) -> Callable[[Any, Any], None]:
    return lambda metadata, arrays: metadata["tools"][0].__setitem__(field, value)


def array(name: str, value: Any) -> Callable[[Any, Any], None]:
    return lambda metadata, arrays: arrays.__setitem__(name, value)


def entry(name: str, place: Any, value: float) -> Callable[[Any, Any], None]:
    def change(metadata: Any, arrays: Any) -> None:
        arrays[name] = arrays[name].copy()
        arrays[name][place] = value

    return change


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (meta("tools", []), "'tools' is .*at least one tool"),
        (meta("tools", 3), "'tools' is 3: expected a list"),
        (tool("radius_m", 0.0), r"'tools\[0\].radius_m' is 0.0: expected a finite number at least 0.0001 and at most 1"),
        (tool("radius_m", 1e-200), r"'tools\[0\].radius_m' is 1e-200"),
        (tool("friction", -0.1), r"'tools\[0\].friction' is -0.1"),
        (tool("friction", 2.5), r"'tools\[0\].friction' is 2.5: expected a finite number at least 0 and at most 2"),
        (tool("home_m", [0.0, 1.0]), r"'tools\[0\].home_m' is \(0.0, 1.0\): expected three numbers"),
        (tool("name", "other"), "'tools' is .*each name once"),
        (tool("mass_kg", 1.0), r"'tools\[0\].mass_kg' is unknown"),
        (meta("band_hz", [30.0, 5.0]), "'band_hz' is .*lower end below"),
        (meta("contacts", []), "'contacts' is unknown"),
        (lambda m, a: m["accuracy"].pop("error_static"), "'accuracy.error_static' is missing"),
        (lambda m, a: m["accuracy"].update(error_in_band=-1.0), "'accuracy.error_in_band' is -1.0"),
        (lambda m, a: a.pop("error_map"), "'error_map' is missing"),
        (array("discrete_b", np.eye(2)), "'discrete_b' is unknown"),
        (array("residual", np.zeros(77, np.float32)), "'residual' has 77 entries: expected 78, the lower triangle"),
        (array("shapes", np.zeros((4, 3, 0), np.float32)), r"'shapes' is <f4 \(4, 3, 0\)"),
        (array("shapes", np.zeros((4, 2, 3), np.float32)), r"'shapes' is <f4 \(4, 2, 3\)"),
        (array("error_map", np.zeros(3, np.float32)), r"'error_map' is <f4 \(3,\)"),
        (array("held", np.array([0, 0, 0, 2], np.uint8)), "'held' is 2: expected 0 or 1"),
        (array("held", np.array([0, 0, 1, 1], np.uint8)), "'held' is of points that move"),
        (array("normals", np.zeros((4, 3))), "'normals' is of lengths 0 to 0: expected unit vectors"),
        (array("triangles", np.array([[0, 1, 4]], np.int32)), "'triangles' is 4: expected indices of vertices, 0 to 3"),
        (array("squared_frequencies", np.array([90.0, 40.0])), "'squared_frequencies' is not positive and ascending"),
        (array("squared_frequencies", np.array([0.0, 40.0])), "'squared_frequencies' is not positive and ascending"),
        (array("gamma", np.array([-0.5])), "'gamma' is -0.5: expected numbers of at least 1e-09"),
        (array("tau_s", np.array([1e-310])), "'tau_s' is 1e-310: expected numbers of at least 1e-09"),
        (array("tau_s", np.array([0.1, 0.2])), r"'tau_s' is <f8 \(2,\)"),
        (entry("residual", 0, -1.0), "'residual' is negative on its diagonal"),
        (entry("residual", 3, np.nan), "'residual' is not finite"),
        (entry("residual", 2, 1e30), "'residual' is up to 1e\\+30: expected numbers of at most 1e\\+15"),
        (entry("shapes", (0, 0, 0), 1e30), "'shapes' is up to 1e\\+30"),
        (entry("points", (0, 0), 1e300), "'points' is up to 1e\\+300: expected numbers of at most 1e\\+20"),
    ],
)  # fmt: skip
def test_an_inconsistent_file_is_refused_in_one_line_that_names_the_field(
    path: Path, rewrite: Callable[..., None], change: Any, says: str
) -> None:
    rewrite(path, change)
    with pytest.raises(ModelFileError, match=says) as caught:
        load_model(path)
    assert str(caught.value).isprintable()


def test_a_residual_that_is_not_symmetric_is_not_written(tmp_path: Path) -> None:
    model = _small()
    skew = model.residual.copy()
    skew[0, 1] += 1
    with pytest.raises(ModelFileError, match="'residual' is not symmetric"):
        save_model(replace(model, residual=skew), tmp_path / "skew.npz")
    assert not (tmp_path / "skew.npz").exists()
