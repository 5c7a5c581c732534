"""The MCAP file of a recording, each message as JSON with its schema; and the process that writes one from a pipe.

    python -m palpate_server.recording.mcap_file MAX_BYTES < MESSAGES > OUT.mcap

MESSAGES are msgpack lists, one after the other: `["message", kind, key, time_ns, payload]` with a msgpack map, and
`["ticks", key, clock_offset_ns, ticks, ports]` with records.TICK and records.PORT_RECORD as they are in memory. The end of the
pipe completes the file, also when the server was killed. Each time the process has written to the file, it prints the number of
messages in it to stderr; and at the end, what went wrong.
"""

from __future__ import annotations

import contextlib
import io
import json
import math
import os
import resource
import signal
import sys
from typing import IO, Any

import msgpack
import numpy as np
from mcap.writer import CompressionType, Writer

from palpate_server.realtime.records import PORT_RECORD, TICK
from palpate_server.recording.json_records import FULL, as_objects

PROFILE = "palpate"
_CHUNK_BYTES = 64 * 1024  # a crash loses no more than this
_END_BYTES = 64 * 1024  # room for the last chunk and the summary
_INTEGER, _NUMBER = {"type": "integer"}, {"type": "number"}
_MAP: dict[str, Any] = {"type": "object", "properties": {}}
# Foxglove refuses arrays of arrays, and objects whose schema does not list their properties. So vectors are x, y, z.
_POINT = {"type": "object", "properties": dict.fromkeys("xyz", _NUMBER)}


def _properties(record: np.dtype[np.void]) -> dict[str, Any]:
    """The JSON schema of a record's fields."""
    kinds: dict[str, Any] = {}
    for name in record.names or ():
        field = record[name]
        if field.shape == (3,):
            kinds[name] = _POINT
        elif field.shape:
            kinds[name] = {"type": "array", "items": _NUMBER}
        else:
            kinds[name] = _INTEGER if field.kind == "i" else _NUMBER
    return kinds


_SCHEMAS: dict[str, dict[str, Any]] = {
    "describe": {"session": {"type": "string"}, "period_s": _NUMBER},
    "settings": {"tick": _INTEGER, "change": {"type": "string"}},
    "status": {"state": {"type": "string"}, "ticks": _INTEGER},
    "tick": _properties(TICK)
    | {
        "tools": {
            "type": "array",
            "items": {"type": "object", "properties": _properties(PORT_RECORD)},
        }
    },
}


class Recording:
    """An MCAP file that is being written; one channel a key, its schema named after the kind of message.

    messages: how many are in the file for good, in its first `end` bytes
    """

    def __init__(self, file: IO[bytes], max_bytes: float = math.inf) -> None:
        self._file = file
        self._max_bytes = max_bytes
        self._writer = Writer(
            file, chunk_size=_CHUNK_BYTES, compression=CompressionType.LZ4, enable_data_crcs=True
        )
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
        self._added = 0
        self.messages = 0
        self.end = file.tell()

    @property
    def is_full(self) -> bool:
        """Whether the file must end now, so that it can be completed within `max_bytes`."""
        return self._file.tell() > self._max_bytes - 2 * _CHUNK_BYTES - _END_BYTES

    def add(self, kind: str, key: str, time_ns: int, message: dict[str, Any]) -> None:
        """Write a message. Raises OSError."""
        if key not in self._channels:
            self._channels[key] = self._writer.register_channel(
                topic=key, message_encoding="json", schema_id=self._schemas[kind]
            )
        size = self._file.tell()
        try:
            data = json.dumps(message, allow_nan=False).encode()
        except ValueError:  # not finite: rare, and to look at every number first takes half of the time
            data = json.dumps(_plain(message), allow_nan=False).encode()
        self._writer.add_message(self._channels[key], log_time=time_ns, data=data, publish_time=time_ns)
        self._added += 1
        if self._file.tell() > size:  # a chunk was written, this message its last
            self._file.flush()
            self.messages, self.end = self._added, self._file.tell()

    def add_ticks(self, key: str, clock_offset_ns: int, ticks: bytes, ports: bytes) -> None:
        """Write the ticks of a part of the ring, as far as there is room. Raises OSError."""
        tick_records = np.frombuffer(ticks, TICK)
        tools = as_objects(np.frombuffer(ports, PORT_RECORD))
        n_tools = len(tools) // max(1, len(tick_records))
        for k, tick in enumerate(as_objects(tick_records)):
            if self.is_full:
                return
            tick["tools"] = tools[k * n_tools : (k + 1) * n_tools]
            self.add("tick", key, tick["start_ns"] + clock_offset_ns, tick)

    def finish(self) -> None:
        """Write the rest. Raises OSError."""
        self._writer.finish()  # type: ignore[no-untyped-call]
        self.messages = self._added


def _plain(value: Any) -> Any:
    """What JSON can hold: numbers that are not finite become null."""
    if isinstance(value, dict):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_plain(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _report(what: object) -> None:
    """Print a line for the server, if it still reads them."""
    with contextlib.suppress(OSError):
        print(what, file=sys.stderr, flush=True)


def _write_all(recording: Recording) -> str | None:
    """Write what comes through the pipe until its end. Returns why the recording ended before that, or None."""
    reported = 0
    # Unbuffered: a buffered reader would wait for a megabyte, seconds of ticks.
    for what, *parts in msgpack.Unpacker(io.FileIO(sys.stdin.fileno()), raw=False, max_buffer_size=2**28):
        if what == "ticks":
            recording.add_ticks(*parts)
        else:
            kind, key, time_ns, payload = parts
            recording.add(kind, key, time_ns, msgpack.unpackb(payload))
        if recording.messages > reported:
            reported = recording.messages
            _report(reported)
        if recording.is_full:
            return FULL
    return None


def main() -> int:
    # These signals often go to all processes of the server. This one still has to write what the server sends until its end.
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    # Lower priority than the server. At 10, a busy machine would leave too little time for a thousand ticks a second.
    os.nice(5)
    max_bytes = int(sys.argv[1])
    limit, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    # A bound for messages that are larger than the room that is left.
    if limit == resource.RLIM_INFINITY or limit > max_bytes:
        resource.setrlimit(resource.RLIMIT_FSIZE, (max_bytes, hard))
    file = open(sys.stdout.fileno(), "wb", closefd=False)  # noqa: SIM115, it is closed with the process
    error: str | None
    recording = Recording(file, max_bytes)
    try:
        error = _write_all(recording)
        recording.finish()
        file.flush()
        _report(recording.messages)
    except OSError as failure:
        error = failure.strerror
        with contextlib.suppress(OSError):  # only a regular file can be truncated
            os.ftruncate(file.fileno(), recording.end)
        _report(recording.messages)
    if error is not None:
        _report(error)
        os._exit(1)  # at exit Python would try again to write what can't be written
    return 0


if __name__ == "__main__":
    sys.exit(main())
