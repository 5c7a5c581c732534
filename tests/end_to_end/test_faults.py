"""Clients that misbehave in time: bursts, jumping clocks, reordering, fights. The force stays within its limits in all."""

from __future__ import annotations

import itertools
import json
import math
import random
import signal
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import zenoh

from palpate_client import Connection, ServerGone, Tool, steps
from palpate_client.local_server import free_endpoint
from palpate_client.wire import LEASE_MS, MAX_MESSAGE_BYTES, Flags, pack, unpack_map

SESSION = "test"

# Of the server below. A press of DEPTH_M (50 N/m when it has settled, more before) goes beyond the largest force, and
# one tick may change it by a fiftieth of that: the lowest rate that is accepted, so a step beyond it has room to show.
MAX_FORCE_N, MAX_FORCE_RATE_N_PER_S = 2.0, 40.0
MAX_STEP_N = MAX_FORCE_RATE_N_PER_S * 1e-3
DEPTH_M = 0.09
LIMITS = ("--max-force-n", str(MAX_FORCE_N), "--max-force-rate-n-per-s", str(MAX_FORCE_RATE_N_PER_S))


def check(messages: list[dict[str, Any]]) -> None:
    """What holds whatever a client does."""
    for message in messages:
        force = message["force_n"][0]
        assert all(math.isfinite(f) for f in force)
        assert math.hypot(*force) <= MAX_FORCE_N + 1e-9
        assert 0 <= message["force_scale"][0] <= 1
    for before, after in itertools.pairwise(messages):
        assert after["tick"] > before["tick"]
        step = math.dist(before["force_n"][0], after["force_n"][0])
        assert step <= MAX_STEP_N * (after["tick"] - before["tick"]) + 1e-9


def limits_were_met(messages: list[dict[str, Any]]) -> bool:
    """Whether the force pressed against both of its limits, without which `check` could not have failed."""
    flags = [Flags(message["flags"][0]) for message in messages]
    return any(f & Flags.SLEW_LIMITED for f in flags) and any(f & Flags.FORCE_CLAMPED for f in flags)


@pytest.fixture
def served(serve: Callable[..., Any]) -> Any:
    return serve(*LIMITS)


def test_bursts_of_commands_make_no_more_ticks_than_time_has(
    served: Any, connect: Callable[..., Any]
) -> None:
    def in_time(message: dict[str, Any]) -> bool:
        return not message["flags"][0] & (Flags.LATE | Flags.CAUGHT_UP)

    with connect(served.endpoint) as client:
        assert client.acquire("tip")[0]
        before = client.next_status()
        first = client.force_when(in_time, "a tick in time")
        bursts = 100
        for burst in range(bursts):
            for _ in range(100):
                client.command({"tip": [0.0, 0.0, DEPTH_M * burst / bursts]})
            time.sleep(0.01)  # within what is held, so that the force is there
        sent = 100 * bursts
        client.status_when(lambda status: status["accepted"] - before["accepted"] == sent, "all commands")
        last = client.force_when(in_time, "a tick in time")
        after = client.next_status()
        # Every command was used by one tick, or replaced before; of those that were used, the answer may be lost.
        superseded = after["dropped"]["superseded"] - before["dropped"]["superseded"]
        answered = {message["sequence"][0] for message in client.forces} - {-1}
        assert len(answered) <= sent - superseded <= after["ticks"] - before["ticks"]
        assert after["accepted"] - before["accepted"] == sent
        ticks, elapsed_ns = (last[field] - first[field] for field in ("tick", "server_time_ns"))
        skipped = after["skipped_ticks"] - before["skipped_ticks"]
        assert elapsed_ns > 1e9
        assert ticks <= elapsed_ns * 1.002e-6 + 2  # the deadlines follow a client by 0.2 % at most
        assert ticks >= elapsed_ns * 0.998e-6 - 2 - skipped
        check(client.forces)
        assert limits_were_met(client.forces)


def test_a_clients_clock_that_jumps_changes_nothing_but_the_echo(
    served: Any, connect: Callable[..., Any]
) -> None:
    jumps = (0, 1, 2**62, 5, 2**63 - 1)
    with connect(served.endpoint) as client:
        assert client.acquire("tip")[0]
        for sequence in range(1, 400):
            message = {
                "kind": "command",
                "sequence": sequence,
                "client_time_ns": jumps[sequence % len(jumps)],
                "position_m": {"tip": [0.0, 0.0, DEPTH_M]},
            }
            client.put(pack(message))
            time.sleep(0.001)
        client.status_when(lambda status: status["accepted"] == 399, "all commands")
        answered = [m for m in client.forces if m["sequence"][0] > 0]
        assert all(m["client_time_ns"][0] == jumps[m["sequence"][0] % len(jumps)] for m in answered)
        check(client.forces)
        assert limits_were_met(client.forces)


def test_reordered_and_repeated_commands_never_move_the_tip_back(
    served: Any, connect: Callable[..., Any]
) -> None:
    generator = random.Random(0)
    with connect(served.endpoint) as client:
        assert client.acquire("tip")[0]
        order = [max(1, i + generator.randrange(-20, 1)) for i in range(1, 500)]
        for sequence in order:
            client.command({"tip": [0.0, 0.0, DEPTH_M * sequence / 500]}, sequence=sequence)
            time.sleep(0.0005)
        status = client.status_when(
            lambda status: status["accepted"] + sum(status["refused"].values()) == len(order), "all commands"
        )
        newest = list(itertools.accumulate(order, max))
        accepted = 1 + sum(b > a for a, b in itertools.pairwise(newest))
        assert status["accepted"] == accepted
        assert status["refused"]["old_sequence"] == len(order) - accepted
        sequences = [m["sequence"][0] for m in client.forces if m["sequence"][0] >= 0]
        assert sequences == sorted(sequences)
        check(client.forces)


def test_of_two_clients_fighting_for_a_tool_one_moves_it(served: Any, connect: Callable[..., Any]) -> None:
    with connect(served.endpoint) as first, connect(served.endpoint) as second:
        assert first.acquire("tip")[0]
        for i in range(200):
            first.command({"tip": [0.0, 0.0, DEPTH_M]})
            second.command({"tip": [0.0, 0.0, -DEPTH_M]}, sequence=1000 + i)
            if i % 50 == 0:
                granted, refusal = second.acquire("tip")
                assert (granted, refusal["reason"]) == (False, "held")
            time.sleep(0.001)
        status = first.status_when(
            lambda status: status["accepted"] + sum(status["refused"].values()) == 400, "all commands"
        )
        assert status["accepted"] == 200
        assert status["refused"]["not_holder"] == 200
        moved = [m["position_m"][0][2] for m in first.forces]
        assert min(moved) >= 0
        check(first.forces)


ROUTER = """
import json, sys, threading, zenoh
config = zenoh.Config()
for key, value in json.loads(sys.argv[1]).items():
    config.insert_json5(key, json.dumps(value))
with zenoh.open(config):
    print("ready", flush=True)
    threading.Event().wait()
"""


def test_a_router_that_is_restarted_fades_the_force_and_lets_the_client_come_back(
    serve: Callable[..., Any], connect: Callable[..., Any], start: Callable[..., Any], tmp_path: Path
) -> None:
    endpoint = free_endpoint()
    settings = {"mode": "router", "listen/endpoints": [endpoint], "scouting/multicast/enabled": False}
    start_router = partial(start, "-c", ROUTER, json.dumps(settings), ready="ready")
    behind = {
        "mode": "client",
        "connect": {"endpoints": [endpoint], "retry": {"period_init_ms": 200, "period_max_ms": 500}},
        "scouting": {"multicast": {"enabled": False}},
    }
    config = tmp_path / "behind_router.json5"
    config.write_text(json.dumps(behind))
    router = start_router()
    served = serve(*LIMITS, "--zenoh-config", str(config), listen=False)
    with connect(endpoint) as client:
        assert client.acquire("tip")[0]
        with client.pressing({"tip": [0.0, 0.0, 1e-3]}):
            last = client.force_when(lambda force: force["force_scale"][0] == 1, "the force")
    router.stop(signal.SIGKILL)
    start_router()
    with connect(endpoint) as client:  # as soon as the server has found its router again
        faded = client.force_when(lambda force: force["flags"][0] & Flags.STALE, "a force without a client")
        assert faded["force_n"] == [[0.0, 0.0, 0.0]]
        assert faded["tick"] > last["tick"]
        assert client.acquire("tip")[0]
        with client.pressing({"tip": [0.0, 0.0, 1e-3]}):
            client.force_when(lambda force: force["force_scale"][0] > 0, "the force")
        check(client.forces)
    assert served.process.poll() is None


STOPS, STOPPED_S = 5, 1.3e-3 * LEASE_MS


@pytest.mark.slow
def test_clients_come_back_to_a_server_that_was_stopped_past_the_lease_and_ignore_messages_on_a_wrong_key(
    serve: Callable[..., Any], wait_for: Callable[..., Any]
) -> None:
    """Zenoh may put messages on a wrong key then (docs/server.md): each has to be one that the library has ignored."""
    served = serve()
    wrong: list[object] = []

    def look(kind: str, sample: zenoh.Sample) -> None:
        if (found := unpack_map(sample.payload.to_bytes(), MAX_MESSAGE_BYTES).get("kind")) != kind:
            wrong.append(found)

    def is_gone(connection: Connection) -> bool:
        try:
            connection.check()
        except ServerGone:
            return True
        return False

    with Connection(served.endpoint, SESSION) as connection:
        forces: list[int] = []
        connection.on_force(lambda message, at_ns: forces.append(message["tick"]))
        subscribers = [
            connection.zenoh.declare_subscriber(key, partial(look, kind))
            for key, kind in ((connection.keys.force, "force"), (connection.keys.status, "status"))
        ]
        for _ in range(STOPS):
            served.process.send_signal(signal.SIGSTOP)
            time.sleep(STOPPED_S)
            served.process.send_signal(signal.SIGCONT)
            wait_for(partial(is_gone, connection), "the end of the link")
            connection.reconnect(60.0)
            seen = len(forces)
            with Tool(connection, silence_s=30.0) as tool:
                for _ in steps(0.3, 0.001):
                    tool.move(tool.at_depth(0.002))
            wait_for(lambda seen=seen: len(forces) - seen, "forces after the stop", lambda more: more > 100)
            assert tool.contract.broken == []
        assert connection.ignored == len(wrong)
        assert len(subscribers) == 2
