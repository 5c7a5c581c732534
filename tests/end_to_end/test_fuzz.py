"""Whatever is sent to a server is counted or answered, and no tick is skipped: commands, requests and keys from fixed seeds."""

from __future__ import annotations

import random
import time
from collections.abc import Callable, Iterator
from typing import Any

import msgpack
import pytest

from palpate_client.wire import ACTIONS, MALFORMED, NOT_GRANTED

BUDGET_S = 3.0  # of each kind of input
SEEDS = (0, pytest.param(1, marks=pytest.mark.slow))

SCALARS: list[Callable[[random.Random], Any]] = [
    lambda r: None,
    lambda r: r.choice((True, False)),
    lambda r: r.choice((0, 1, -1, 2**31, 2**63 - 1, 2**63, 2**64 - 1, -(2**63))),
    lambda r: r.choice((0.0, 1e-3, -1e300, float("nan"), float("inf"))),
    lambda r: r.choice(("", "tip", "request", "command", "../x", "a\x1b[31m\n", "\u202e", "x" * 300)),
    lambda r: r.randbytes(r.randrange(20)),
    lambda r: msgpack.ExtType(r.randrange(128), r.randbytes(3)),
]
FIELDS = [
    "kind",
    "schema_version",
    "sequence",
    "client_time_ns",
    "position_m",
    "velocity_m_per_s",
    "rendered_tick",
    "tools",
    "frame",
    "device",
    "round_trip_s",
    "limits",
    "file",
    "rotation",
    "scale",
    "client_origin_m",
    "model_origin_m",
    "max_force_n",
    "tip",
]


def anything(r: random.Random, depth: int = 3) -> Any:
    kind = r.randrange(10)
    if depth and kind < 2:
        return [anything(r, depth - 1) for _ in range(r.randrange(5))]
    if depth and kind < 5:
        return {r.choice(FIELDS): anything(r, depth - 1) for _ in range(r.randrange(5))}
    return r.choice(SCALARS)(r)


def damaged(r: random.Random, message: dict[str, Any]) -> bytes:
    """A message with some fields replaced, then perhaps some bytes."""
    changed = dict(message)
    for _ in range(r.randrange(3)):
        changed[r.choice(FIELDS)] = anything(r)
    payload = bytearray(msgpack.packb(changed))
    for _ in range(r.choice((0, 0, 1, 3))):
        payload[r.randrange(len(payload))] = r.randrange(256)
    return bytes(payload[: r.choice((len(payload), len(payload), r.randrange(len(payload) + 1)))])


def in_time(seed: int) -> Iterator[random.Random]:
    """A source of random numbers, again and again until the budget is spent."""
    r, give_up = random.Random(seed), time.monotonic() + BUDGET_S
    while time.monotonic() < give_up:
        yield r


@pytest.fixture(scope="module")
def served(serve_for_module: Callable[..., Any]) -> Any:
    return serve_for_module()


@pytest.fixture
def client(
    served: Any, connect: Callable[..., Any], assert_ticks_went_on: Callable[..., None]
) -> Iterator[Any]:
    """Afterwards the server is as before: it answers, has had no fault, and its ticks went on."""
    with connect(served.endpoint) as client:
        before = client.next_status()
        yield client
        after = client.next_status()
        assert after["faults"] == before["faults"]
        assert_ticks_went_on(before, after)
        assert client.acquire("tip")[0]
        sequence = client.command({"tip": [0.0, 0.0, 0.0]}, sequence=2**63 - 1)
        client.force_when(lambda force: force["sequence"][0] == sequence, "its answer")
        assert client.control("release")[0]
        assert "Traceback" not in served.program.printed()


def total(status: dict[str, Any]) -> int:
    counted = status["accepted"] + sum(status["refused"].values()) + sum(status["malformed"].values())
    return int(counted)


@pytest.mark.parametrize("seed", SEEDS)
def test_every_command_is_counted(client: Any, seed: int) -> None:
    assert client.acquire("tip")[0]
    before, sent = total(client.next_status()), 0
    good = {"kind": "command", "sequence": 0, "client_time_ns": 1, "position_m": {"tip": [0.0, 0.0, -1e-3]}}
    for r in in_time(seed):
        client.put(damaged(r, good | {"sequence": sent}))
        sent += 1
    status = client.status_when(lambda status: total(status) - before == sent, f"all {sent} commands")
    assert status["accepted"] > 0
    assert sum(status["malformed"].values()) > 0


@pytest.mark.parametrize("seed", SEEDS)
def test_every_request_is_answered_or_refused_with_a_known_reason(client: Any, seed: int) -> None:
    good = {
        "kind": "request",
        "schema_version": 2,
        "tools": ["tip"],
        "limits": {"max_force_n": 1.0},
        "file": "x",
    }
    reasons = set()
    for r in in_time(seed):
        action = r.choice(ACTIONS)
        key = client.key(f"control/{r.choice((client.name, 'nobody'))}/{action}")
        replies = list(client.session.get(key, payload=damaged(r, good), timeout=60.0))
        (answer,) = (reply.ok or reply.err for reply in replies)
        message = msgpack.unpackb(answer.payload.to_bytes())
        if message["kind"] == "refusal":
            reasons.add(message["reason"])
        else:
            assert message["kind"] == "answer"
    assert "internal" not in reasons
    assert reasons <= set(MALFORMED) | set(NOT_GRANTED)
    assert len(reasons) > 3


CHUNKS = (
    "palpate",
    "test",
    "control",
    "describe",
    "geometry",
    "force",
    "client",
    "*",
    "**",
    "a b",
    "@x",
    "$*",
    "ä",
)


@pytest.mark.parametrize("seed", SEEDS)
def test_a_query_with_any_key_ends_and_none_is_a_mistake_of_the_servers(client: Any, seed: int) -> None:
    answered = 0
    for r in in_time(seed):
        chunks = [r.choice((*CHUNKS, *ACTIONS)) for _ in range(r.randrange(1, 6))]
        key = "/".join(["palpate", "test", *chunks][r.randrange(3) :])
        try:
            replies = list(client.session.get(key, payload=b"", timeout=60.0))
        except Exception as error:  # Zenoh itself refuses some
            assert "Invalid Key Expr" in str(error) or "key" in str(error).lower()
            continue
        for reply in replies:
            answer = reply.ok or reply.err
            assert answer is not None
            message = msgpack.unpackb(answer.payload.to_bytes())
            assert message["kind"] in ("describe", "geometry", "refusal", "answer")
            assert message.get("reason") != "internal"
            answered += 1
    assert answered > 0
