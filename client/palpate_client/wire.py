"""The definitions of the wire: schema version, keys, kinds, fields, reasons, flags and bounds; and packing of messages.

The server and the Python clients use them. `docs/wire.md` describes the same for clients in other languages; a test compares
the two. This module needs msgpack and the standard library only.

Every payload is one msgpack map whose first field is `kind`. Quantities are SI and carry their unit in the field's name.
Times are nanoseconds on the sender's own monotonic clock. Vectors are `[x, y, z]`.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from enum import IntFlag, StrEnum
from typing import Any

import msgpack

SCHEMA_VERSION = 2
ENCODING = f"application/msgpack;palpate.v{SCHEMA_VERSION}"
DEFAULT_SESSION = "main"
RECORDER = "recorder"  # the client that may record without a tool
DEFAULT_ENDPOINT = "tcp/127.0.0.1:7447"
# Zenoh's lease on a link, ms: a peer that is silent for longer counts as gone. It sends at least KEEP_ALIVES messages in that
# time, so its threads may wait 3.5 s for a processor; at ordinary priority they waited up to 2.4 s on a busy machine.
LEASE_MS = 4000
KEEP_ALIVES = 8

# The largest payloads that the server reads, and the largest message that its Zenoh session puts together.
MAX_COMMAND_BYTES = 4096
MAX_REQUEST_BYTES = 16384
MAX_MESSAGE_BYTES = 2**24
# A command with a component beyond these is refused as `out_of_range`.
MAX_POSITION_M = 1e3
MAX_VELOCITY_M_PER_S = 1e3
MAX_INTEGER = 2**63 - 1  # of every integer field; none is below 0

ACTIONS = ("acquire", "release", "limits", "reset", "load", "record")  # of control queries
SLOW_ACTIONS = ("load", "record")  # these take up to seconds; a client waits longer for their answers


class Kind(StrEnum):
    """What a message is. Each kind belongs to certain keys; a message of another kind is to be ignored there."""

    COMMAND = "command"
    FORCE = "force"
    STATUS = "status"
    SURFACE = "surface"
    DESCRIBE = "describe"
    GEOMETRY = "geometry"
    REQUEST = "request"
    ANSWER = "answer"
    REFUSAL = "refusal"


class Flags(IntFlag):
    """What happened to one tool in one tick (LATE and CAUGHT_UP: to the tick)."""

    HELD = 1  # no new command since the last tick; the last position was used again
    DECAYING = 2  # the client has been silent for longer than `hold_s`, or is gone: the force fades to zero
    STALE = 4  # it has faded: the force is zero and the tip is withdrawn from the tissue
    SOFT_START = 8  # commands are coming (again); the force fades in
    WORKSPACE_CLAMPED = 16  # the tip was outside the workspace and is moved to its edge
    SPEED_LIMITED = 32  # the tip moved faster than allowed and is followed at the allowed speed
    SLEW_LIMITED = 64  # the force changed faster than allowed
    FORCE_CLAMPED = 128  # the force was larger than allowed
    FAULT = 256  # the model gave a force that is not finite; it was put back to rest
    LATE = 512  # the tick began more than a quarter of a period after its deadline
    CAUGHT_UP = 1024  # the tick was missed and made up for, together with a later one
    PASSIVITY_LIMITED = 2048  # the port had given out energy; the force is damped to take it back
    JUMPED = 4096  # the command is farther away than a tip can move in `hold_s`: the force fades on the way
    IN_CONTACT = 8192  # the tip touches the tissue
    SLIDING = 16384  # the tip slides along the tissue
    ATTACHED = 32768  # the tip holds the tissue, which follows it in every direction


# Fields of a force message: how many numbers each has (PER_TICK: one for the tick; else for every tool), and their type.
PER_TICK = 0
FORCE_FIELDS: Mapping[str, tuple[int, type[int] | type[float]]] = {
    "tick": (PER_TICK, int),
    "server_time_ns": (PER_TICK, int),
    "sequence": (1, int),
    "client_time_ns": (1, int),
    "input_age_ns": (1, int),
    "flags": (1, int),
    "position_m": (3, float),
    "force_n": (3, float),
    "force_scale": (1, float),
    "energy_j": (1, float),
    "normal": (3, float),
    "penetration_m": (1, float),
    "slip_m": (1, float),
    "n_contact_points": (1, int),
    "work_j": (1, float),
    "stored_j": (1, float),
    "dissipated_j": (1, float),
    "withheld_j": (1, float),
    "tissue_stored_j": (PER_TICK, float),
    "tissue_dissipated_j": (PER_TICK, float),
}

# Why a payload can't be read. The status counts them for commands; a query gets them as its refusal.
MALFORMED = (
    "too_large",
    "not_msgpack",
    "not_a_map",
    "wrong_kind",
    "missing_field",
    "wrong_type",
    "wrong_shape",
)
# Why a command that could be read is not carried out, and why an accepted command or a force went no further.
REFUSED = ("not_finite", "out_of_range", "unknown_tool", "not_holder", "old_sequence", "stopping")
DROPPED = ("superseded", "unsent_force")
# Why a query that could be read is not granted.
NOT_GRANTED = (
    "wrong_version",
    "out_of_range",
    "unknown_action",
    "unknown_tool",
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
    "full",
    "not_recording",
    "internal",
)

_NAME = re.compile(r"[A-Za-z0-9_-]{1,64}")


class MalformedMessage(ValueError):
    """A payload that breaks the schema. `reason` is one of MALFORMED; the message says what was wrong."""

    def __init__(self, reason: str, message: str) -> None:
        super().__init__(message)
        self.reason = reason


class Keys:
    """The key expressions of one session. Raises ValueError for a name that is not 1 to 64 of A-Z a-z 0-9 _ -."""

    def __init__(self, session: str = DEFAULT_SESSION) -> None:
        if not is_name(session):
            raise ValueError(f"session is {session!r}: expected 1 to 64 of A-Z a-z 0-9 _ -")
        self.session = session
        self.prefix = f"palpate/{session}"
        self.server = f"{self.prefix}/server"  # liveliness token of the server
        self.describe = f"{self.prefix}/describe"
        self.geometry = f"{self.prefix}/geometry"
        self.force = f"{self.prefix}/force"
        self.status = f"{self.prefix}/status"
        self.surface = f"{self.prefix}/surface"

    def client(self, name: str) -> str:
        """Liveliness token of a client: it keeps its tools for as long as this stands."""
        return f"{self.prefix}/client/{name}"

    def command(self, client: str) -> str:
        return f"{self.prefix}/command/{client}"

    def control(self, client: str, action: str) -> str:
        """The client is in the key, so that access control can bind a name to a certificate."""
        return f"{self.prefix}/control/{client}/{action}"


def is_name(text: object) -> bool:
    """True for what may be one chunk of a key: 1 to 64 of A-Z a-z 0-9 _ -."""
    return isinstance(text, str) and _NAME.fullmatch(text) is not None


def last_chunk(key: str) -> str:
    return key.rpartition("/")[2]


def pack(message: Mapping[str, Any]) -> bytes:
    """The payload of a message; its sender puts `kind` first."""
    return msgpack.packb(message)


def unpack_map(payload: bytes, max_bytes: int) -> dict[str, Any]:
    """The map in a payload of at most `max_bytes`. Raises MalformedMessage.

    Keys are strings. Of a key that stands twice, the last one counts. A string that is not UTF-8, bytes behind the map and
    a map that is cut short make the whole payload `not_msgpack`, whatever field they are in.
    """
    check_size(len(payload), max_bytes)
    try:
        message = msgpack.unpackb(payload, raw=False, strict_map_key=True)
    except (ValueError, RecursionError, OverflowError) as error:
        raise MalformedMessage("not_msgpack", f"payload is not one msgpack value ({error})") from error
    except Exception as error:  # the payload can be anything
        raise MalformedMessage("not_msgpack", f"payload can't be decoded ({error!r})") from error
    if type(message) is not dict:
        raise MalformedMessage("not_a_map", f"payload is a {type(message).__name__}: expected a map")
    return message


def unpack(payload: bytes, kind: Kind, max_bytes: int = MAX_MESSAGE_BYTES) -> dict[str, Any]:
    """The message of this kind in a payload. Raises MalformedMessage, with `wrong_kind` for one of another kind."""
    message = unpack_map(payload, max_bytes)
    check_kind(message, kind)
    return message


def check_kind(message: Mapping[str, Any], kind: Kind) -> None:
    """Raises MalformedMessage when a message is of another kind, or names none."""
    found = message.get("kind")
    if found != kind:
        described = repr(found)[:100] if "kind" in message else "missing"
        raise MalformedMessage("wrong_kind", f"kind is {described}: expected {kind.value!r}")


def check_size(n_bytes: int, max_bytes: int) -> None:
    """Raises MalformedMessage if a payload is too large. Call it before the payload is copied or decoded."""
    if n_bytes > max_bytes:
        raise MalformedMessage("too_large", f"payload has {n_bytes} bytes: expected at most {max_bytes}")
