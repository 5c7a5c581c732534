"""Record a session to an MCAP file: commands, forces and status, as JSON with its schema, for `replay` and for Foxglove.

    python -m palpate_server.record OUT.mcap [--connect ENDPOINT] [--session NAME] [--duration-s S]

A process of its own: a slow disk can't disturb the loop. What follows a rest can be replayed: start it before the first
command. Forces and commands are best effort, so that some may be missing; a recording that the server makes of itself
(`palpate serve --recordings FOLDER`) has them all. SIGINT or SIGTERM ends it and leaves a complete file; after a full disk (exit code 1) what was written until then
can still be read.
"""

from __future__ import annotations

import argparse
import contextlib
import queue
import signal
import sys
import threading
import time
from collections.abc import Sequence
from pathlib import Path

import zenoh

from palpate_server import transport, wire
from palpate_server.recording import Recording

_QUERY_TIMEOUT_S = 3.0


def record(session: zenoh.Session, keys: wire.Keys, recording: Recording, stop: threading.Event) -> None:
    """Write what is said in a session until `stop` is set. Raises TransportError without a server, OSError of the disk."""
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

    def write(item: tuple[str, str, int, bytes]) -> None:
        if len(item[-1]) <= wire.MAX_RECORDED_BYTES:
            recording.add(*item)

    try:
        recording.add("describe", keys.describe, time.time_ns(), _describe(session, keys))
        while not stop.is_set():
            with contextlib.suppress(queue.Empty):
                write(heard.get(timeout=0.1))
    finally:
        for subscriber in subscribers:
            subscriber.undeclare()  # type: ignore[no-untyped-call]
    while not heard.empty():  # what was heard before the end
        write(heard.get())


def _describe(session: zenoh.Session, keys: wire.Keys) -> bytes:
    give_up = time.monotonic() + _QUERY_TIMEOUT_S
    while time.monotonic() < give_up:  # right after connecting, its queryables may not be known here yet
        for reply in session.get(keys.describe, timeout=_QUERY_TIMEOUT_S):
            if reply.ok is not None:
                return reply.ok.payload.to_bytes()
        time.sleep(0.05)
    raise transport.TransportError(f"no server answers for {keys.describe}")


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="palpate record", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("out", type=Path, metavar="OUT.mcap")
    parser.add_argument(
        "--connect", default=transport.DEFAULT_ENDPOINT, metavar="ENDPOINT", help="(%(default)s)"
    )
    parser.add_argument("--session", default="main", help="(%(default)s)")
    parser.add_argument("--zenoh-config", type=Path, metavar="FILE", help="used instead of --connect")
    parser.add_argument("--duration-s", type=float, help="(default: until Ctrl-C)")
    options = parser.parse_args(arguments)
    stop = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())
    if options.duration_s is not None:
        timer = threading.Timer(options.duration_s, stop.set)
        timer.daemon = True
        timer.start()
    try:
        keys = wire.Keys(options.session)
        with transport.connect_session(options.connect, options.zenoh_config) as session:
            stream = options.out.open("wb")
            try:
                recording = Recording(stream)
                print(f"recording {keys.prefix} to {options.out}; Ctrl-C ends it", flush=True)
                record(session, keys, recording, stop)
                recording.finish()
                stream.close()
            except OSError as error:
                print(f"palpate record: {options.out}: {error.strerror}; it ends here", file=sys.stderr)
                with contextlib.suppress(OSError):  # what could not be written can't be written now
                    stream.close()
                return 1
    except (OSError, ValueError, transport.TransportError) as error:
        print(f"palpate record: {error}", file=sys.stderr)
        return 2
    print(f"{recording.messages} messages in {options.out}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
