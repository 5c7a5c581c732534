"""The members of a model file: names, dtypes, shapes, bounds and checksum. Shared by the writer and the reader."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.model_file.surface_model import SurfaceModel
from palpate.model_file.types import ModelFileError, ReducedModel

METADATA, CHECKSUM = "metadata", "sha256"  # the members beside the arrays, both uint8

MAX_METADATA_BYTES = 2**20
MAX_TOTAL_BYTES = 2**29
"""Bound on the unpacked size of a file, 512 MiB. The largest models expected, 1,200 states and a surface of 15,000
vertices, unpack to 220 MiB; 4,000 points with 2,000 modes to 366 MiB."""

Layout = dict[str, tuple[str, tuple[str, ...]]]
"""dtype and shape of each array of a kind of model. A name in a shape stands for the same length wherever it occurs."""

_STATE_SPACE: dict[str, tuple[str, ...]] = {
    "diagonal": ("order",),
    "cross": ("order",),
    "b": ("order", "channels"),
    "c": ("channels", "order"),
    "d": ("channels", "channels"),
}

_PATCH: Layout = {
    "static_stiffness": ("<f8", ("channels", "channels")),
    "hankel_singular_values": ("<f8", ("singular_values",)),
    **{f"continuous_{name}": ("<f8", shape) for name, shape in _STATE_SPACE.items()},
    **{f"discrete_{name}": ("<f8", shape) for name, shape in _STATE_SPACE.items()},
    "full_poles": ("<c16", ("poles",)),
    "full_b": ("<c16", ("poles", "channels")),
    "full_c": ("<c16", ("channels", "poles")),
    "full_d": ("<f8", ("channels", "channels")),
    "surface_vertices": ("<f8", ("vertices", "3")),
    "surface_triangles": ("<i4", ("triangles", "3")),
    "surface_output": ("<f4", ("3*vertices", "order")),
    "surface_feedthrough": ("<f4", ("3*vertices", "channels")),
}

_SURFACE: Layout = {
    "points": ("<f8", ("points", "3")),
    "normals": ("<f8", ("points", "3")),
    "triangles": ("<i4", ("triangles", "3")),
    "held": ("|u1", ("points",)),
    "squared_frequencies": ("<f8", ("modes",)),
    "shapes": ("<f4", ("points", "3", "modes")),
    "residual": ("<f4", ("packed",)),
    "gamma": ("<f8", ("terms",)),
    "tau_s": ("<f8", ("terms",)),
    "error_map": ("<f4", ("points",)),
}

LAYOUTS: dict[str, Layout] = {ReducedModel.kind: _PATCH, SurfaceModel.kind: _SURFACE}


def arrays_of(model: ReducedModel | SurfaceModel) -> dict[str, NDArray[Any]]:
    """The arrays of a model under the names of their members, as the file holds them."""
    if isinstance(model, SurfaceModel):
        named = {name: getattr(model, name) for name in _SURFACE if name != "error_map"}
        return named | {
            "held": model.held.astype(np.uint8),
            "residual": packed(model.residual),
            "error_map": model.accuracy.error_map,
        }
    arrays: dict[str, NDArray[Any]] = {
        "static_stiffness": model.static_stiffness,
        "hankel_singular_values": model.accuracy.hankel_singular_values,
    }
    for group in ("continuous", "discrete", "full", "surface"):
        part = getattr(model, group)
        arrays |= {f"{group}_{field.name}": getattr(part, field.name) for field in fields(part)}
    del arrays["full_group"]  # only a reduction needs the mode that a pole belongs to
    return arrays


@dataclass(frozen=True)
class Header:
    """What the .npy header of a member declares. n_bytes is the size of its data."""

    dtype: str
    shape: tuple[int, ...]

    @property
    def n_bytes(self) -> int:
        return int(self.dtype[2:]) * math.prod(self.shape)

    def __str__(self) -> str:
        return f"{self.dtype} {self.shape}"


def packed(residual: NDArray[np.float32]) -> NDArray[np.float32]:
    """(n (n + 1) / 2,): the lower triangle of a symmetric matrix (n, n), row by row."""
    return np.concatenate([row[: i + 1] for i, row in enumerate(residual)])


def unpacked(triangle: NDArray[np.float32]) -> NDArray[np.float32]:
    """(n, n): the symmetric matrix of a lower triangle that `packed` made."""
    n = triangular_root(len(triangle))
    matrix = np.zeros((n, n), dtype=np.float32)
    start = 0
    for i in range(n):
        matrix[i, : i + 1] = triangle[start : start + i + 1]
        start += i + 1
    diagonal = matrix.diagonal().copy()
    matrix += matrix.T
    np.fill_diagonal(matrix, diagonal)
    return matrix


def triangular_root(count: int) -> int:
    """The rows of a triangle with at most `count` entries."""
    return (math.isqrt(8 * count + 1) - 1) // 2


def check_shapes(headers: dict[str, Header], kind: str) -> None:
    """Check that the arrays of one model fit each other. Raises ModelFileError that names the first that does not."""
    lengths: dict[str, int] = {"3": 3}
    for name, (dtype, dimensions) in LAYOUTS[kind].items():
        header = headers[name]
        expected = []
        for axis, dimension in enumerate(dimensions):
            factor, _, symbol = dimension.rpartition("*")
            if symbol not in lengths and axis < len(header.shape):
                lengths[symbol] = header.shape[axis]
            expected.append(int(factor or 1) * lengths.get(symbol, 0))
        if header.dtype != dtype or header.shape != tuple(expected):
            raise ModelFileError(
                f"field '{name}' is {header}: expected {dtype} ({', '.join(dimensions)}), "
                f"here {tuple(expected)}"
            )
    if kind == SurfaceModel.kind:
        _check_lengths_of_surface(lengths)
    else:
        _check_lengths_of_patch(lengths)


def _check_lengths_of_patch(lengths: dict[str, int]) -> None:
    if not lengths["channels"] or lengths["channels"] % 3:
        raise ModelFileError(
            f"field 'static_stiffness' has {lengths['channels']} rows: expected three for each contact"
        )
    if not lengths["order"] or lengths["order"] % 2:
        raise ModelFileError(
            f"field 'discrete_diagonal' has length {lengths['order']}: expected an even one (2x2 blocks), at least 2"
        )


def _check_lengths_of_surface(lengths: dict[str, int]) -> None:
    n = 3 * lengths["points"]
    if not lengths["points"] or not lengths["modes"]:
        raise ModelFileError(
            f"field 'shapes' is of {lengths['points']} points and {lengths['modes']} modes: expected one or more of each"
        )
    if lengths["packed"] != n * (n + 1) // 2:
        raise ModelFileError(
            f"field 'residual' has {lengths['packed']} entries: expected {n * (n + 1) // 2}, the lower triangle of a matrix "
            f"with {n} rows"
        )
