"""How long answers take over Zenoh at a steady rate, and in which order: from a bare ping/pong, and from a served model."""

from __future__ import annotations

import contextlib
import sys
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import zenoh
from numpy.typing import NDArray

from palpate_client import Connection, ServerGone
from palpate_client.connection import open_session
from palpate_client.local_server import free_endpoint, running
from palpate_client.wire import Kind, MalformedMessage, pack, unpack
from palpate_server.session import transport

RATE_HZ = 1000
SETTLE_S = 1.0  # the server's deadlines need a quarter of a second to settle behind the commands
_STEP_M = (0.001, 0.002, -0.003)  # from where the tool is at rest


@dataclass(frozen=True)
class RoundTrips:
    """Percentiles in seconds, and the share of messages that got no answer of their own."""

    p50_s: float
    p99_s: float
    unanswered: float


class Heard(NamedTuple):
    """One force message, and when the client had it; times in ns on one monotonic clock."""

    arrival_ns: int
    tick: int
    server_time_ns: int
    sequence: int
    input_age_ns: int


@dataclass(frozen=True)
class Trace:
    """What n ticks of a device and m of the server had to do with each other, in order; ns on one monotonic clock.

    device_ns (n,): when the device's tick k reads its position, sends it as command k and takes up the newest force it has;
    rendered (n,): of which tick of the server that force is, -1 while there is none
    server_ns (m,): when the server's tick began; arrival_ns (m,): when the command that it used had come; used (m,): which
    one that was, negative while there is none. A tick without a new command used the one before again.
    """

    device_ns: NDArray[np.int64]
    rendered: NDArray[np.int64]
    server_ns: NDArray[np.int64]
    arrival_ns: NDArray[np.int64]
    used: NDArray[np.int64]

    def answered(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """The device's ticks at which it had a force, and the commands that these forces answer."""
        command = np.where(self.rendered >= 0, self.used[self.rendered], -1)
        return np.flatnonzero(command >= 0), command[command >= 0]

    def ages_ns(self) -> NDArray[np.int64]:
        """At each of these ticks, how long ago the device had read the position that its force answers."""
        ticks, commands = self.answered()
        return self.device_ns[ticks] - self.device_ns[commands]

    def piece(self, start: int, ticks: int) -> Trace:
        """The device's ticks from `start` on as a trace of its own; commands before it count as none."""
        stop = start + ticks
        if not 0 <= start < stop <= len(self.device_ns):
            raise ValueError(f"a trace of {len(self.device_ns)} ticks has no ticks from {start} to {stop}")
        first = max(int(self.rendered[start]), 0)
        last = max(int(self.rendered[stop - 1]) + 1, first)
        return Trace(
            device_ns=self.device_ns[start:stop],
            rendered=np.maximum(self.rendered[start:stop] - first, -1),
            server_ns=self.server_ns[first:last],
            arrival_ns=self.arrival_ns[first:last],
            used=np.maximum(self.used[first:last] - start, -1),
        )


def steady_trace(ticks: int, late: int) -> Trace:
    """Nothing is lost or early: at each tick the device has the force for its position `late` >= 1 ticks before."""
    device_ns = np.arange(ticks) * (1_000_000_000 // RATE_HZ)
    return Trace(device_ns, np.maximum(np.arange(ticks) - late, -1), device_ns, device_ns, np.arange(ticks))


def trace_of(sent_ns: Sequence[int], heard: Sequence[Heard]) -> Trace:
    """Of commands 1, 2, ... sent at these times, each at a tick of a device, and the forces that came, in order of ticks.

    What a tick did whose force was lost is not known: it is taken to have used the command of the tick before again.
    """
    device_ns = np.array(sent_ns, np.int64)
    arrival, tick, server_ns, sequence, age = np.array(heard, np.int64).reshape(-1, 5).T
    if not len(tick):
        raise ValueError("no force was heard")
    # The newest at each of the server's ticks, also of those that were not heard.
    at = np.searchsorted(tick, np.arange(tick[0], tick[-1] + 1), side="right") - 1
    newest = np.searchsorted(arrival, device_ns, side="right") - 1
    return Trace(
        device_ns=device_ns,
        rendered=np.where(newest >= 0, tick[newest] - tick[0], -1),
        server_ns=server_ns[at],
        arrival_ns=(server_ns - age)[at],
        used=np.where(sequence > 0, sequence - 1, -1)[at],
    )


def ping_pong(command_bytes: int, force_bytes: int, seconds: float) -> RoundTrips:
    """Against a Python peer in a process of its own that does nothing but put back `force_bytes` bytes."""
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
    """The peer of `ping_pong`; runs until it is killed."""
    with transport.open_session(endpoint, None) as session:
        publisher = session.declare_publisher("pong", **_real_time())
        padding = bytes(size - 8)
        session.declare_subscriber("ping", lambda s: publisher.put(s.payload.to_bytes()[:8] + padding))
        print("ready", flush=True)
        threading.Event().wait()


def through_a_model(
    path: Path, tool: str, seconds: float, *, viewer: bool
) -> tuple[RoundTrips, dict[str, Any]]:
    """Against a server of its own for the model in `path`, driven at one tool; and that server's last status.

    With `viewer` the surface is received as well, 60 times a second and by the same process: more work for both.
    """
    sent, forces, status = _through_a_model(path, tool, seconds, viewer)
    return _match(sent, [(force.sequence, force.arrival_ns) for force in forces]), status


def trace_through_a_model(path: Path, tool: str, seconds: float) -> tuple[RoundTrips, Trace]:
    """The same without a viewer, at the model's first tool, and all that a device would have lived through meanwhile."""
    sent, forces, _ = _through_a_model(path, tool, seconds, viewer=False)
    settled = int(SETTLE_S * RATE_HZ)
    trips = _match(sent, [(force.sequence, force.arrival_ns) for force in forces])
    return trips, trace_of(sent, forces).piece(settled, len(sent) - settled)


def _through_a_model(
    path: Path, tool: str, seconds: float, viewer: bool
) -> tuple[list[int], list[Heard], dict[str, Any]]:
    """When each command was sent, ns, every force of the tool, and the last status."""
    endpoint = free_endpoint()
    command = [sys.executable, "-m", "palpate_server", str(path), "--listen", endpoint, "--surface-hz", "60"]
    forces: list[Heard] = []
    statuses: list[dict[str, Any]] = []
    with running(command, "serving"), Connection(endpoint) as connection:
        index = connection.description.index(tool)
        connection.on_status(statuses.append)
        if viewer:
            connection.on_surface(lambda surface: None)

        def receive(arrival_ns: int, payload: bytes) -> None:
            with contextlib.suppress(MalformedMessage):
                force = unpack(payload, Kind.FORCE)
                sequence, age_ns = force["sequence"][index], force["input_age_ns"][index]
                forces.append(Heard(arrival_ns, force["tick"], force["server_time_ns"], sequence, age_ns))

        acquired = connection.control("acquire", tools=[tool])["tools"][tool]
        position_m = [home + step for home, step in zip(acquired["home_m"], _STEP_M, strict=True)]
        sent = _drive(
            connection.zenoh,
            (connection.keys.command(connection.name), connection.keys.force),
            lambda sequence, now: encode_command(tool, sequence, now, position_m),
            receive,
            seconds,
        )
    return sent, forces, statuses[-1]


def encode_command(tool: str, sequence: int, now_ns: int, position_m: Sequence[float]) -> bytes:
    return pack(
        {
            "kind": Kind.COMMAND,
            "sequence": sequence,
            "client_time_ns": now_ns,
            "position_m": {tool: list(position_m)},
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
    """Send commands 1, 2, ... at RATE_HZ to one key and hand on each answer of another; when each was sent, ns.

    What is sent while settling is measured too: `_match` leaves it out.
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
    """sent: when command 1, 2, ... was; answers: of which command, and when it came; ns. Raises ServerGone without any."""
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
