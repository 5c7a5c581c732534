"""A small model, and changes to a file that keep its checksum right, made after `docs/model-file.md` alone."""

from __future__ import annotations

import dataclasses
import hashlib
import io
import json
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from palpate.model_file import (
    AccuracyReport,
    Contact,
    PoleResidueSystem,
    ReducedModel,
    StateSpace,
    Surface,
    save_model,
)

Change = Callable[[dict[str, Any], dict[str, Any]], None]


def _small_model() -> ReducedModel:
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
            error_step=0.004,
            error_time_domain=0.003,
            error_surface_in_band=0.05,
            gain_above_band=1.4,
            change_over_last_vectors=2e-4,
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


def _assert_same(a: Any, b: Any) -> None:
    """Equal to the bit, through nested dataclasses."""
    if dataclasses.is_dataclass(a):
        assert type(a) is type(b)
        for field in dataclasses.fields(a):
            _assert_same(getattr(a, field.name), getattr(b, field.name))
    elif isinstance(a, np.ndarray):
        assert a.dtype == b.dtype
        np.testing.assert_array_equal(a, b)
    elif isinstance(a, tuple):
        assert len(a) == len(b)
        for x, y in zip(a, b, strict=True):
            _assert_same(x, y)
    else:
        assert a == b


def _pack(path: Path, metadata: dict[str, Any] | bytes, arrays: dict[str, Any]) -> None:
    """Write members by hand: a value that is bytes stands as it is, an array as .npy, and the checksum is added."""
    text = metadata if isinstance(metadata, bytes) else json.dumps(metadata).encode()
    members = {}
    for name, value in (arrays | {"metadata": np.frombuffer(text, np.uint8)}).items():
        stream = io.BytesIO()
        if isinstance(value, bytes):
            stream.write(value)
        else:
            np.save(stream, value)
        members[name] = stream.getvalue()
    digest = hashlib.sha256()
    for name in sorted(members):
        digest.update(name.encode() + b"\0" + members[name])
    stream = io.BytesIO()
    np.save(stream, np.frombuffer(digest.digest(), np.uint8))
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in {**members, "sha256": stream.getvalue()}.items():
            archive.writestr(f"{name}.npy", data)


def _rewrite(path: Path, change: Change) -> None:
    """Apply `change(metadata, arrays)` to a model file; its checksum is then right for the new content."""
    with np.load(path) as archive:
        arrays = {k: archive[k] for k in archive.files if k not in ("metadata", "sha256")}
        metadata = json.loads(archive["metadata"].tobytes())
    change(metadata, arrays)
    _pack(path, metadata, arrays)


@pytest.fixture(scope="session")
def small_model() -> Callable[[], ReducedModel]:
    return _small_model


@pytest.fixture(scope="session")
def assert_same() -> Callable[[Any, Any], None]:
    return _assert_same


@pytest.fixture(scope="session")
def rewrite() -> Callable[[Path, Change], None]:
    return _rewrite


@pytest.fixture(scope="session")
def pack() -> Callable[[Path, dict[str, Any] | bytes, dict[str, Any]], None]:
    return _pack


@pytest.fixture
def model_path(tmp_path: Path) -> Path:
    path = tmp_path / "slab.npz"
    save_model(_small_model(), path)
    return path
