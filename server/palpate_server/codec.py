"""What only the server needs of the wire: reading commands, and encoding forces, surfaces and geometry.

Keys, kinds, reasons and bounds are those of `palpate_client.wire`.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, NamedTuple, Protocol

import msgpack
import numpy as np
from numpy.typing import NDArray

from palpate_client.wire import (
    FORCE_FIELDS,
    MAX_COMMAND_BYTES,
    MAX_INTEGER,
    PER_TICK,
    SCHEMA_VERSION,
    Kind,
    MalformedMessage,
    pack,
    unpack,
)
from palpate_server.realtime.compiled import compiled
from palpate_server.realtime.records import PORT_RECORD, TICK

Vector = tuple[float, float, float]
STILL: Vector = (0.0, 0.0, 0.0)


class Payload(Protocol):
    """As much of a Zenoh payload as is read of it: its size, before it is copied."""

    def __len__(self) -> int: ...

    def to_bytes(self) -> bytes: ...


class Command(NamedTuple):
    """Where a client's tool tips are: position and velocity of named tools, in the client's frame.

    velocity_m_per_s has exactly the tools of position_m, attach none that it has not; rendered_tick is the tick whose force the device was rendering
    until now, -1 when the client does not tell.
    """

    sequence: int
    client_time_ns: int
    position_m: Mapping[str, Vector]
    velocity_m_per_s: Mapping[str, Vector]
    rendered_tick: int = -1
    attach: Mapping[str, bool] = MappingProxyType({})


def decode_command(payload: bytes) -> Command:
    """The command in a payload; its numbers may be infinite or NaN. Raises MalformedMessage.

    Unknown fields are ignored, so that the schema can grow. None in an optional field is the same as the field left out.
    """
    message = unpack(payload, Kind.COMMAND, MAX_COMMAND_BYTES)
    try:
        sequence, client_time_ns = message["sequence"], message["client_time_ns"]
        position = _vectors("position_m", message["position_m"])
    except KeyError as error:
        raise MalformedMessage("missing_field", f"{error.args[0]} is missing") from None
    if not position:
        raise MalformedMessage("wrong_shape", "position_m is empty: expected at least one tool")
    velocity = dict.fromkeys(position, STILL)
    if (given := message.get("velocity_m_per_s")) is not None:
        velocity |= _vectors("velocity_m_per_s", given)
        if len(velocity) > len(position):
            raise MalformedMessage("wrong_shape", "velocity_m_per_s names tools that position_m does not")
    _check_integer("sequence", sequence)
    _check_integer("client_time_ns", client_time_ns)
    if (rendered_tick := message.get("rendered_tick")) is None:
        rendered_tick = -1
    else:
        _check_integer("rendered_tick", rendered_tick)
    if (attach := message.get("attach")) is None:
        return Command(sequence, client_time_ns, position, velocity, rendered_tick)
    _check_attach(attach, position)
    return Command(sequence, client_time_ns, position, velocity, rendered_tick, attach)


def _check_attach(attach: object, position: Mapping[str, Vector]) -> None:
    if type(attach) is not dict or not all(type(value) is bool for value in attach.values()):
        raise MalformedMessage(
            "wrong_type", f"attach is {attach!r:.100}: expected a map of tools to true or false"
        )
    if not attach.keys() <= position.keys():
        raise MalformedMessage("wrong_shape", "attach names tools that position_m does not")


def _check_integer(name: str, value: object) -> None:
    if type(value) is not int or not 0 <= value <= MAX_INTEGER:
        raise MalformedMessage("wrong_type", f"{name} is {value!r}: expected an integer, 0 to 2^63 - 1")


def _vectors(field: str, value: object) -> dict[str, Vector]:
    if type(value) is not dict:
        raise MalformedMessage("wrong_type", f"{field} is a {type(value).__name__}: expected a map")
    vectors: dict[str, Vector] = {}
    for name, vector in value.items():
        if type(vector) is not list or len(vector) != 3:
            raise MalformedMessage("wrong_shape", f"{field} of {name!r}: expected 3 numbers")
        x, y, z = vector
        if type(x) is float and type(y) is float and type(z) is float:
            vectors[name] = x, y, z
        elif all(type(number) is float or type(number) is int for number in vector):
            vectors[name] = float(x), float(y), float(z)
        else:
            raise MalformedMessage("wrong_type", f"{field} of {name!r} is {vector!r}: expected numbers")
    return vectors


def _words(record: np.dtype[np.void]) -> dict[str, int]:
    return {name: offset // 8 for name, (_, offset, *_) in (record.fields or {}).items()}


_TICK_WORDS = _words(TICK) | {"server_time_ns": _words(TICK)["start_ns"]}
_PORT_WORDS = _words(PORT_RECORD)
_MARKERS = {int: b"\xd3", float: b"\xcb"}  # msgpack's for int64 and float64
_ONE, _THREE = 9, 28  # bytes of a number, of an array of three


class ForceEncoder:
    """Encodes force messages for `n_tools` tools, a thousand a second: every number has its place in a template.

    Integers are written as int64 and numbers as float64, always; so the length of a message is constant.
    """

    def __init__(self, n_tools: int) -> None:
        packer = msgpack.Packer()
        template = bytearray(packer.pack_map_header(1 + len(FORCE_FIELDS)))
        template += packer.pack("kind") + packer.pack(Kind.FORCE.value)
        self._layout = np.zeros((len(FORCE_FIELDS), 3), np.int64)
        for i, (name, (numbers, number_type)) in enumerate(FORCE_FIELDS.items()):
            template += packer.pack(name)
            one = _MARKERS[number_type] + bytes(8)
            if numbers != PER_TICK:
                template += packer.pack_array_header(n_tools)
            word = _TICK_WORDS[name] if numbers == PER_TICK else _PORT_WORDS[name]
            self._layout[i] = len(template), numbers, word
            item = packer.pack_array_header(3) + 3 * one if numbers == 3 else one
            template += item * (1 if numbers == PER_TICK else n_tools)
        self._message = np.frombuffer(bytes(template), np.uint8).copy()

    def encode(self, tick: NDArray[np.int64], ports: NDArray[np.int64]) -> bytes:
        """One tick's answer; tick (words,) and ports (n_tools, words), of `as_words`, in the order of the describe reply."""
        _fill_force(self._message, self._layout, tick, ports)
        return self._message.tobytes()


def as_words(records: NDArray[np.void]) -> NDArray[np.int64]:
    """Records (...,), TICK or PORT_RECORD, as words of 8 bytes, (..., words), in the same memory."""
    return records.view(np.int64).reshape(*records.shape, -1)


@compiled
def _fill_force(
    message: NDArray[np.uint8],
    layout: NDArray[np.int64],
    tick: NDArray[np.int64],
    ports: NDArray[np.int64],
) -> None:
    """Write a tick's numbers, big-endian, behind their markers in the message.

    layout (fields, 3): a field's place in the message, how many numbers it has a tool, its first word in the record
    """
    for field in range(layout.shape[0]):
        place, numbers, word = layout[field]
        if numbers == PER_TICK:
            _write(message, place, tick[word])
            continue
        for tool in range(ports.shape[0]):
            if numbers == 3:
                for axis in range(3):
                    _write(message, place + _THREE * tool + 1 + _ONE * axis, ports[tool, word + axis])
            else:
                _write(message, place + _ONE * tool, ports[tool, word])


@compiled
def _write(message: NDArray[np.uint8], place: int, value: int) -> None:
    for k in range(8):
        message[place + 1 + k] = (value >> (56 - 8 * k)) & 255


def encode_surface(tick: int, server_time_ns: int, displacement: NDArray[np.float32]) -> bytes:
    """Displacement of every surface vertex, (3 n_vertices,) m, x y z of vertex 0 first, as little-endian float32."""
    return pack(
        {
            "kind": Kind.SURFACE,
            "tick": tick,
            "server_time_ns": server_time_ns,
            "displacement_m": displacement.astype("<f4", copy=False).tobytes(),
        }
    )


def encode_geometry(
    vertices: NDArray[np.float64],
    triangles: NDArray[np.int32],
    error_in_band: NDArray[np.float32] | None = None,
) -> bytes:
    """The surface at rest: vertices (n_vertices, 3), m, as little-endian float32; triangles (n, 3) as int32.

    error_in_band (n_vertices,), a fraction, is left out when it is not known.
    """
    message: dict[str, Any] = {
        "kind": Kind.GEOMETRY,
        "schema_version": SCHEMA_VERSION,
        "n_vertices": len(vertices),
        "n_triangles": len(triangles),
        "vertices_m": vertices.astype("<f4").tobytes(),
        "triangles": triangles.astype("<i4").tobytes(),
    }
    if error_in_band is not None:
        message["error_in_band"] = error_in_band.astype("<f4").tobytes()
    return pack(message)
