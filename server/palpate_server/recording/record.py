"""Record a session to an MCAP file: commands, forces and status, as JSON with its schema, for `replay` and for Foxglove.

    palpate record OUT.mcap [--connect ENDPOINT] [--session NAME] [--duration-s S]

A process of its own: a slow disk can't disturb the loop. OUT.mcap must be a new file. What follows a rest can be replayed:
start it before the first command. Forces and commands are best effort, so that some may be missing, and all commands where
access control does not let this client hear them (it says so); a recording that the server makes of itself
(`palpate serve --recordings FOLDER`) has everything. SIGINT or SIGTERM ends it and leaves a complete file; after a full
disk (exit code 1) what was written until then can still be read.
"""

from __future__ import annotations

import argparse
import contextlib
import math
import queue
import signal
import sys
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import zenoh

from palpate.files import create_new
from palpate_client import ClientError, wire
from palpate_client.arguments import add_connection_options, connection_for, positive
from palpate_server.arguments import need
from palpate_server.realtime.safety import Flags
from palpate_server.wire import MAX_RECORDED_BYTES

if __name__ == "__main__":
    need("mcap", "recorder", "palpate record")

from palpate_server.recording.mcap_file import Recording

_MANY_FORCES = 1000  # a second of them


class Hearing:
    """Finds out that a recorder hears no commands, although the forces answer some."""

    def __init__(self) -> None:
        self._answered = 0  # forces since the last command was heard

    def misses_commands(self, kind: str, payload: bytes) -> bool:
        """True for the one message with which this becomes certain."""
        if kind == "command":
            self._answered = 0
        elif kind == "force" and _uses_a_new_command(payload):
            self._answered += 1
            return self._answered == _MANY_FORCES
        return False


def _uses_a_new_command(payload: bytes) -> bool:
    try:
        force = wire.unpack_map(payload, MAX_RECORDED_BYTES)
        used = zip(force["sequence"], force["flags"], strict=True)
        return any(sequence >= 0 and not flags & Flags.HELD for sequence, flags in used)
    except (wire.MalformedMessage, KeyError, TypeError, ValueError):
        return False


def record(
    session: zenoh.Session,
    keys: wire.Keys,
    recording: Recording,
    description: bytes,
    is_over: Callable[[], bool],
    on_no_commands: Callable[[], None],
) -> None:
    """Write a describe reply, and what is said in its session until `is_over`. Raises OSError of the disk.

    on_no_commands is called when forces answer commands that are not heard here.
    """
    heard: queue.SimpleQueue[tuple[str, str, int, bytes]] = queue.SimpleQueue()

    def listen(kind: str, key: str) -> zenoh.Subscriber[None]:
        return session.declare_subscriber(
            key, lambda s: heard.put((kind, str(s.key_expr), time.time_ns(), s.payload.to_bytes()))
        )

    subscribers = [
        listen("command", keys.command("*")),
        listen("force", keys.force),
        listen("status", keys.status),
    ]

    hearing = Hearing()

    def write(item: tuple[str, str, int, bytes]) -> None:
        kind, *_, payload = item
        try:
            wire.unpack(payload, wire.Kind(kind), MAX_RECORDED_BYTES)
        except wire.MalformedMessage:
            return  # of another kind than its key's, or nothing that a replay could use
        recording.add(*item)
        if hearing.misses_commands(kind, payload):
            on_no_commands()

    try:
        recording.add("describe", keys.describe, time.time_ns(), description)
        while not is_over():
            with contextlib.suppress(queue.Empty):
                write(heard.get(timeout=0.1))
    finally:
        for subscriber in subscribers:
            subscriber.undeclare()  # type: ignore[no-untyped-call]
    while not heard.empty():  # what was heard before the end
        write(heard.get())


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="palpate record", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("out", type=Path, metavar="OUT.mcap", help="a new file")
    add_connection_options(parser, name=False)
    parser.add_argument("--duration-s", type=positive, metavar="S", help="(default: until Ctrl-C)")
    options = parser.parse_args(arguments)
    stop = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())
    try:
        with connection_for(options) as connection:
            keys = connection.keys
            stream = create_new(options.out)
            end_s = time.monotonic() + (options.duration_s or math.inf)
            try:
                recording = Recording(stream)
                print(f"recording {keys.prefix} to {options.out}; Ctrl-C ends it", flush=True)
                record(
                    connection.zenoh,
                    keys,
                    recording,
                    wire.pack(connection.description.message),
                    lambda: stop.is_set() or time.monotonic() >= end_s,
                    _say_that_no_commands_are_heard,
                )
                recording.finish()
                stream.close()
            except OSError as error:
                print(f"palpate record: {options.out}: {error.strerror}; it ends here", file=sys.stderr)
                with contextlib.suppress(OSError):  # what could not be written can't be written now
                    stream.close()
                return 1
    except (OSError, ValueError, ClientError) as error:
        print(f"palpate record: {error}", file=sys.stderr)
        return 2
    print(f"{recording.messages} messages in {options.out}")
    return 0


def _say_that_no_commands_are_heard() -> None:
    print(
        "palpate record: the forces answer commands that are not heard here. Access control may allow them to a "
        "recorder's certificate alone; a recording that the server makes has them (palpate serve --recordings)",
        file=sys.stderr,
        flush=True,
    )


if __name__ == "__main__":
    sys.exit(main())
