"""Key expressions and messages: the only module that knows what the bytes on the wire look like.

Every payload is one msgpack map; quantities are SI, with the unit in the field's name. `docs/wire.md` is this module for
people who write clients in other languages, and a test holds the two together.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import msgpack
import numpy as np
from numpy.typing import NDArray

from palpate_server.realtime.compiled import compiled

SCHEMA_VERSION = 1
ACTIONS = ("acquire", "release", "limits", "reset", "load", "record")  # of control queries
ENCODING = "application/msgpack;palpate.v1"
MAX_COMMAND_BYTES = 4096
MAX_REQUEST_BYTES = 16384
MAX_RECORDED_BYTES = 2**20
FARTHEST_M, FASTEST_M_PER_S = 1e3, 1e3  # no device is there: what is beyond is a mistake

_NAME = re.compile(r"[A-Za-z0-9_-]{1,64}")
_MAX_INT64 = 2**63 - 1

Vector = tuple[float, float, float]
STILL: Vector = (0.0, 0.0, 0.0)


class MalformedMessage(ValueError):
    """A payload that breaks the schema. `reason` is one of MALFORMED, the message says what was wrong."""

    def __init__(self, reason: str, message: str) -> None:
        super().__init__(message)
        self.reason = reason


# Why a payload can't be read, why an accepted command or a force went no further, and why a readable command is not
# carried out: the counters in the status message.
MALFORMED = ("too_large", "not_msgpack", "not_a_map", "missing_field", "wrong_type", "wrong_shape")
DROPPED = ("superseded", "unsent_force")
REFUSED = ("not_finite", "out_of_range", "unknown_contact", "not_holder", "old_sequence", "stopping")
# Why a query that could be read is not granted.
NOT_GRANTED = (
    "out_of_range",
    "unknown_action",
    "unknown_contact",
    "unknown_device",
    "unknown_limit",
    "not_alive",
    "held",
    "not_holder",
    "busy",
    "stopping",
    "bad_model",
    "no_recordings",
    "bad_file",
    "exists",
    "not_recording",
    "internal",
)


@dataclass(frozen=True)
class Keys:
    """The key expressions of one session; a session's name is 1 to 64 of A-Z a-z 0-9 _ -."""

    session: str

    def __post_init__(self) -> None:
        if not is_name(self.session):
            raise ValueError(f"session is {self.session!r}: expected 1 to 64 of A-Z a-z 0-9 _ -")

    @property
    def prefix(self) -> str:
        return f"palpate/{self.session}"

    @property
    def server(self) -> str:
        """Liveliness token of the server."""
        return f"{self.prefix}/server"

    def client(self, name: str) -> str:
        """Liveliness token of a client: its contacts are its own for as long as this stands."""
        return f"{self.prefix}/client/{name}"

    def command(self, client: str) -> str:
        return f"{self.prefix}/command/{client}"

    @property
    def force(self) -> str:
        return f"{self.prefix}/force"

    @property
    def status(self) -> str:
        return f"{self.prefix}/status"

    @property
    def surface(self) -> str:
        return f"{self.prefix}/surface"

    @property
    def describe(self) -> str:
        return f"{self.prefix}/describe"

    @property
    def geometry(self) -> str:
        return f"{self.prefix}/geometry"

    def control(self, client: str, action: str) -> str:
        """The client is in the key, so that access control can bind a name to a certificate."""
        return f"{self.prefix}/control/{client}/{action}"


class Command(NamedTuple):
    """Where a client's tool tips are: displacement and velocity of named contacts, in the client's frame.

    velocity_m_per_s has exactly the contacts of displacement_m; rendered_tick is the tick whose force the device was
    rendering until now, -1 when the client does not tell.
    """

    sequence: int
    client_time_ns: int
    displacement_m: Mapping[str, Vector]
    velocity_m_per_s: Mapping[str, Vector]
    rendered_tick: int = -1


def is_name(text: object) -> bool:
    """True for what may stand in a key expression as one chunk: 1 to 64 of A-Z a-z 0-9 _ -."""
    return isinstance(text, str) and _NAME.fullmatch(text) is not None


def last_chunk(key: str) -> str:
    return key.rpartition("/")[2]


def client_and_action(control_key: str) -> tuple[str, str]:
    _, client, action = control_key.rsplit("/", 2)
    return client, action


def pack(message: Mapping[str, Any]) -> bytes:
    return msgpack.packb(message)


def unpack_map(payload: bytes, max_bytes: int) -> dict[str, Any]:
    """Read a map with string keys, bounded in size before anything is decoded. Raises MalformedMessage."""
    check_size(len(payload), max_bytes)
    try:
        message = msgpack.unpackb(payload, raw=False, strict_map_key=True)
    except (ValueError, RecursionError, OverflowError) as error:
        raise MalformedMessage("not_msgpack", f"payload is not one msgpack value ({error})") from error
    except Exception as error:  # the decoder is fed whatever the network brings: no cause may get past it
        raise MalformedMessage("not_msgpack", f"payload can't be decoded ({error!r})") from error
    if type(message) is not dict:
        raise MalformedMessage("not_a_map", f"payload is a {type(message).__name__}: expected a map")
    return message


def check_size(n_bytes: int, max_bytes: int) -> None:
    """Raises MalformedMessage when a payload is larger than it may be: to be asked before it is copied or decoded."""
    if n_bytes > max_bytes:
        raise MalformedMessage("too_large", f"payload has {n_bytes} bytes: expected at most {max_bytes}")


def decode_command(payload: bytes) -> Command:
    """Read a tool command; numbers may be infinite or NaN (a refusal, not a malformed message).

    Raises MalformedMessage. Fields that are not known are ignored, so that the schema can grow.
    """
    return read_command(unpack_map(payload, MAX_COMMAND_BYTES))


def read_command(message: Mapping[str, Any]) -> Command:
    """The tool command in a decoded map. Raises MalformedMessage."""
    try:
        sequence, client_time_ns = message["sequence"], message["client_time_ns"]
        displacement = _vectors("displacement_m", message["displacement_m"])
    except KeyError as error:
        raise MalformedMessage("missing_field", f"{error.args[0]} is missing") from None
    if not displacement:
        raise MalformedMessage("wrong_shape", "displacement_m is empty: expected at least one contact")
    velocity = dict.fromkeys(displacement, STILL)
    if "velocity_m_per_s" in message:
        given = _vectors("velocity_m_per_s", message["velocity_m_per_s"])
        if not given.keys() <= displacement.keys():
            raise MalformedMessage(
                "wrong_shape", "velocity_m_per_s names contacts that displacement_m does not"
            )
        velocity |= given
    rendered_tick = message.get("rendered_tick", 0)
    for name, value in (
        ("sequence", sequence),
        ("client_time_ns", client_time_ns),
        ("rendered_tick", rendered_tick),
    ):
        if type(value) is not int or not 0 <= value <= _MAX_INT64:
            raise MalformedMessage("wrong_type", f"{name} is {value!r}: expected an integer, 0 to 2^63 - 1")
    told = "rendered_tick" in message
    return Command(sequence, client_time_ns, displacement, velocity, rendered_tick if told else -1)


def is_finite(command: Command) -> bool:
    for vectors in (command.displacement_m, command.velocity_m_per_s):
        for x, y, z in vectors.values():
            if x - x + y - y + z - z != 0.0:  # infinity minus itself is not a number either
                return False
    return True


def is_in_range(command: Command) -> bool:
    """True when no component is beyond FARTHEST_M and FASTEST_M_PER_S: nothing computed from it overflows."""
    for vectors, largest in (
        (command.displacement_m, FARTHEST_M),
        (command.velocity_m_per_s, FASTEST_M_PER_S),
    ):
        for x, y, z in vectors.values():
            if not (abs(x) <= largest and abs(y) <= largest and abs(z) <= largest):
                return False
    return True


class ForceEncoder:
    """Makes force messages for `n_contacts` contacts, a thousand a second: every number has its place in a template.

    Integers are written as int64 and numbers as float64, always; so the length of a message is constant.
    """

    def __init__(self, n_contacts: int) -> None:
        template = bytearray()
        self._places = np.zeros(len(_FORCE_FIELDS), np.int64)
        template += msgpack.Packer().pack_map_header(len(_FORCE_FIELDS))
        for i, (name, (per_contact, marker)) in enumerate(_FORCE_FIELDS.items()):
            template += msgpack.packb(name)
            if per_contact:
                template += msgpack.Packer().pack_array_header(n_contacts)
            self._places[i] = len(template)
            one = marker + bytes(8)
            item = msgpack.Packer().pack_array_header(3) + 3 * one if per_contact == 3 else one
            template += item * (n_contacts if per_contact else 1)
        self._message = np.frombuffer(bytes(template), np.uint8).copy()

    def encode(
        self, tick: int, server_time_ns: int, inputs: NDArray[np.int64], motion: NDArray[np.float64]
    ) -> bytes:
        """One tick's answer; rows run over the contacts in the order of the describe reply.

        inputs  (n_contacts, 4): sequence, client_time_ns, age_ns (all -1 without a command), flags
        motion  (n_contacts, 8): displacement x y z (m), force x y z (N), force scale, energy (J)
        """
        _fill_force(self._message, self._places, tick, server_time_ns, inputs, motion)
        return self._message.tobytes()


# Name: how many numbers a contact has (0: one for the tick), and msgpack's marker for int64 or float64.
_FORCE_FIELDS = {
    "tick": (0, b"\xd3"),
    "server_time_ns": (0, b"\xd3"),
    "sequence": (1, b"\xd3"),
    "client_time_ns": (1, b"\xd3"),
    "input_age_ns": (1, b"\xd3"),
    "flags": (1, b"\xd3"),
    "displacement_m": (3, b"\xcb"),
    "force_n": (3, b"\xcb"),
    "force_scale": (1, b"\xcb"),
    "energy_j": (1, b"\xcb"),
}
_ONE, _THREE = 9, 28  # bytes of a number, of an array of three


@compiled
def _fill_force(
    message: NDArray[np.uint8],
    places: NDArray[np.int64],
    tick: int,
    server_time_ns: int,
    inputs: NDArray[np.int64],
    motion: NDArray[np.float64],
) -> None:
    """Write a tick's numbers, big-endian, behind their markers in the message."""
    _write(message, places[0], tick)
    _write(message, places[1], server_time_ns)
    bits = motion.view(np.int64)
    for contact in range(inputs.shape[0]):
        for column in range(4):
            _write(message, places[2 + column] + _ONE * contact, inputs[contact, column])
        for axis in range(3):
            _write(message, places[6] + _THREE * contact + 1 + _ONE * axis, bits[contact, axis])
            _write(message, places[7] + _THREE * contact + 1 + _ONE * axis, bits[contact, 3 + axis])
        _write(message, places[8] + _ONE * contact, bits[contact, 6])
        _write(message, places[9] + _ONE * contact, bits[contact, 7])


@compiled
def _write(message: NDArray[np.uint8], place: int, value: int) -> None:
    for k in range(8):
        message[place + 1 + k] = (value >> (56 - 8 * k)) & 255


def encode_surface(tick: int, server_time_ns: int, displacement: NDArray[np.float32]) -> bytes:
    """Displacement of every surface vertex, (3 n_vertices,) m, x y z of vertex 0 first, as little-endian float32."""
    return msgpack.packb(
        {
            "tick": tick,
            "server_time_ns": server_time_ns,
            "displacement_m": displacement.astype("<f4", copy=False).tobytes(),
        }
    )


def encode_geometry(vertices: NDArray[np.float64], triangles: NDArray[np.int32]) -> bytes:
    """The surface at rest: vertices (n_vertices, 3), m, as little-endian float32; triangles (n, 3) as int32."""
    return msgpack.packb(
        {
            "schema_version": SCHEMA_VERSION,
            "n_vertices": len(vertices),
            "n_triangles": len(triangles),
            "vertices_m": vertices.astype("<f4").tobytes(),
            "triangles": triangles.astype("<i4").tobytes(),
        }
    )


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
