"""The server's messages as typed records. Every vector is (x, y, z).

Geometry and surface are decoded into `array.array`, which numpy wraps without a copy:
`numpy.frombuffer(geometry.vertices_m, "f4").reshape(-1, 3)`.
"""

from __future__ import annotations

import sys
from array import array
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, NamedTuple

from palpate_client import wire

Vector = tuple[float, float, float]


@dataclass(frozen=True)
class Frame:
    """How a client's axes and unit relate to the model's.

    model position = model_origin_m + scale * rotation * (client position - client_origin_m)
    force at the client = scale * rotation^T * force in the model

    rotation: three rows, client axes to model axes; orthonormal and right-handed.
    """

    rotation: tuple[Vector, Vector, Vector] = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    scale: float = 1.0
    client_origin_m: Vector = (0.0, 0.0, 0.0)
    model_origin_m: Vector = (0.0, 0.0, 0.0)

    def direction_at_client(self, direction: Sequence[float]) -> Vector:
        """A direction of the model along the client's axes; its length stays."""
        columns = zip(*self.rotation, strict=True)
        x, y, z = (sum(r * d for r, d in zip(column, direction, strict=True)) for column in columns)
        return x, y, z

    def point_at_client(self, point_m: Sequence[float]) -> Vector:
        """A point of the model, m, in the client's frame, m."""
        x, y, z = self.direction_at_client([p - o for p, o in zip(point_m, self.model_origin_m, strict=True)])
        a, b, c = self.client_origin_m
        return a + x / self.scale, b + y / self.scale, c + z / self.scale

    def message(self) -> dict[str, Any]:
        return asdict(self)


@dataclass(frozen=True)
class ToolDescription:
    """A tool of the model: `start_m` is the point of the undeformed tissue that it touches, `normal` points outwards (unit)."""

    name: str
    start_m: Vector
    normal: Vector
    radius_m: float


@dataclass(frozen=True)
class Description:
    """The answer to `describe`: what a client needs of it, and the whole `message`."""

    tools: tuple[ToolDescription, ...]
    period_s: float
    hold_s: float
    decay_s: float
    max_force_n: float
    max_force_rate_n_per_s: float
    config_sha256: str
    message: Mapping[str, Any]

    def index(self, tool: str) -> int:
        """Place of a tool in the lists of a force message. Raises ValueError with the names that there are."""
        names = [t.name for t in self.tools]
        if tool not in names:
            raise ValueError(f"no tool is called {tool!r}: there are {', '.join(names)}")
        return names.index(tool)


def read_description(message: Mapping[str, Any]) -> Description:
    """The description in the decoded answer to `describe`. Raises KeyError or TypeError when it lacks something."""
    limits = message["limits"]
    return Description(
        tools=tuple(
            ToolDescription(t["name"], tuple(t["start_m"]), tuple(t["normal"]), t["radius_m"])
            for t in message["tools"]
        ),
        period_s=message["period_s"],
        hold_s=message["hold_s"],
        decay_s=message["decay_s"],
        max_force_n=limits["max_force_n"],
        max_force_rate_n_per_s=limits["max_force_rate_n_per_s"],
        config_sha256=message["model"]["config_sha256"],
        message=message,
    )


class Touch(NamedTuple):
    """How one tool touches the tissue, and the energies since the tissue was at rest, J; all as in docs/wire.md.

    normal: of the contact, outward, of length 1, in the client's frame; zero without a contact.
    """

    normal: Sequence[float]
    penetration_m: float
    slip_m: float
    n_contact_points: int
    work_j: float
    stored_j: float
    dissipated_j: float
    withheld_j: float


NO_TOUCH = Touch((0.0, 0.0, 0.0), 0.0, 0.0, 0, 0.0, 0.0, 0.0, 0.0)


class Force(NamedTuple):
    """One tool's part of a force message; the fields are those of docs/wire.md.

    position_m: where the tip was applied, m, in the client's frame.
    force_n: what the device renders, N, in the client's frame: the force of the tissue on the tool.
    arrival_ns: when the message came, on our monotonic clock.
    touch: how the tool touches the tissue.
    """

    tick: int
    server_time_ns: int
    sequence: int
    client_time_ns: int
    input_age_ns: int
    flags: int
    position_m: Sequence[float]
    force_n: Sequence[float]
    force_scale: float
    energy_j: float
    arrival_ns: int
    touch: Touch = NO_TOUCH


def check_force(message: Mapping[str, Any], n_tools: int) -> None:
    """Raises wire.MalformedMessage unless a decoded force message has all its fields, as long as for this many tools."""
    for name, (width, kind) in wire.FORCE_FIELDS.items():
        value: Any = message.get(name)
        if width == wire.PER_TICK:
            good = type(value) is kind
        elif width == 1:
            good = _is_list(value, n_tools, kind)
        else:
            good = _is_list(value, n_tools, list)
            for row in value if good else ():
                good = good and _is_list(row, width, kind)
        if not good:
            raise wire.MalformedMessage(
                "wrong_type", f"{name} is {value!r:.100}: expected it as in docs/wire.md"
            )


def _is_list(value: Any, length: int, kind: type) -> bool:
    return type(value) is list and [*map(type, value)] == [kind] * length


_STATUS_TYPES: Mapping[str, type] = {
    **dict.fromkeys(("state",), str),
    **dict.fromkeys(("number", "server_time_ns", "ticks", "accepted"), int),
    **dict.fromkeys(("model", "refused", "malformed", "dropped", "tools"), dict),
}


def check_status(message: Mapping[str, Any]) -> None:
    """Raises wire.MalformedMessage for a decoded status without the fields that clients look at."""
    for name, kind in _STATUS_TYPES.items():
        if type(message.get(name)) is not kind:
            raise wire.MalformedMessage("wrong_type", f"{name} of a status: expected {kind.__name__}")
    recording = message.get("recording")
    if not (recording is None or (isinstance(recording, dict) and {"file", "error"} <= recording.keys())):
        raise wire.MalformedMessage("wrong_type", "recording of a status: expected nil, or a map")


def read_force(message: Mapping[str, Any], index: int, arrival_ns: int) -> Force:
    """The force of the tool at `index` in a decoded message."""
    return Force(
        message["tick"],
        message["server_time_ns"],
        message["sequence"][index],
        message["client_time_ns"][index],
        message["input_age_ns"][index],
        message["flags"][index],
        message["position_m"][index],
        message["force_n"][index],
        message["force_scale"][index],
        message["energy_j"][index],
        arrival_ns,
        Touch(*(message[name][index] for name in Touch._fields)),
    )


@dataclass(frozen=True)
class Geometry:
    """The surface at rest.

    vertices_m: 3 n_vertices float32, m, in the model's frame; x, y, z of vertex 0 first.
    triangles: 3 n_triangles int32, indices of vertices; counter-clockwise seen from outside.
    error_in_band: n_vertices float32, how good the model is at each vertex; None when the server doesn't know.
    """

    vertices_m: array[float]
    triangles: array[int]
    error_in_band: array[float] | None = None


@dataclass(frozen=True)
class Surface:
    """Displacement of every vertex of the geometry from rest at a tick: 3 n_vertices float32, m."""

    tick: int
    server_time_ns: int
    displacement_m: array[float]


def decode_geometry(payload: bytes) -> Geometry:
    """Raises wire.MalformedMessage."""
    message = wire.unpack(payload, wire.Kind.GEOMETRY)
    vertices = _numbers(message, "vertices_m", "f", "n_vertices")
    triangles = _numbers(message, "triangles", "i", "n_triangles")
    error = None
    if message.get("error_in_band") is not None:
        error = _numbers(message, "error_in_band", "f", "n_vertices", width=1)
    return Geometry(vertices, triangles, error)


def decode_surface(payload: bytes) -> Surface:
    """Raises wire.MalformedMessage."""
    return read_surface(wire.unpack(payload, wire.Kind.SURFACE))


def read_surface(message: Mapping[str, Any]) -> Surface:
    """The surface in a decoded message. Raises wire.MalformedMessage."""
    displacement = _numbers(message, "displacement_m", "f")
    try:
        return Surface(message["tick"], message["server_time_ns"], displacement)
    except KeyError as error:
        raise wire.MalformedMessage("missing_field", f"{error.args[0]} is missing") from None


def _numbers(
    message: Mapping[str, Any], field: str, typecode: str, rows_field: str | None = None, width: int = 3
) -> array[Any]:
    """The little-endian numbers of a field, `width` a row; rows_field says how many rows there are."""
    value = message.get(field)
    row_bytes = 4 * width
    if not isinstance(value, bytes) or len(value) % row_bytes:
        raise wire.MalformedMessage("wrong_type", f"{field}: expected bytes, rows of {row_bytes} bytes")
    if rows_field is not None and message.get(rows_field) != len(value) // row_bytes:
        raise wire.MalformedMessage(
            "wrong_shape",
            f"{field} has {len(value) // row_bytes} rows: expected {rows_field}, {message.get(rows_field)}",
        )
    numbers = array(typecode, value)
    if sys.byteorder == "big":
        numbers.byteswap()
    return numbers
