"""Make a running server record its ticks to an MCAP file, until Ctrl-C.

    palpate record NAME.mcap [--connect ENDPOINT] [--session NAME] [--duration-s S]

The server writes NAME.mcap in the folder of `palpate serve --recordings FOLDER`. Exit code 0: the recording is complete. 1: it
ended early, and why is said; what was written until then can be read. 2: it could not be started, or the server went away.
"""

from __future__ import annotations

import argparse
import json
import math
import signal
import sys
import threading
import time
from collections.abc import Sequence
from typing import Any, TextIO

from palpate.files import printable
from palpate_client import ClientError, Refused
from palpate_client.arguments import add_connection_options, connection_for, failed, plain_name, positive
from palpate_client.connection import Connection
from palpate_client.wire import RECORDER

_POLL_S = 0.1


def main(arguments: Sequence[str] | None = None) -> int:
    about = (__doc__ or "").strip().split("\n\n")
    parser = argparse.ArgumentParser(prog="palpate record", description=about[0], epilog=about[-1])
    parser.add_argument("file", metavar="NAME.mcap", help="a new file's name, without a folder")
    add_connection_options(parser, name=False)
    parser.add_argument(
        "--name",
        type=plain_name,
        default=RECORDER,
        help="this client's; one of another name has to hold a tool to record (default: %(default)s)",
    )
    parser.add_argument("--duration-s", type=positive, metavar="S", help="(default: until Ctrl-C)")
    parser.add_argument("--json", action="store_true", help="print the server's report as JSON at the end")
    options = parser.parse_args(arguments)
    stop = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):  # the server would go on recording
        if number != signal.SIGHUP or signal.getsignal(number) != signal.SIG_IGN:  # as under nohup
            signal.signal(number, lambda *_: stop.set())
    try:
        with connection_for(options) as connection:
            out = sys.stderr if options.json else sys.stdout
            report = record(connection, options.file, stop, options.duration_s or math.inf, out)
    except (OSError, ValueError, ClientError) as error:
        return failed("palpate record", error, 2)
    if options.json:
        print(json.dumps(report))
    if report["missing_ticks"]:
        print(f"{report['missing_ticks']} ticks are missing: the machine was too busy", file=sys.stderr)
    if report["error"] is not None:
        print(printable(f"palpate record: {options.file}: {report['error']}; it ends here"), file=sys.stderr)
        return 1
    if not options.json:
        print(printable(f"{report['messages']} messages in {options.file}"))
    return 0


def record(
    connection: Connection, file: str, stop: threading.Event, duration_s: float, out: TextIO
) -> dict[str, Any]:
    """Record until `stop` is set, the time is over, or the recording ends; the server's report. Raises ClientError.

    What is recorded is said on `out` at the beginning.
    """
    begun, broke_off, replaced = threading.Event(), threading.Event(), threading.Event()

    def hear(status: dict[str, Any]) -> None:
        recording = status["recording"]
        if recording is None or recording["file"] != file:
            if begun.is_set():  # before, a status may be older than the recording
                replaced.set()
            return
        begun.set()
        if recording["error"] is not None:
            broke_off.set()

    connection.on_status(hear)
    connection.control("record", file=file)
    print(
        printable(f"recording {connection.keys.prefix} to {file} at the server; Ctrl-C ends it"),
        file=out,
        flush=True,
    )
    end_s = time.monotonic() + duration_s
    while not (broke_off.is_set() or replaced.is_set() or stop.wait(_POLL_S)) and time.monotonic() < end_s:
        connection.check()
    if replaced.is_set():
        raise Refused("not_recording", f"another client has ended the recording {file}")
    report: dict[str, Any] = connection.control("record", file=None)["recording"]
    return report


if __name__ == "__main__":
    sys.exit(main())
