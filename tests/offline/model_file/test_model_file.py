"""What is written is read back to the bit; whatever else lies in a file is refused with its reason."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from palpate.model_file import (
    AccuracyReport,
    Contact,
    ModelFileError,
    PoleResidueSystem,
    ReducedModel,
    StateSpace,
    Surface,
    load_model,
    save_model,
)


def small_model() -> ReducedModel:
    rng = np.random.default_rng(3)
    order, channels, vertices = 6, 3, 5
    diagonal = -np.repeat(rng.uniform(1, 9, 3), 2)
    cross = np.repeat(rng.uniform(1, 9, 3), 2) * np.tile([1.0, -1.0], 3)
    b, c = rng.normal(size=(order, channels)), rng.normal(size=(channels, order))
    continuous = StateSpace(diagonal, cross, b, c, np.eye(channels))
    discrete = StateSpace(1 + 1e-3 * diagonal, 1e-3 * cross, 1e-3 * b, c, np.eye(channels))
    return ReducedModel(
        name="slab",
        method="tbr-band",
        period_s=1e-3,
        n_nodes=75,
        n_states_full=600,
        contacts=(Contact("tip", (0.1, 0.2, 0.3), (0.0, 0.0, 1.0), 0.005, 9),),
        continuous=continuous,
        discrete=discrete,
        full=PoleResidueSystem(
            poles=np.array([-2.0 + 0j, -1.0 + 30j]),
            b=rng.normal(size=(2, channels)) + 0j,
            c=rng.normal(size=(channels, 2)) + 0j,
            d=np.eye(channels),
        ),
        static_stiffness=80 * np.eye(channels),
        surface=Surface(
            vertices=rng.normal(size=(vertices, 3)),
            triangles=np.array([[0, 1, 2], [2, 3, 4]], dtype=np.int32),
            output=rng.normal(size=(3 * vertices, order)).astype(np.float32),
            feedthrough=rng.normal(size=(3 * vertices, channels)).astype(np.float32),
        ),
        accuracy=AccuracyReport(
            error_in_band=0.01,
            error_in_band_continuous=0.009,
            error_static=0.001,
            error_hinf=0.02,
            error_bound=None,
            error_time_domain=0.003,
            error_surface_in_band=0.05,
            spectral_abscissa=-1.0,
            spectral_abscissa_full=-0.9,
            passivity_margin=-1e-5,
            passive_up_to_hz=425.0,
            largest_energy_out_j=1e-9,
            resolved_frequency_hz=22.0,
            band_hz=(0.0, 30.0),
            hankel_singular_values=np.array([3.0, 2.0, 1.0]),
        ),
        config='{"name": "slab"}',
        config_sha256="00" * 32,
        built_with="palpate 0.1.0",
    )


def assert_same(a: Any, b: Any) -> None:
    """Equal to the bit, through nested dataclasses."""
    if dataclasses.is_dataclass(a):
        assert type(a) is type(b)
        for field in dataclasses.fields(a):
            assert_same(getattr(a, field.name), getattr(b, field.name))
    elif isinstance(a, np.ndarray):
        assert a.dtype == b.dtype
        np.testing.assert_array_equal(a, b)
    elif isinstance(a, tuple):
        assert len(a) == len(b)
        for x, y in zip(a, b, strict=True):
            assert_same(x, y)
    else:
        assert a == b


def test_a_model_comes_back_to_the_bit(tmp_path: Path) -> None:
    model = small_model()
    save_model(model, tmp_path / "slab.npz")
    assert_same(load_model(tmp_path / "slab.npz"), model)


def test_writing_leaves_one_file_and_replaces_the_old_one_whole(tmp_path: Path) -> None:
    path = tmp_path / "slab.npz"
    save_model(small_model(), path)
    save_model(dataclasses.replace(small_model(), name="other"), path)
    assert [p.name for p in tmp_path.iterdir()] == ["slab.npz"]
    assert load_model(path).name == "other"


def test_a_model_that_can_not_be_written_leaves_the_old_file(tmp_path: Path) -> None:
    path = tmp_path / "slab.npz"
    save_model(small_model(), path)
    bad = dataclasses.replace(
        small_model(), accuracy=dataclasses.replace(small_model().accuracy, error_in_band=float("nan"))
    )
    with pytest.raises(ValueError, match="JSON"):
        save_model(bad, path)
    assert [p.name for p in tmp_path.iterdir()] == ["slab.npz"]
    assert load_model(path).name == "slab"


def test_the_same_model_gives_the_same_bytes(tmp_path: Path) -> None:
    save_model(small_model(), tmp_path / "a.npz")
    save_model(small_model(), tmp_path / "b.npz")
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()


def test_the_summary_is_plain_json_with_the_promised_keys() -> None:
    summary = json.loads(json.dumps(small_model().summary()))
    assert {"order", "method", "n_nodes", "n_states_full", "period_s", "accuracy"} <= summary.keys()
    assert {
        "error_in_band",
        "error_static",
        "error_hinf",
        "error_bound",
        "error_time_domain",
        "spectral_abscissa",
        "passivity_margin",
        "resolved_frequency_hz",
        "hankel_singular_values",
    } <= summary["accuracy"].keys()
    assert summary["accuracy"]["error_bound"] is None
    assert summary["order"] == 6


def test_two_contacts_with_one_name_are_refused(tmp_path: Path) -> None:
    model = small_model()
    twice = dataclasses.replace(model, contacts=model.contacts * 2)
    path = tmp_path / "slab.npz"

    def wider(system: StateSpace) -> StateSpace:
        return StateSpace(
            system.diagonal,
            system.cross,
            np.tile(system.b, 2),
            np.tile(system.c, (2, 1)),
            np.tile(system.d, (2, 2)),
        )

    full, surface = model.full, model.surface
    save_model(
        dataclasses.replace(
            twice,
            continuous=wider(model.continuous),
            discrete=wider(model.discrete),
            full=PoleResidueSystem(
                full.poles, np.tile(full.b, 2), np.tile(full.c, (2, 1)), np.tile(full.d, (2, 2))
            ),
            static_stiffness=np.tile(model.static_stiffness, (2, 2)),
            surface=dataclasses.replace(surface, feedthrough=np.tile(surface.feedthrough, 2)),
        ),
        path,
    )
    with pytest.raises(ModelFileError, match=r"'contacts' names \['tip', 'tip'\]: expected each name once"):
        load_model(path)


def test_a_missing_file_is_told_as_such(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="no such model file"):
        load_model(tmp_path / "none.npz")


@pytest.mark.parametrize("keep", [0.0, 0.1, 0.5, 0.9, 0.999])
def test_a_truncated_file_is_refused(tmp_path: Path, keep: float) -> None:
    path = tmp_path / "slab.npz"
    save_model(small_model(), path)
    data = path.read_bytes()
    path.write_bytes(data[: int(keep * len(data))])
    with pytest.raises(ModelFileError, match=r"slab.npz: damaged or not an .npz archive"):
        load_model(path)


def test_a_flipped_byte_anywhere_is_refused_or_harmless(tmp_path: Path) -> None:
    path = tmp_path / "slab.npz"
    save_model(small_model(), path)
    data = bytearray(path.read_bytes())
    refused = 0
    positions = range(0, len(data), 37)
    for position in positions:
        damaged = bytearray(data)
        damaged[position] ^= 0xFF
        path.write_bytes(bytes(damaged))
        try:
            assert_same(load_model(path), small_model())  # archive headers have bytes nobody reads
        except ModelFileError:
            refused += 1
    assert refused > len(positions) // 2


def test_foreign_files_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "foreign.npz"
    np.savez(path, weights=np.eye(3))
    with pytest.raises(ModelFileError, match=r"'metadata'.*not a palpate model"):
        load_model(path)
    with path.open("wb") as file:
        np.save(file, np.eye(3))
    with pytest.raises(ModelFileError, match="damaged or not"):
        load_model(path)
    path.write_text("hello")
    with pytest.raises(ModelFileError, match="damaged or not"):
        load_model(path)
    with path.open("wb") as file:
        np.savez(file, metadata=np.array([{"a": 1}], dtype=object), allow_pickle=True)
    with pytest.raises(ModelFileError, match=r"\(it holds pickled objects\)$"):
        load_model(path)


def rewrite(path: Path, change: Callable[[dict[str, Any], dict[str, Any]], None]) -> None:
    """Apply `change(metadata, arrays)` to a model file."""
    with np.load(path) as archive:
        arrays = {k: archive[k] for k in archive.files}
    metadata = json.loads(arrays["metadata"].tobytes())
    change(metadata, arrays)
    arrays["metadata"] = np.frombuffer(json.dumps(metadata).encode(), dtype=np.uint8)
    np.savez(path, **arrays)


def set_meta(key: str, value: Any) -> Callable[[dict[str, Any], dict[str, Any]], None]:
    return lambda metadata, arrays: metadata.__setitem__(key, value)


def set_array(key: str, value: Any) -> Callable[[dict[str, Any], dict[str, Any]], None]:
    return lambda metadata, arrays: arrays.__setitem__(key, value)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (set_meta("schema_version", 2), "schema_version is 2.*newer palpate"),
        (set_meta("schema_version", 0), "schema_version is 0.*build it again"),
        (set_meta("format", "other"), "format is 'other'"),
        (set_meta("contacts", []), "'contacts' is empty"),
        (set_meta("contacts", [{"name": "tip"}]), "'center_m' is missing"),
        (set_meta("period_s", -1.0), "'period_s' is -1.0"),
        (set_meta("period_s", "soon"), "metadata can't be read"),
        (set_meta("period_s", 1e-9), "'period_s' is 1e-09: expected from 0.0001 to 0.1"),
        (set_meta("period_s", float("nan")), "metadata holds NaN"),
        (lambda m, a: m["accuracy"].update(error_in_band="x"), "'accuracy.error_in_band' is 'x': expected a number"),
        (lambda m, a: m["contacts"][0].update(normal=[0, 0, 2]), "normal of length 2 at 'tip'"),
        (lambda m, a: m["contacts"].append(m["contacts"][0]), "'continuous_b' is float64"),
        (lambda m, a: m.pop("method"), "'method' is missing"),
        (lambda m, a: m["accuracy"].pop("error_in_band"), "'accuracy.error_in_band' is missing"),
        (lambda m, a: a.pop("discrete_b"), "'discrete_b' is missing"),
        (set_array("discrete_b", np.zeros((6, 2))), r"'discrete_b' is float64 \(6, 2\): expected float64 \(6, 3\)"),
        (set_array("discrete_c", np.zeros((3, 6), np.float32)), r"'discrete_c' is float32"),
        (set_array("discrete_d", np.full((3, 3), np.nan)), "'discrete_d' holds numbers that are not finite"),
        (set_array("surface_triangles", np.array([[0, 1, 9]], np.int32)), "'surface_triangles' names vertices"),
        (set_array("discrete_diagonal", np.full(6, 1.1)), "unstable"),
    ],
)  # fmt: skip
def test_an_inconsistent_file_is_refused_by_the_name_of_its_field(
    tmp_path: Path, change: Callable[[dict[str, Any], dict[str, Any]], None], says: str
) -> None:
    path = tmp_path / "slab.npz"
    save_model(small_model(), path)
    rewrite(path, change)
    with pytest.raises(ModelFileError, match=says):
        load_model(path)
