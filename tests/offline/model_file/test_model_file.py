"""What is written is read back to the bit; a file that is wrong in itself is refused by the name of its field."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from palpate.model_file import ModelFileError, ReducedModel, load_model, save_model


def test_a_model_comes_back_to_the_bit(
    model_path: Path, small_model: Callable[[], ReducedModel], assert_same: Callable[[Any, Any], None]
) -> None:
    assert_same(load_model(model_path), small_model())


def test_writing_leaves_one_file_and_replaces_the_old_one(
    model_path: Path, small_model: Callable[[], ReducedModel]
) -> None:
    save_model(dataclasses.replace(small_model(), name="other"), model_path)
    assert [p.name for p in model_path.parent.iterdir()] == ["slab.npz"]
    assert load_model(model_path).name == "other"


def test_a_model_that_could_not_be_read_is_not_written(
    model_path: Path, small_model: Callable[[], ReducedModel]
) -> None:
    model = small_model()
    not_a_number = dataclasses.replace(model.accuracy, error_in_band=float("nan"))
    with pytest.raises(ModelFileError, match=r"'accuracy.error_in_band' is nan"):
        save_model(dataclasses.replace(model, accuracy=not_a_number), model_path)
    assert [p.name for p in model_path.parent.iterdir()] == ["slab.npz"]
    assert load_model(model_path).name == "slab"


def test_the_same_model_gives_the_same_bytes(
    model_path: Path, small_model: Callable[[], ReducedModel]
) -> None:
    again = model_path.with_name("again.npz")
    save_model(small_model(), again)
    assert model_path.read_bytes() == again.read_bytes()


def test_numpy_alone_reads_the_arrays(model_path: Path, small_model: Callable[[], ReducedModel]) -> None:
    with np.load(model_path, allow_pickle=False) as archive:
        np.testing.assert_array_equal(archive["discrete_b"], small_model().discrete.b)
        assert json.loads(archive["metadata"].tobytes())["kind"] == "patch"


def test_the_checksum_is_the_one_that_the_page_describes(
    model_path: Path, rewrite: Callable[..., None], assert_same: Callable[[Any, Any], None]
) -> None:
    model = load_model(model_path)
    rewrite(model_path, lambda metadata, arrays: None)
    assert_same(load_model(model_path), model)


def test_the_page_lists_every_field_of_a_file(model_path: Path) -> None:
    page = (Path(__file__).parents[3] / "docs" / "model-file.md").read_text(encoding="utf-8")
    with np.load(model_path) as archive:
        metadata = json.loads(archive["metadata"].tobytes())
        for name in archive.files:
            assert f"`{name.replace('continuous_', 'discrete_')}`" in page
    for name in (*metadata, *metadata["accuracy"], *metadata["contacts"][0], *metadata["units"]):
        assert f"`{name}`" in page


def test_the_summary_is_plain_json_with_the_promised_keys(small_model: Callable[[], ReducedModel]) -> None:
    summary = json.loads(json.dumps(small_model().summary()))
    assert {"kind", "order", "method", "n_nodes", "n_states_full", "period_s"} <= summary.keys()
    assert {"error_in_band", "error_static", "hankel_singular_values"} <= summary["accuracy"].keys()
    assert summary["accuracy"]["error_bound"] is None
    assert summary["order"] == 6


def test_a_missing_file_is_told_as_such(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="no such model file"):
        load_model(tmp_path / "none.npz")


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
    with pytest.raises(ModelFileError, match="without Python objects"):
        load_model(path)


def test_a_file_of_schema_1_is_refused_with_what_to_do(tmp_path: Path) -> None:
    # Schema 1 had no checksum, and the same first fields.
    metadata = json.dumps({"format": "palpate.reduced-model", "schema_version": 2}).encode()
    np.savez_compressed(tmp_path / "old.npz", metadata=np.frombuffer(metadata, np.uint8))
    with pytest.raises(ModelFileError, match=r"schema_version' is 2: expected 3; .* build it again with"):
        load_model(tmp_path / "old.npz")


def meta(key: str, value: Any) -> Callable[[dict[str, Any], dict[str, Any]], None]:
    return lambda metadata, arrays: metadata.__setitem__(key, value)


def contact(key: str, value: Any) -> Callable[[dict[str, Any], dict[str, Any]], None]:
    return lambda metadata, arrays: metadata["contacts"][0].__setitem__(key, value)


def accuracy(key: str, value: Any) -> Callable[[dict[str, Any], dict[str, Any]], None]:
    return lambda metadata, arrays: metadata["accuracy"].__setitem__(key, value)


def array(key: str, value: Any) -> Callable[[dict[str, Any], dict[str, Any]], None]:
    return lambda metadata, arrays: arrays.__setitem__(key, value)


def without_states(metadata: dict[str, Any], arrays: dict[str, Any]) -> None:
    for group in ("continuous", "discrete"):
        arrays |= {f"{group}_{name}": np.zeros(0) for name in ("diagonal", "cross")}
        arrays |= {f"{group}_b": np.zeros((0, 3)), f"{group}_c": np.zeros((3, 0))}
    arrays["surface_output"] = np.zeros((15, 0), np.float32)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (meta("schema_version", 4), "'schema_version' is 4: .*newer palpate"),
        (meta("schema_version", True), "'schema_version' is True"),
        (meta("format", "other"), "'format' is 'other'"),
        (meta("kind", "voxels"), "'kind' is 'voxels': expected 'patch' or 'surface'"),
        (meta("units", {"length": "mm"}), "'units.displacement' is missing"),
        (lambda m, a: m["units"].update(length="mm"), "'units.length' is 'mm': expected 'm'"),
        (meta("contacts", []), r"'static_stiffness' is 3 rows|'contacts' is \[\]"),
        (meta("contacts", 3), "'contacts' is 3: expected a list"),
        (meta("contacts", [3]), r"'contacts\[0\]' is 3: expected a table"),
        (meta("contacts", [{"name": "tip"}]), r"'contacts\[0\].center_m' is missing"),
        (meta("period_s", -1.0), "'period_s' is -1.0"),
        (meta("period_s", "soon"), "'period_s' is 'soon'"),
        (meta("period_s", 1e-9), "'period_s' is 1e-09: expected a finite number at least 0.0001 and at most 0.1"),
        (meta("period_s", float("nan")), "'period_s' is nan: expected a finite number"),
        (meta("period_s", 10**400), "'period_s' is 1000.*expected a finite number"),
        (meta("n_nodes", -3), "'n_nodes' is -3: expected an integer of at least 1"),
        (meta("n_nodes", 2.5), "'n_nodes' is 2.5"),
        (meta("n_states_full", 0), "'n_states_full' is 0"),
        (meta("name", ""), "'name' is ''"),
        (meta("name", "a\x1b[31mred"), r"'name' is 'a\\x1b\[31mred': expected text of 1 to 64 printable"),
        (meta("name", "x" * 100_000), r"'name' is 'xxx.*\(100002 characters\): expected text of 1 to 64"),
        (meta("built_with", "\ud800"), r"'built_with' is '\\ud800'"),
        (meta("config", "\ud800"), "'config' is .*expected Unicode text"),
        (meta("config_sha256", "z" * 64), "'config_sha256' is 'zzz"),
        (meta("extra", 1), "'extra' is unknown"),
        (accuracy("error_in_band", "x"), "'accuracy.error_in_band' is 'x': expected a finite number"),
        (accuracy("error_in_band", -0.1), "'accuracy.error_in_band' is -0.1: expected a finite number at least 0"),
        (accuracy("band_hz", 30.0), "'accuracy.band_hz' is 30.0: expected a list of numbers"),
        (accuracy("band_hz", [30.0, 2.0]), "'accuracy.band_hz' is .* its lower end below its upper"),
        (accuracy("band_hz", [0.0, 501.0]), "'accuracy.band_hz' is 501.0: .* at most 500"),
        (contact("normal", [0, 0, 2]), r"'contacts\[0\].normal' is \(0, 0, 2\): expected a vector of length 1"),
        (contact("normal", [0, 1]), "expected three numbers"),
        (contact("radius_m", -1.0), r"'contacts\[0\].radius_m' is -1.0"),
        (contact("n_nodes", 0), r"'contacts\[0\].n_nodes' is 0"),
        (contact("name", ""), r"'contacts\[0\].name' is ''"),
        (contact("name", "a\nb"), r"'contacts\[0\].name' is 'a\\nb'"),
        (contact("name", "a\0"), r"'contacts\[0\].name' is 'a\\x00'"),
        (contact("name", "\u202eb"), r"'contacts\[0\].name' is '\\u202eb'"),
        (contact("name", "y" * 100_000), r"'contacts\[0\].name' is 'yyy"),
        (lambda m, a: m["contacts"].append(m["contacts"][0]), "'contacts' is .*each name once"),
        (lambda m, a: m["contacts"].append(m["contacts"][0] | {"name": "b"}), "'static_stiffness' is 3 rows: expected 6"),
        (lambda m, a: m.pop("method"), "'method' is missing"),
        (lambda m, a: m["accuracy"].pop("error_in_band"), "'accuracy.error_in_band' is missing"),
        (lambda m, a: a.pop("discrete_b"), "'discrete_b' is missing"),
        (array("weights", np.eye(2)), "'weights' is unknown"),
        (array("a\x1b", np.eye(2)), r"'a\\x1b' is unknown"),
        (array("discrete_b", np.zeros((6, 2))), r"'discrete_b' is <f8 \(6, 2\): expected <f8 \(order, channels\), here \(6, 3\)"),
        (array("discrete_c", np.zeros((3, 6), np.float32)), r"'discrete_c' is <f4"),
        (array("discrete_c", np.zeros((3, 6), ">f8")), r"'discrete_c' is in another form"),
        (array("discrete_c", np.asfortranarray(np.ones((3, 6)))), r"'discrete_c' is in another form: .*C order"),
        (array("discrete_d", np.full((3, 3), np.nan)), "'discrete_d' is not finite"),
        (array("surface_output", b"no array at all"), "'surface_output' is in another form: expected an array in .npy"),
        (array("surface_triangles", np.array([[0, 1, 9]], np.int32)), "'surface_triangles' is 9: expected indices"),
        (array("discrete_diagonal", np.full(6, 1.1)), "unstable"),
        (without_states, "'discrete_diagonal' has length 0|'continuous_diagonal' has length 0"),
    ],
)  # fmt: skip
def test_an_inconsistent_file_is_refused_in_one_line_that_names_the_field(
    model_path: Path, rewrite: Callable[..., None], change: Any, says: str
) -> None:
    rewrite(model_path, change)
    with pytest.raises(ModelFileError, match=says) as caught:
        load_model(model_path)
    assert str(caught.value).isprintable()
    assert len(str(caught.value)) < 600


@pytest.mark.parametrize(
    ("metadata", "says"),
    [
        (b"[" * 100_000 + b"]" * 100_000, "'metadata' is not JSON: nested too deeply"),
        (b"\xff", "'metadata' is not JSON"),
        (b"3", "'format' is 3"),
        (b"", "'metadata' is not JSON"),
        (b" " * (2**20 + 1), r"'metadata' is \|u1 \(1048577,\): expected .* at most 1,048,576 bytes"),
    ],
)
def test_metadata_that_is_no_table_is_refused(
    tmp_path: Path, pack: Callable[..., None], metadata: bytes, says: str
) -> None:
    pack(tmp_path / "odd.npz", metadata, {})
    with pytest.raises(ModelFileError, match=says):
        load_model(tmp_path / "odd.npz")


def test_a_path_may_be_text(model_path: Path) -> None:
    assert load_model(str(model_path)).name == load_model(model_path).name
