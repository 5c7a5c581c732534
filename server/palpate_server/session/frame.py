"""A client's frame: how its axes, lengths and origin relate to the model's."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

Vector = tuple[float, float, float]

_ORTHONORMAL = 1e-6
SMALLEST_SCALE, LARGEST_SCALE = 1e-3, 1e3
FARTHEST_ORIGIN_M = 10.0


@dataclass(frozen=True)
class ClientFrame:
    """position in the model = model_origin_m + scale · rotation · (client position - client_origin_m).

    rotation         3 rows, orthonormal, client axes to model axes
    scale            1e-3 to 1e3: how much larger motion is in the model than at the client
    client_origin_m  a point in the client's frame, within 10 m an axis
    model_origin_m   the point of the model that it stands for, within 10 m an axis

    Forces go back as scale · rotation^T · force, so that power is the same on both sides: the frame neither adds
    energy to a device nor takes any.
    """

    rotation: tuple[Vector, ...] = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    scale: float = 1.0
    client_origin_m: Vector = (0.0, 0.0, 0.0)
    model_origin_m: Vector = (0.0, 0.0, 0.0)

    def home_m(self, start_m: Sequence[float]) -> Vector:
        """The client position (3,), m, of a point (3,) of the model: of the tool's start."""
        from_origin = np.array(start_m) - self.model_origin_m
        x, y, z = self.client_origin_m + np.array(self.rotation).T @ from_origin / self.scale
        return float(x), float(y), float(z)


IDENTITY = ClientFrame()
_FIELDS = tuple(field.name for field in fields(ClientFrame))


def read_frame(value: object) -> ClientFrame:
    """A frame from a request's map; fields that are missing or None are those of the identity.

    Raises TypeError for what is no frame, ValueError for numbers that can't be one; both name the field, its value and
    what was expected.
    """
    if value is None:
        return IDENTITY
    if not isinstance(value, dict):
        raise TypeError(f"frame is {_shown(value)}: expected a map with {', '.join(_FIELDS)}")
    if unknown := set(value) - set(_FIELDS):
        raise TypeError(f"frame has {_shown(sorted(unknown))}: expected {', '.join(_FIELDS)}")
    given = {name: each for name, each in value.items() if each is not None}
    return ClientFrame(
        _rotation(given.get("rotation", IDENTITY.rotation)),
        _scale(given.get("scale", IDENTITY.scale)),
        _point("client_origin_m", given.get("client_origin_m", IDENTITY.client_origin_m)),
        _point("model_origin_m", given.get("model_origin_m", IDENTITY.model_origin_m)),
    )


def _rotation(rows: Any) -> tuple[Vector, ...]:
    if not (isinstance(rows, list | tuple) and len(rows) == 3):
        raise TypeError(f"frame rotation is {_shown(rows)}: expected 3 rows of 3 numbers")
    rotation = tuple(_three("rotation row", row) for row in rows)
    matrix = np.array(rotation)
    if np.abs(matrix).max() > 2 or np.abs(matrix @ matrix.T - np.eye(3)).max() > _ORTHONORMAL:
        raise ValueError(f"frame rotation is {_shown(rows)}: expected orthonormal rows")
    if np.linalg.det(matrix) < 0:
        raise ValueError(f"frame rotation is {_shown(rows)}: expected right-handed axes, determinant 1")
    return rotation


def _scale(scale: Any) -> float:
    if not _is_number(scale):
        raise TypeError(f"frame scale is {_shown(scale)}: expected a number")
    if not SMALLEST_SCALE <= scale <= LARGEST_SCALE:
        raise ValueError(f"frame scale is {scale!r}: expected {SMALLEST_SCALE:g} to {LARGEST_SCALE:g}")
    return float(scale)


def _point(name: str, value: Any) -> Vector:
    point = _three(name, value)
    if max(map(abs, point)) > FARTHEST_ORIGIN_M:
        raise ValueError(
            f"frame {name} is {list(point)}: expected no component beyond {FARTHEST_ORIGIN_M:g} m"
        )
    return point


def _three(name: str, value: Any) -> Vector:
    if not (isinstance(value, list | tuple) and len(value) == 3 and all(map(_is_number, value))):
        raise TypeError(f"frame {name} is {_shown(value)}: expected 3 finite numbers")
    x, y, z = value
    return float(x), float(y), float(z)


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _shown(value: object) -> str:
    return repr(value)[:200]
