"""Start a program on this machine, such as a server; wait until it is ready; end it."""

from __future__ import annotations

import contextlib
import socket
import subprocess
import threading
from collections.abc import Iterator

from palpate_client.errors import ServerGone

START_TIMEOUT_S = 240.0  # the first start of a server compiles
STOP_TIMEOUT_S = 10.0


def free_endpoint() -> str:
    """An endpoint on loopback at which nobody listens now."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


@contextlib.contextmanager
def running(command: list[str], ready: str) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """Start a process and wait for a line that begins with `ready`: the process and that line. It is ended on the way out.

    Raises ServerGone when it ends before that line or takes too long.
    """
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    watchdog = threading.Timer(START_TIMEOUT_S, process.kill)
    watchdog.start()
    try:
        assert process.stdout is not None
        lines = iter(process.stdout.readline, "")
        line = next((line.strip() for line in lines if line.startswith(ready)), None)
        watchdog.cancel()
        if line is None:
            code = process.wait(STOP_TIMEOUT_S)
            raise ServerGone(f"{' '.join(command[1:3])} did not start (exit code {code})")
        yield process, line
    finally:
        watchdog.cancel()
        process.terminate()
        try:
            process.wait(STOP_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
        if process.stdout is not None:
            process.stdout.close()
