"""The server's Zenoh session: what it lets a client send, who can connect, the priority of its threads."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import socket
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
import zenoh

from palpate_client.connection import open_session
from palpate_client.local_server import free_endpoint
from palpate_client.wire import KEEP_ALIVES, LEASE_MS, MAX_MESSAGE_BYTES
from palpate_server.realtime import threads
from palpate_server.session import transport

CHANNEL_CAPACITY = 100
SHIPPED = Path(__file__).parents[3] / "configs" / "security"
with ThreadPoolExecutor(1) as executor:
    RUNS_REAL_TIME_THREADS = executor.submit(threads.raise_priority).result() is None


@pytest.fixture
def endpoint() -> str:
    return free_endpoint()


@pytest.fixture
def server(endpoint: str) -> Iterator[zenoh.Session]:
    with transport.open_session(endpoint, None) as session:
        yield session


def test_a_message_above_the_bound_is_dropped_and_the_link_stays(
    server: zenoh.Session, endpoint: str
) -> None:
    with open_session(endpoint) as client:
        heard = server.declare_subscriber("sizes", zenoh.handlers.FifoChannel(CHANNEL_CAPACITY))
        sizes = [16384, 2 * MAX_MESSAGE_BYTES, 10_000_000, 4096, 0]
        for size in sizes:
            client.put("sizes", bytes(size), congestion_control=zenoh.CongestionControl.BLOCK)
        received = []
        while not received or received[-1] != 0:
            received.append(len(heard.recv().payload))
        assert received == [16384, 10_000_000, 4096, 0]


def test_a_client_hears_a_geometry_of_a_hundred_thousand_vertices(
    server: zenoh.Session, endpoint: str
) -> None:
    geometry = bytes(12 * 100_000 + 12 * 200_000)  # float32 positions, int32 triangles: twice as many
    answering = server.declare_queryable("geometry", lambda query: query.reply("geometry", geometry))
    with open_session(endpoint) as client:
        (reply,) = client.get("geometry", timeout=10.0)
        assert reply.ok is not None
        assert len(reply.ok.payload) == len(geometry)
    answering.undeclare()


@pytest.mark.parametrize("malformed", ["foo", 'a"b', "tcp/", "tcp/127.0.0.1:abc", "nope/127.0.0.1:3"])
def test_a_malformed_endpoint_is_refused_in_words(malformed: str) -> None:
    with pytest.raises(transport.TransportError) as caught:
        transport.open_session(malformed, None)
    message = str(caught.value)
    assert message.startswith(f"endpoint {malformed}: ")
    assert "Json5Err" not in message
    assert ".rs" not in message
    assert "\\" not in message


def test_an_endpoint_in_use_is_refused_without_loose_brackets(server: zenoh.Session, endpoint: str) -> None:
    with pytest.raises(transport.TransportError, match="Address already in use") as caught:
        transport.open_session(endpoint, None)
    assert str(caught.value).count("[") == str(caught.value).count("]")


# Zenoh starts its threads once in a process: each priority is looked at in a process of its own.
PRIORITIES = """
import json, os
from pathlib import Path
from palpate_server.session import transport

def priorities():
    found = {}
    for task in Path("/proc/self/task").iterdir():
        try:
            found[task.name] = ((task / "comm").read_text()[:4], os.sched_getparam(int(task.name)).sched_priority)
        except (FileNotFoundError, ProcessLookupError):  # a thread that has just ended
            pass
    return found

with transport.open_session("tcp/127.0.0.1:0", None) as session:
    before = priorities()
    session.declare_subscriber("key", print)
    after = priorities()
    zenoh = [priority for name, priority in before.values() if name in ("app-", "net-", "acc-")]
    callback = [priority for task, (name, priority) in after.items() if task not in before]
    print(json.dumps({"zenoh": zenoh, "callback": callback}))
"""


def _priorities(*prefix: str) -> dict[str, list[int]]:
    program = subprocess.run(
        [*prefix, sys.executable, "-c", PRIORITIES], capture_output=True, text=True, timeout=60, check=True
    )
    found: dict[str, list[int]] = json.loads(program.stdout)
    assert found["zenoh"]  # Zenoh starts some of its threads only when they are needed
    assert len(found["callback"]) == 1
    return found


@pytest.mark.skipif(not RUNS_REAL_TIME_THREADS, reason="this user may not have threads of real-time priority")
def test_zenoh_s_threads_have_a_low_real_time_priority_and_those_that_call_python_none() -> None:
    found = _priorities()
    assert set(found["zenoh"]) == {threads.ZENOH_PRIORITY}
    assert found["callback"] == [0]
    assert 0 < threads.ZENOH_PRIORITY < threads.COMMAND_PRIORITY < threads.LOOP_PRIORITY


@pytest.mark.skipif(os.geteuid() != 0 or shutil.which("setpriv") is None, reason="needs root and setpriv")
def test_a_session_opens_where_no_real_time_priority_is_allowed() -> None:
    found = _priorities(
        "prlimit", "--rtprio=0", "setpriv", "--bounding-set=-sys_nice", "--inh-caps=-sys_nice"
    )
    assert set(found["zenoh"]) == {0}


def test_connections_that_say_nothing_keep_no_client_out(server: zenoh.Session, endpoint: str) -> None:
    host, port = endpoint.removeprefix("tcp/").split(":")
    with contextlib.ExitStack() as idle:
        for _ in range(300):
            idle.enter_context(socket.create_connection((host, int(port))))
        with open_session(endpoint) as client:
            assert list(client.info.peers_zid()) == [server.zid()]


@pytest.mark.parametrize("name", ["server", "client", "router"])
def test_the_shipped_configurations_have_the_same_lease(name: str) -> None:
    config = zenoh.Config.from_file(SHIPPED / f"{name}.json5")
    assert json.loads(config.get_json("transport/link/tx/lease")) == LEASE_MS
    assert json.loads(config.get_json("transport/link/tx/keep_alive")) == KEEP_ALIVES


def test_the_shipped_configuration_of_a_server_has_the_same_bounds() -> None:
    config = zenoh.Config.from_file(SHIPPED / "server.json5")
    for key in (
        "transport/link/rx/max_message_size",
        "transport/shared_memory/enabled",
        "transport/unicast/accept_pending",
        "transport/unicast/accept_timeout",
    ):
        assert json.loads(config.get_json(key)) == transport.SETTINGS[key]
