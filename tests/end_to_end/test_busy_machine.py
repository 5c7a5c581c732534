"""A machine whose processors are all taken by other programs: clients keep their link to the server."""

from __future__ import annotations

import contextlib
import os
import threading
from collections import Counter
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import psutil
import pytest
import zenoh

from palpate.model_file import save_model
from palpate_client.connection import Connection, open_session
from palpate_client.local_server import free_endpoint
from palpate_client.wire import RECORDER, Keys
from palpate_server.diagnostics.check_host import busy_loops
from palpate_server.diagnostics.sample_model import spring_mass_model
from palpate_server.realtime import threads

with ThreadPoolExecutor(1) as executor:
    RUNS_REAL_TIME_THREADS = executor.submit(threads.raise_priority).result() is None
CLIENTS, LOOPS, RUNS = 3, 4, 10
KEYS = Keys("test")
# The kernel shares processors between sessions first: the server in one, everything else in another, is the hard case.
IN_A_SESSION_OF_ITS_OWN = (
    "import os, sys; os.setsid(); os.execv(sys.executable, [sys.executable, *sys.argv[1:]])"
)
# What a client of the wire is to Zenoh, in a process of its own. Prints a line for each sign of the server's token.
CLIENT = """
import sys, threading, zenoh
from palpate_client.connection import open_session
with open_session(sys.argv[1]) as session:
    subscribers = [
        session.liveliness().declare_subscriber(
            sys.argv[2],
            lambda sample: print("PUT" if sample.kind == zenoh.SampleKind.PUT else "DELETE", flush=True),
            history=True,
        ),
        session.declare_subscriber(sys.argv[3], lambda sample: None),
    ]
    threading.Event().wait()
"""


def _keeps_its_clients(start: Callable[..., Any], folder: Path, seconds: float) -> None:
    """A server's clients see its token once, and it stays for this long beside busy loops, counted by the forces."""
    model = spring_mass_model(1, 20)
    save_model(model, folder / "model.npz")
    endpoint = free_endpoint()
    server = start(
        *("-c", IN_A_SESSION_OF_ITS_OWN, "-m", "palpate_server", folder / "model.npz"),
        *("--listen", endpoint, "--session", KEYS.session),
        ready="serving",
    )
    clients = [start("-c", CLIENT, endpoint, KEYS.server, KEYS.force, ready="PUT") for _ in range(CLIENTS)]
    forces = 0
    enough = threading.Event()

    def count(sample: zenoh.Sample) -> None:
        nonlocal forces
        forces += 1
        if forces * model.period_s > seconds:
            enough.set()

    with busy_loops(LOOPS, 120.0, apart=False), open_session(endpoint) as session:
        session.declare_subscriber(KEYS.force, count)
        assert enough.wait(4 * seconds), f"{forces} forces came"
    for client in clients:
        assert client.process.poll() is None, client.printed()
        assert client.printed().split() == ["PUT"]
        client.process.kill()
    assert server.stop() == 0


def test_status_and_queries_run_before_ordinary_programs_and_what_the_server_starts_does_not(
    start: Callable[..., Any], wait_for: Callable[..., Any], tmp_path: Path
) -> None:
    save_model(spring_mass_model(), tmp_path / "model.npz")
    endpoint = free_endpoint()
    server = start(
        *("-m", "palpate_server", tmp_path / "model.npz", "--listen", endpoint),
        *("--recordings", tmp_path),
        ready="serving",
    )
    pid = server.process.pid
    if not RUNS_REAL_TIME_THREADS:
        pytest.skip("real-time priority is not allowed here")
    # The thread that sends the status, those of queries and of the surface.
    wait_for(lambda: _priorities(pid)[threads.SERVICE_PRIORITY] == 3, "three threads of low priority")
    with Connection(endpoint, name=RECORDER) as connection:
        connection.control("record", file="a.mcap")
        (writer,) = psutil.Process(pid).children()
        assert os.sched_getscheduler(writer.pid) == os.SCHED_OTHER
        connection.control("record", file=None)
    assert server.stop() == 0


def _priorities(pid: int) -> Counter[int]:
    """How many threads of a process have a priority."""
    found: Counter[int] = Counter()
    for thread in psutil.Process(pid).threads():
        with contextlib.suppress(ProcessLookupError):  # it has ended since
            found[os.sched_getparam(thread.id).sched_priority] += 1
    return found


def test_no_client_loses_the_server_beside_busy_loops(start: Callable[..., Any], tmp_path: Path) -> None:
    _keeps_its_clients(start, tmp_path, 4.0)


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_no_client_loses_the_server_in_ten_runs_beside_busy_loops(
    start: Callable[..., Any], tmp_path: Path
) -> None:
    for _ in range(RUNS):
        _keeps_its_clients(start, tmp_path, 12.0)
