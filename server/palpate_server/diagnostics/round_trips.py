"""Round-trip times over Zenoh at a steady rate: of a bare ping/pong, and of commands to a server."""

from __future__ import annotations

import contextlib
import sys
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import zenoh

from palpate_client import Connection, ServerGone
from palpate_client.connection import open_session
from palpate_client.local_server import free_endpoint, running
from palpate_client.wire import Kind, MalformedMessage, pack, unpack
from palpate_server.session import transport

RATE_HZ = 1000
SETTLE_S = 1.0  # the server's deadlines need a quarter of a second to settle behind the commands
_DEPTH_M = 0.003  # of the commanded positions


@dataclass(frozen=True)
class RoundTrips:
    """Percentiles in seconds, and the share of messages that got no answer of their own."""

    p50_s: float
    p99_s: float
    unanswered: float


class ReceivedForce(NamedTuple):
    """One force message and its arrival at the client; times in ns on one monotonic clock."""

    arrival_ns: int
    tick: int
    server_time_ns: int
    sequence: int
    input_age_ns: int


def ping_pong(command_bytes: int, force_bytes: int, seconds: float) -> RoundTrips:
    """Round trips to a Python process that answers each message with `force_bytes` bytes."""
    endpoint = free_endpoint()
    command = [sys.executable, "-m", "palpate_server.diagnostics.round_trips", endpoint, str(force_bytes)]
    padding = bytes(command_bytes - 8)
    answers: list[tuple[int, int]] = []
    with running(command, "ready"), contextlib.closing(open_session(endpoint)) as session:
        sent = _drive(
            session,
            ("ping", "pong"),
            lambda sequence, now: sequence.to_bytes(8, "little") + padding,
            lambda arrival_ns, payload: answers.append((int.from_bytes(payload[:8], "little"), arrival_ns)),
            seconds,
        )
    return _match(sent, answers)


def pong(endpoint: str, size: int) -> None:
    """The other side of `ping_pong`: answers until it is killed."""
    with transport.open_session(endpoint, None) as session:
        publisher = session.declare_publisher("pong", **_real_time())
        padding = bytes(size - 8)
        session.declare_subscriber("ping", lambda s: publisher.put(s.payload.to_bytes()[:8] + padding))
        print("ready", flush=True)
        threading.Event().wait()


def through_a_model(
    path: Path, tools: Sequence[str], seconds: float, *, viewer: bool
) -> tuple[RoundTrips, dict[str, Any]]:
    """Round trips of commands that press some tools, to a new server with the model in `path`; and the server's last status.

    With `viewer`, this process also receives the surface, 60 times a second.
    """
    sent, forces, status = driven(path, tools, seconds, viewer=viewer)
    return answered(sent, forces), status


def driven(
    path: Path, tools: Sequence[str], seconds: float, *, viewer: bool
) -> tuple[list[int], list[ReceivedForce], dict[str, Any]]:
    """As `through_a_model`, unprocessed: when each command was sent, ns; every force of the first tool; the last status."""
    endpoint = free_endpoint()
    command = [sys.executable, "-m", "palpate_server", str(path), "--listen", endpoint, "--surface-hz", "60"]
    forces: list[ReceivedForce] = []
    statuses: list[dict[str, Any]] = []
    with running(command, "serving"), Connection(endpoint) as connection:
        described = connection.description
        index = described.index(tools[0])
        connection.on_status(statuses.append)
        if viewer:
            connection.on_surface(lambda surface: None)

        def receive(arrival_ns: int, payload: bytes) -> None:
            with contextlib.suppress(MalformedMessage):
                force = unpack(payload, Kind.FORCE)
                sequence, age_ns = force["sequence"][index], force["input_age_ns"][index]
                forces.append(
                    ReceivedForce(arrival_ns, force["tick"], force["server_time_ns"], sequence, age_ns)
                )

        acquired = connection.control("acquire", tools=list(tools))["tools"]
        position_m = {}
        for tool in tools:
            normal = described.tools[described.index(tool)].normal
            position_m[tool] = [
                home - _DEPTH_M * n for home, n in zip(acquired[tool]["home_m"], normal, strict=True)
            ]
        sent = _drive(
            connection.zenoh,
            (connection.keys.command(connection.name), connection.keys.force),
            lambda sequence, now: encode_command(sequence, now, position_m),
            receive,
            seconds,
        )
    return sent, forces, statuses[-1]


def answered(sent: Sequence[int], forces: Sequence[ReceivedForce]) -> RoundTrips:
    """The round trips of what `driven` gives."""
    return _match(sent, [(force.sequence, force.arrival_ns) for force in forces])


def encode_command(sequence: int, now_ns: int, position_m: Mapping[str, Sequence[float]]) -> bytes:
    return pack(
        {
            "kind": Kind.COMMAND,
            "sequence": sequence,
            "client_time_ns": now_ns,
            "position_m": position_m,
        }
    )


def _real_time() -> dict[str, Any]:
    return {
        "priority": zenoh.Priority.REAL_TIME,
        "express": True,
        "congestion_control": zenoh.CongestionControl.DROP,
    }


def _drive(
    session: zenoh.Session,
    keys: tuple[str, str],
    encode: Callable[[int, int], bytes],
    receive: Callable[[int, bytes], None],
    seconds: float,
) -> list[int]:
    """Send commands 1, 2, ... at RATE_HZ to the first key, and call `receive` with each answer on the second.

    Returns when each command was sent, ns. The commands of the first SETTLE_S are included; `_match` ignores them.
    """
    send_key, answer_key = keys
    subscriber = session.declare_subscriber(
        answer_key, lambda sample: receive(time.monotonic_ns(), sample.payload.to_bytes())
    )
    publisher = session.declare_publisher(send_key, **_real_time())
    time.sleep(0.5)
    sent = []
    start_s = time.monotonic()
    for sequence in range(1, int((seconds + SETTLE_S) * RATE_HZ)):
        wait = start_s + sequence / RATE_HZ - time.monotonic()
        if wait > 0:
            time.sleep(wait)
        now = time.monotonic_ns()
        sent.append(now)
        publisher.put(encode(sequence, now))
    time.sleep(0.2)
    subscriber.undeclare()  # type: ignore[no-untyped-call]
    return sent


def _match(sent: Sequence[int], answers: Sequence[tuple[int, int]]) -> RoundTrips:
    """The round trips of the commands after SETTLE_S.

    sent     when command 1, 2, ... was sent, ns
    answers  (command, arrival in ns) of each answer; only the first to a command counts

    Raises ServerGone without any answer.
    """
    trips: dict[int, int] = {}
    for sequence, arrival_ns in answers:
        if sequence > SETTLE_S * RATE_HZ:
            trips.setdefault(sequence, arrival_ns - sent[sequence - 1])
    ordered = sorted(trips.values())
    if not ordered:
        raise ServerGone("no command was answered")
    return RoundTrips(
        p50_s=ordered[len(ordered) // 2] * 1e-9,
        p99_s=ordered[int(0.99 * len(ordered))] * 1e-9,
        unanswered=1 - len(ordered) / (len(sent) - int(SETTLE_S * RATE_HZ)),
    )


if __name__ == "__main__":
    pong(sys.argv[1], int(sys.argv[2]))
