"""The fields of a request: each is read, or the request is refused by the name of the field and what was expected.

None in an optional field is the same as the field left out.
"""

from __future__ import annotations

import math
from typing import Any

from palpate_client.wire import (
    MAX_REQUEST_BYTES,
    SCHEMA_VERSION,
    Kind,
    MalformedMessage,
    check_kind,
    unpack_map,
)
from palpate_server.session.devices import PROFILES, Device
from palpate_server.session.frame import ClientFrame, read_frame
from palpate_server.session.leases import Refused


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


def needed(request: dict[str, Any], field: str) -> Any:
    if field not in request:
        raise MalformedMessage("missing_field", f"{field} is missing")
    return request[field]


def tools_in(request: dict[str, Any]) -> list[str]:
    tools = needed(request, "tools")
    if not isinstance(tools, list) or not tools or not all(isinstance(name, str) for name in tools):
        raise MalformedMessage("wrong_type", f"tools is {shown(tools)}: expected a list of names")
    if len(set(tools)) < len(tools):
        raise MalformedMessage("wrong_shape", "tools names one of them twice")
    return tools


def frame_in(request: dict[str, Any]) -> ClientFrame:
    try:
        return read_frame(request.get("frame"))
    except TypeError as error:
        raise MalformedMessage("wrong_type", str(error)) from error
    except ValueError as error:
        raise Refused("out_of_range", str(error)) from error


def device_in(request: dict[str, Any]) -> Device | None:
    name = request.get("device")
    round_trip_s = _optional_number(request, "round_trip_s")
    damping = _optional_number(request, "device_damping_n_s_per_m")
    if name is None:
        return None
    if not (isinstance(name, str) and name in PROFILES):
        raise Refused("unknown_device", f"device is {shown(name)}: there are {', '.join(PROFILES)}")
    return Device(PROFILES[name], round_trip_s, damping)


def limits_in(request: dict[str, Any], known: tuple[str, ...]) -> dict[str, float]:
    """The limits that a request sets, of the known ones."""
    limits = needed(request, "limits")
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


def _optional_number(request: dict[str, Any], field: str) -> float | None:
    given = request.get(field)
    if given is None:
        return None
    value = number(field, given)
    if value < 0:
        raise Refused("out_of_range", f"{field} is {value:g}: expected at least 0")
    return value


def shown(value: object) -> str:
    """A client's value as a message repeats it: escaped, and not longer than a line."""
    return repr(value)[:200]
