"""The members of a model file: names, dtypes, shapes, bounds and checksum. Shared by the writer and the reader."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import Any

from numpy.typing import NDArray

from palpate.model_file.types import ModelFileError, ReducedModel

METADATA, CHECKSUM = "metadata", "sha256"  # the members beside the arrays, both uint8

MAX_METADATA_BYTES = 2**20
MAX_TOTAL_BYTES = 2**29
"""Bound on the unpacked size of a file, 512 MiB. The largest models expected, 1,200 states and a surface of 15,000
vertices, unpack to 220 MiB."""

_STATE_SPACE: dict[str, tuple[str, ...]] = {
    "diagonal": ("order",),
    "cross": ("order",),
    "b": ("order", "channels"),
    "c": ("channels", "order"),
    "d": ("channels", "channels"),
}

ARRAYS: dict[str, tuple[str, tuple[str, ...]]] = {
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
"""dtype and shape of each array of a model. A name in a shape stands for the same length wherever it occurs."""


def arrays_of(model: ReducedModel) -> dict[str, NDArray[Any]]:
    """The arrays of a model under the names of their members."""
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


def check_shapes(headers: dict[str, Header]) -> None:
    """Check that the arrays of one model fit each other. Raises ModelFileError that names the first that does not."""
    lengths: dict[str, int] = {"3": 3}
    for name, (dtype, dimensions) in ARRAYS.items():
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
    if not lengths["channels"] or lengths["channels"] % 3:
        raise ModelFileError(
            f"field 'static_stiffness' has {lengths['channels']} rows: expected three for each contact"
        )
    if not lengths["order"] or lengths["order"] % 2:
        raise ModelFileError(
            f"field 'discrete_diagonal' has length {lengths['order']}: expected an even one (2x2 blocks), at least 2"
        )
