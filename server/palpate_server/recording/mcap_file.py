"""The MCAP file of a session, each message as JSON with its schema; and a process that writes one from a pipe.

    python -m palpate_server.recording.mcap_file < MESSAGES > OUT.mcap

The server starts it for `control record`: MESSAGES are msgpack lists `[kind, key, time_ns, payload]`, one behind the other.
The end of the pipe ends the file, also when the server was killed; nothing else does.
"""

from __future__ import annotations

import io
import json
import math
import os
import signal
import sys
from typing import Any, BinaryIO

import msgpack
from mcap.writer import CompressionType, Writer

PROFILE = "palpate"
_CHUNK_BYTES = 64 * 1024  # a crash loses no more than this
_NUMBERS = {"type": "array", "items": {"type": "number"}}
# Foxglove opens a topic when its arrays hold numbers or objects, and its objects say what is in them; arrays of arrays,
# which the wire has, it refuses. So a force's vectors are written as x, y, z.
_POINT = {"type": "object", "properties": {axis: {"type": "number"} for axis in "xyz"}}
_POINTS = {"type": "array", "items": _POINT}
_MAP: dict[str, Any] = {"type": "object", "properties": {}}
_VECTORS_OF_A_FORCE = ("position_m", "force_n")
_SCHEMAS: dict[str, dict[str, Any]] = {
    "command": {
        "sequence": {"type": "integer"},
        "client_time_ns": {"type": "integer"},
        "position_m": _MAP,
        "velocity_m_per_s": _MAP,
        "rendered_tick": {"type": "integer"},
    },
    "force": {
        "tick": {"type": "integer"},
        "server_time_ns": {"type": "integer"},
        "sequence": _NUMBERS,
        "client_time_ns": _NUMBERS,
        "input_age_ns": _NUMBERS,
        "flags": _NUMBERS,
        "position_m": _POINTS,
        "force_n": _POINTS,
        "force_scale": _NUMBERS,
        "energy_j": _NUMBERS,
    },
    "status": {"state": {"type": "string"}, "ticks": {"type": "integer"}},
    "describe": {"session": {"type": "string"}, "period_s": {"type": "number"}},
}


class Recording:
    """An MCAP file that is being written; one channel a key, its schema named after the kind of message."""

    def __init__(self, stream: BinaryIO) -> None:
        self._writer = Writer(stream, chunk_size=_CHUNK_BYTES, compression=CompressionType.LZ4)
        self._writer.start(profile=PROFILE, library="palpate")
        self._schemas = {
            kind: self._writer.register_schema(
                name=f"palpate.{kind}",
                encoding="jsonschema",
                data=json.dumps({"type": "object", "properties": properties}).encode(),
            )
            for kind, properties in _SCHEMAS.items()
        }
        self._channels: dict[str, int] = {}
        self.messages = 0

    def add(self, kind: str, key: str, time_ns: int, payload: bytes) -> None:
        """Write a message, msgpack; one that can't be read is left out (the server counts them). Raises OSError."""
        data = _as_json(kind, payload)
        if data is None:
            return
        if key not in self._channels:
            self._channels[key] = self._writer.register_channel(
                topic=key, message_encoding="json", schema_id=self._schemas[kind]
            )
        self._writer.add_message(self._channels[key], log_time=time_ns, data=data, publish_time=time_ns)
        self.messages += 1

    def finish(self) -> None:
        self._writer.finish()  # type: ignore[no-untyped-call]


def from_json(kind: str, data: bytes) -> dict[str, Any]:
    """A message as it was on the wire, from one of a recording."""
    message: dict[str, Any] = json.loads(data)
    if kind == "force":
        for name in _VECTORS_OF_A_FORCE:
            message[name] = [[point[axis] for axis in "xyz"] for point in message[name]]
    return message


def _as_json(kind: str, payload: bytes) -> bytes | None:
    # A client's payload can be anything: what msgpack knows and JSON does not, nested without end.
    try:
        message = msgpack.unpackb(payload, raw=False, strict_map_key=True)
        if type(message) is not dict:
            return None
        if kind == "force":
            for name in _VECTORS_OF_A_FORCE:
                message[name] = [dict(zip("xyz", vector, strict=True)) for vector in message[name]]
        return json.dumps(_plain(message), allow_nan=False).encode()
    except Exception:
        return None


def _plain(value: Any) -> Any:
    """What JSON can hold: numbers that are not finite (in a command that was refused) become null."""
    if isinstance(value, dict):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_plain(item) for item in value]
    if isinstance(value, bytes):
        return value.hex()
    return None if isinstance(value, float) and not math.isfinite(value) else value


def main() -> int:
    # Whoever stops the server stops all of its processes; what the server says to the last is still to be written.
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    # The server comes first. At 10, a busy machine would leave less than a thousand ticks a second need: some percent.
    os.nice(5)
    stream = sys.stdout.buffer
    try:
        recording = Recording(stream)
        # Unbuffered: a buffered one would wait for a megabyte, which is four seconds of ticks.
        for message in msgpack.Unpacker(io.FileIO(sys.stdin.fileno()), raw=False):
            recording.add(*message)
        recording.finish()
        stream.flush()
    except OSError as error:
        print(error.strerror, file=sys.stderr, flush=True)
        os._exit(1)  # without another try, on the way out, to write what can't be written
    return 0


if __name__ == "__main__":
    sys.exit(main())
