"""From a device's frame to the model's and back: the one place where the two meet."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate_server.realtime.compiled import compiled

Floats = NDArray[np.float64]

_ORTHONORMAL = 1e-6
SMALLEST_SCALE, LARGEST_SCALE = 1e-3, 1e3
FARTHEST_ORIGIN_M = 10.0


@dataclass(frozen=True)
class Frame:
    """displacement in the model = scale · rotation · (device position - origin_m).

    rotation  (3, 3) rows, orthonormal, device axes to model axes
    scale     1e-3 to 1e3: how much larger motion is in the model than at the device
    origin_m  the device position at which the tip is at rest on the undeformed surface, within 10 m an axis

    Forces go back as scale · rotation^T · force, so that power is the same on both sides: the frame neither adds
    energy to a device nor takes any.
    """

    rotation: tuple[tuple[float, float, float], ...] = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    scale: float = 1.0
    origin_m: tuple[float, float, float] = (0.0, 0.0, 0.0)


IDENTITY = Frame()


def read_frame(value: object) -> Frame:
    """A frame from a message's map; fields that are missing are those of the identity.

    Raises TypeError for what is no frame, ValueError for one that can't be; both name the field, its value and what was
    expected.
    """
    if value is None:
        return IDENTITY
    if not isinstance(value, dict):
        raise TypeError(f"frame is {value!r}: expected a map with rotation, scale, origin_m")
    unknown = set(value) - {"rotation", "scale", "origin_m"}
    if unknown:
        raise TypeError(
            f"frame has {', '.join(sorted(map(str, unknown)))}: expected rotation, scale, origin_m"
        )
    rows = value.get("rotation", IDENTITY.rotation)
    if not (isinstance(rows, list | tuple) and len(rows) == 3):
        raise TypeError(f"frame rotation is {rows!r}: expected 3 rows of 3 numbers")
    rotation = tuple(_three("rotation row", row) for row in rows)
    matrix = np.array(rotation)
    if np.abs(matrix @ matrix.T - np.eye(3)).max() > _ORTHONORMAL or np.linalg.det(matrix) < 0:
        raise ValueError(f"frame rotation is {rows!r}: expected an orthonormal, right-handed matrix")
    scale = value.get("scale", 1.0)
    if not _is_number(scale):
        raise TypeError(f"frame scale is {scale!r}: expected a number")
    if not SMALLEST_SCALE <= scale <= LARGEST_SCALE:
        raise ValueError(f"frame scale is {scale!r}: expected {SMALLEST_SCALE:g} to {LARGEST_SCALE:g}")
    origin = _three("origin_m", value.get("origin_m", (0.0, 0.0, 0.0)))
    if max(map(abs, origin)) > FARTHEST_ORIGIN_M:
        raise ValueError(
            f"frame origin_m is {list(origin)}: expected no component beyond {FARTHEST_ORIGIN_M:g} m"
        )
    return Frame(rotation, float(scale), origin)


def _three(name: str, value: Any) -> tuple[float, float, float]:
    if not (isinstance(value, list | tuple) and len(value) == 3 and all(_is_number(v) for v in value)):
        raise TypeError(f"frame {name} is {value!r}: expected 3 finite numbers")
    x, y, z = value
    return float(x), float(y), float(z)


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


@compiled
def to_model(rotation: Floats, scale: float, origin: Floats, position: Floats, displacement: Floats) -> None:
    """Write the model displacement (3,) of a device position (3,) into `displacement`, m."""
    for i in range(3):
        total = 0.0
        for j in range(3):
            total += rotation[i, j] * (position[j] - origin[j])
        displacement[i] = scale * total


@compiled
def to_device(rotation: Floats, scale: float, model_force: Floats, force: Floats) -> None:
    """Write the device force (3,) of a model force (3,) into `force`, N."""
    for i in range(3):
        total = 0.0
        for j in range(3):
            total += rotation[j, i] * model_force[j]
        force[i] = scale * total
