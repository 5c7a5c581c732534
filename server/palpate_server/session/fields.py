"""Reads the fields of requests. A refusal names the field and what was expected.

None in an optional field is the same as the field left out.
"""

from __future__ import annotations

import math
from dataclasses import asdict
from typing import Any, NamedTuple

import numpy as np

from palpate.model_file.surface_model import LEAST_RADIUS_M, MOST_FRICTION, MOST_RADIUS_M
from palpate_client.messages import Frame, Vector
from palpate_client.wire import (
    MAX_REQUEST_BYTES,
    SCHEMA_VERSION,
    Kind,
    MalformedMessage,
    check_kind,
    unpack_map,
)
from palpate_server.errors import Refused
from palpate_server.session.devices import PROFILES, Device

SMALLEST_SCALE, LARGEST_SCALE = 1e-3, 1e3
FARTHEST_ORIGIN_M = 10.0
LONGEST_ROUND_TRIP_S = 1.0
MOST_DEVICE_DAMPING_N_S_PER_M = 1e3
LEAST_STIFFNESS_N_PER_M, MOST_STIFFNESS_N_PER_M = 1.0, 1e5
SOFTEST, STIFFEST = 0.1, 10.0
_ORTHONORMAL = 1e-6


def read_request(payload: bytes) -> dict[str, Any]:
    """The map of a control request. Raises MalformedMessage; Refused for another schema version, or none."""
    request = unpack_map(payload, MAX_REQUEST_BYTES) if payload else {}
    version = request.get("schema_version")
    if type(version) is not int or version != SCHEMA_VERSION:
        found = "missing" if version is None else shown(version)
        raise Refused(
            "wrong_version",
            f"schema_version is {found}: this server speaks version {SCHEMA_VERSION}; upgrade the client or its "
            "library. Since version 1 a client holds `tools` instead of `contacts`, sends `position_m` in its own "
            "frame instead of `displacement_m`, and `force_n` is what the device renders, the negative of before",
        )
    check_kind(request, Kind.REQUEST)
    return request


def required(request: dict[str, Any], field: str) -> Any:
    if field not in request:
        raise MalformedMessage("missing_field", f"{field} is missing")
    return request[field]


def tools_in(request: dict[str, Any]) -> list[str]:
    tools = required(request, "tools")
    if not isinstance(tools, list) or not tools or not all(isinstance(name, str) for name in tools):
        raise MalformedMessage("wrong_type", f"tools is {shown(tools)}: expected a list of names")
    if len(set(tools)) < len(tools):
        raise MalformedMessage("wrong_shape", "tools names one of them twice")
    return tools


def frame_in(request: dict[str, Any]) -> Frame:
    """The frame of a request; fields that are missing or None are those of the identity."""
    identity = asdict(Frame())
    value = request.get("frame")
    if value is None:
        return Frame()
    if not isinstance(value, dict):
        raise MalformedMessage(
            "wrong_type", f"frame is {shown(value)}: expected a map with {', '.join(identity)}"
        )
    if unknown := set(value) - set(identity):
        raise MalformedMessage(
            "wrong_type", f"frame has {shown(sorted(map(str, unknown)))}: expected {', '.join(identity)}"
        )
    given = identity | {name: each for name, each in value.items() if each is not None}
    scale = number("frame scale", given["scale"])
    if not SMALLEST_SCALE <= scale <= LARGEST_SCALE:
        raise Refused(
            "out_of_range", f"frame scale is {scale!r}: expected {SMALLEST_SCALE:g} to {LARGEST_SCALE:g}"
        )
    origins = [_origin(name, given[name]) for name in ("client_origin_m", "model_origin_m")]
    return Frame(_rotation(given["rotation"]), scale, *origins)


def _rotation(rows: Any) -> tuple[Vector, Vector, Vector]:
    if not (isinstance(rows, list | tuple) and len(rows) == 3):
        raise MalformedMessage("wrong_type", f"frame rotation is {shown(rows)}: expected 3 rows of 3 numbers")
    x, y, z = (_vector("rotation row", row) for row in rows)
    matrix = np.array((x, y, z))
    if np.abs(matrix).max() > 2 or np.abs(matrix @ matrix.T - np.eye(3)).max() > _ORTHONORMAL:
        raise Refused("out_of_range", f"frame rotation is {shown(rows)}: expected orthonormal rows")
    if np.linalg.det(matrix) < 0:
        raise Refused(
            "out_of_range", f"frame rotation is {shown(rows)}: expected right-handed axes, determinant 1"
        )
    return x, y, z


def _origin(name: str, value: Any) -> Vector:
    point = _vector(name, value)
    if max(map(abs, point)) > FARTHEST_ORIGIN_M:
        raise Refused(
            "out_of_range",
            f"frame {name} is {list(point)}: expected no component beyond {FARTHEST_ORIGIN_M:g} m",
        )
    return point


def _vector(name: str, value: Any) -> Vector:
    if not (isinstance(value, list | tuple) and len(value) == 3):
        raise MalformedMessage("wrong_type", f"frame {name} is {shown(value)}: expected 3 numbers")
    x, y, z = (number(f"frame {name}", each) for each in value)
    return x, y, z


def device_in(request: dict[str, Any]) -> Device | None:
    name = request.get("device")
    round_trip_s = _optional_number(request, "round_trip_s", 0.0, LONGEST_ROUND_TRIP_S)
    damping = _optional_number(request, "device_damping_n_s_per_m", 0.0, MOST_DEVICE_DAMPING_N_S_PER_M)
    if name is None:
        return None
    if not (isinstance(name, str) and name in PROFILES):
        raise Refused("unknown_device", f"device is {shown(name)}: there are {', '.join(PROFILES)}")
    return Device(PROFILES[name], round_trip_s, damping)


class TipWanted(NamedTuple):
    """What a client asks for of the tips of its tools; None: as it is."""

    radius_m: float | None = None
    friction: float | None = None
    stiffness_n_per_m: float | None = None


AS_IT_IS = TipWanted()


def tip_in(request: dict[str, Any]) -> TipWanted:
    return TipWanted(
        _optional_number(request, "radius_m", LEAST_RADIUS_M, MOST_RADIUS_M),
        _optional_number(request, "friction", 0.0, MOST_FRICTION),
        _optional_number(request, "stiffness_n_per_m", LEAST_STIFFNESS_N_PER_M, MOST_STIFFNESS_N_PER_M),
    )


def stiffness_factor_in(request: dict[str, Any]) -> float:
    factor = _optional_number(request, "stiffness_factor", SOFTEST, STIFFEST)
    return 1.0 if factor is None else factor


def limits_in(request: dict[str, Any], known: tuple[str, ...]) -> dict[str, float]:
    """The limits that a request sets, of the known ones."""
    limits = required(request, "limits")
    if not isinstance(limits, dict):
        raise MalformedMessage("wrong_type", f"limits is {shown(limits)}: expected a map of numbers")
    for field in limits:
        if field not in known:
            raise Refused("unknown_limit", f"no limit is called {shown(field)}: there are {', '.join(known)}")
    return {field: number(field, value) for field, value in limits.items()}


def number(field: str, value: object) -> float:
    if not isinstance(value, int | float) or isinstance(value, bool):
        raise MalformedMessage("wrong_type", f"{field} is {shown(value)}: expected a number")
    if not abs(value) < math.inf:
        raise Refused("out_of_range", f"{field} is {value!r}: expected a finite number")
    return float(value)


def _optional_number(request: dict[str, Any], field: str, least: float, most: float) -> float | None:
    given = request.get(field)
    if given is None:
        return None
    value = number(field, given)
    if not least <= value <= most:
        raise Refused("out_of_range", f"{field} is {value:g}: expected {least:g} to {most:g}")
    return value


def shown(value: object) -> str:
    """A client's value for a message: escaped, and at most 200 characters."""
    return repr(value)[:200]
