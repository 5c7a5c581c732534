"""Checks of a model's values, before it is written and after it is read."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.files import printable
from palpate.model_file.members import Header, arrays_of, check_shapes
from palpate.model_file.surface_model import (
    LEAST_RADIUS_M,
    MOST_FRICTION,
    MOST_RADIUS_M,
    SurfaceAccuracy,
    SurfaceModel,
    ToolShape,
)
from palpate.model_file.types import (
    LONGEST_PERIOD_S,
    SHORTEST_PERIOD_S,
    AccuracyReport,
    Contact,
    ModelFileError,
    ReducedModel,
)

_LONGEST_NAME = 64
_LONGEST_TEXT = 200
_LARGEST_SINGLE, _LARGEST_DOUBLE = 1e15, 1e20
"""Of the entries of arrays, in SI units: far beyond any body, and far enough from overflow for the sums of a tick."""

_LEAST_OF_BRANCH = 1e-9
"""Of a branch's gamma and tau_s: the scene's bounds."""


def check_model(model: ReducedModel | SurfaceModel) -> None:
    """Check the values of a model; the reader checks what concerns the file.

    Raises ModelFileError, in one line that names the field and what was expected.
    """
    _text("name", model.name, _LONGEST_NAME)
    _text("built_with", model.built_with, _LONGEST_TEXT)
    _config(model)
    _number("period_s", model.period_s, SHORTEST_PERIOD_S, LONGEST_PERIOD_S)
    _whole("n_nodes", model.n_nodes)
    if isinstance(model, SurfaceModel):
        _tools(model.tools)
        _band("band_hz", model.band_hz, model.period_s)
        _accuracy_of_surface(model.accuracy)
        _arrays_of_surface(model)
        return
    _text("method", model.method, _LONGEST_TEXT)
    _whole("n_states_full", model.n_states_full)
    _contacts(model.contacts)
    _accuracy(model)
    _arrays(model)
    _stable(model)


def refuse(field: str, value: object, expected: str) -> ModelFileError:
    """The error that says what a field is and what was expected. Pass the repr of what comes from a file."""
    return ModelFileError(f"field '{field}' is {printable(value, _LONGEST_TEXT)}: expected {expected}")


def _text(field: str, value: object, longest: int) -> None:
    if not (isinstance(value, str) and 0 < len(value) <= longest and value.isprintable()):
        raise refuse(field, repr(value), f"text of 1 to {longest} printable characters")


def _config(model: ReducedModel | SurfaceModel) -> None:
    try:
        model.config.encode()
    except (AttributeError, UnicodeEncodeError):
        raise refuse("config", repr(model.config), "Unicode text") from None
    digest = model.config_sha256
    if not (isinstance(digest, str) and len(digest) in (0, 64) and set(digest) <= set("0123456789abcdef")):
        raise refuse("config_sha256", repr(digest), "64 lower-case hexadecimal digits, or none")


def _number(field: str, value: Any, low: float = -math.inf, high: float = math.inf) -> None:
    """Check for a finite number from low to high."""
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    if not (is_number and -1e300 < value < 1e300 and low <= value <= high):
        limits = [f"at least {low:g}"] * (low > -math.inf) + [f"at most {high:g}"] * (high < math.inf)
        raise refuse(field, repr(value), " ".join(["a finite number", " and ".join(limits)]).strip())


def _whole(field: str, value: Any) -> None:
    if type(value) is not int or not 0 < value < 2**53:
        raise refuse(field, repr(value), "an integer of at least 1")


def _contacts(contacts: tuple[Contact, ...]) -> None:
    for index, contact in enumerate(contacts):
        where = f"contacts[{index}]"
        _text(f"{where}.name", contact.name, _LONGEST_NAME)
        for name in ("center_m", "normal"):
            vector = getattr(contact, name)
            if len(vector) != 3:
                raise refuse(f"{where}.{name}", vector, "three numbers")
            for value in vector:
                _number(f"{where}.{name}", value, -1e3, 1e3)
        if not abs(math.hypot(*contact.normal) - 1) < 1e-6:
            raise refuse(f"{where}.normal", contact.normal, "a vector of length 1")
        _number(f"{where}.radius_m", contact.radius_m, 1e-9, 1e3)
        _whole(f"{where}.n_nodes", contact.n_nodes)
    names = [contact.name for contact in contacts]
    if not names or len(set(names)) < len(names):
        raise refuse("contacts", names, "at least one contact, and each name once")


def _accuracy(model: ReducedModel) -> None:
    accuracy = model.accuracy
    for field in fields(AccuracyReport):
        value, name = getattr(accuracy, field.name), f"accuracy.{field.name}"
        if field.type == "float" or (field.type == "float | None" and value is not None):
            _number(name, value, 0.0 if field.name.startswith("error") else -math.inf)
    _band("accuracy.band_hz", accuracy.band_hz, model.period_s)


def _band(field: str, band: tuple[float, float], period_s: float) -> None:
    if len(band) != 2:
        raise refuse(field, band, "two numbers")
    for value in band:
        _number(field, value, 0.0, 0.5 / period_s)
    if not band[0] < band[1]:
        raise refuse(field, band, "its lower end below its upper")


def _arrays(model: ReducedModel) -> None:
    arrays = arrays_of(model)
    check_shapes({name: Header(array.dtype.str, array.shape) for name, array in arrays.items()}, model.kind)
    channels = len(model.static_stiffness)
    if channels != model.n_inputs:
        raise refuse("static_stiffness", f"{channels} rows", f"{model.n_inputs}, three for each contact")
    _plausible(arrays)
    _triangles("surface_triangles", model.surface.triangles, len(model.surface.vertices))


def _plausible(arrays: dict[str, NDArray[Any]]) -> None:
    for name, array in arrays.items():
        if not np.all(np.isfinite(array)):
            raise refuse(name, "not finite in some places", "finite numbers")
        most = _LARGEST_SINGLE if array.dtype == np.float32 else _LARGEST_DOUBLE
        if array.size and not (largest := float(np.abs(array).max())) <= most:
            raise refuse(name, f"up to {largest:.3g}", f"numbers of at most {most:g}")


def _triangles(field: str, triangles: NDArray[np.int32], n_vertices: int) -> None:
    if triangles.size and not (triangles.min() >= 0 and triangles.max() < n_vertices):
        raise refuse(field, triangles.max(), f"indices of vertices, 0 to {n_vertices - 1}")


def _tools(tools: tuple[ToolShape, ...]) -> None:
    for index, tool in enumerate(tools):
        where = f"tools[{index}]"
        _text(f"{where}.name", tool.name, _LONGEST_NAME)
        _number(f"{where}.radius_m", tool.radius_m, LEAST_RADIUS_M, MOST_RADIUS_M)
        _number(f"{where}.friction", tool.friction, 0.0, MOST_FRICTION)
        if len(tool.home_m) != 3:
            raise refuse(f"{where}.home_m", tool.home_m, "three numbers")
        for value in tool.home_m:
            _number(f"{where}.home_m", value, -1e5, 1e5)
    names = [tool.name for tool in tools]
    if not names or len(set(names)) < len(names):
        raise refuse("tools", names, "at least one tool, and each name once")


def _accuracy_of_surface(accuracy: SurfaceAccuracy) -> None:
    for field in fields(SurfaceAccuracy):
        if field.type == "float":
            low = -math.inf if field.name.startswith("passivity") else 0.0
            _number(f"accuracy.{field.name}", getattr(accuracy, field.name), low)


def _arrays_of_surface(model: SurfaceModel) -> None:
    """Whether the residual is semidefinite is not checked: the factorization that tells takes longer than reading."""
    if model.residual.shape != (3 * model.n_points, 3 * model.n_points):
        raise refuse("residual", model.residual.shape, f"{3 * model.n_points} rows and columns")
    if not all(np.array_equal(a, b, equal_nan=True) for a, b in _mirrored(model.residual)):
        raise refuse("residual", "not symmetric", "a symmetric matrix")
    arrays = arrays_of(model)
    check_shapes({name: Header(array.dtype.str, array.shape) for name, array in arrays.items()}, model.kind)
    _plausible(arrays)
    _triangles("triangles", model.triangles, model.n_points)
    lengths = np.linalg.norm(model.normals, axis=1)
    if not np.all(np.abs(lengths - 1) < 1e-6):
        raise refuse("normals", f"of lengths {lengths.min():.9g} to {lengths.max():.9g}", "unit vectors")
    squared = model.squared_frequencies
    if not (squared[0] > 0 and np.all(np.diff(squared) >= 0)):
        raise refuse(
            "squared_frequencies", "not positive and ascending", "positive numbers in ascending order"
        )
    for name in ("gamma", "tau_s"):
        if not np.all(getattr(model, name) >= _LEAST_OF_BRANCH):
            raise refuse(name, getattr(model, name).min(), f"numbers of at least {_LEAST_OF_BRANCH:g}")
    if np.any(model.shapes[model.held]) or np.any(model.residual[np.repeat(model.held, 3)]):
        raise refuse("held", "of points that move", "points whose shapes and residual are zero")
    if not np.all(model.residual.diagonal() >= 0):
        raise refuse("residual", "negative on its diagonal", "a positive semidefinite matrix")


def _mirrored(matrix: NDArray[np.float32], rows: int = 256) -> Iterator[tuple[NDArray[np.float32], ...]]:
    """Blocks of a matrix and of its transpose, some rows at a time."""
    for start in range(0, len(matrix), rows):
        yield matrix[start : start + rows], matrix[:, start : start + rows].T


def _stable(model: ReducedModel) -> None:
    """Check that every 2x2 block [[a, b], [c, d]] of the discrete state matrix has eigenvalues inside the unit circle."""
    a = model.discrete
    blocks = np.stack([a.diagonal[0::2], a.cross[0::2], a.cross[1::2], a.diagonal[1::2]], axis=-1)
    radius = float(np.max(np.abs(np.linalg.eigvals(blocks.reshape(-1, 2, 2)))))
    if radius >= 1:
        raise ModelFileError(
            f"field 'discrete_diagonal' is of an unstable model, spectral radius {radius:.9f}: expected below 1"
        )
