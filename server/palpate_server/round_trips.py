"""How long answers take over Zenoh at a steady rate: from a bare ping/pong, and from a served model."""

from __future__ import annotations

import contextlib
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgpack
import zenoh

from palpate_server import transport, wire

RATE_HZ = 1000
SETTLE_S = 1.0  # the server's deadlines need a quarter of a second to settle behind the commands
_START_S = 60.0
_CLIENT = "round-trips"


@dataclass(frozen=True)
class RoundTrips:
    """Percentiles in seconds, and the share of messages that got no answer of their own."""

    p50_s: float
    p99_s: float
    unanswered: float


def ping_pong(command_bytes: int, force_bytes: int, seconds: float) -> RoundTrips:
    """Against a Python peer in a process of its own that does nothing but put back `force_bytes` bytes."""
    endpoint = free_endpoint()
    command = [sys.executable, "-m", "palpate_server.round_trips", endpoint, str(force_bytes)]
    with running(command, "ready"), transport.connect_session(endpoint, None) as session:
        padding = bytes(command_bytes - 8)
        return measure(
            session,
            "ping",
            "pong",
            lambda sequence, now: sequence.to_bytes(8, "little") + padding,
            lambda payload: int.from_bytes(payload[:8], "little"),
            seconds,
        )


def pong(endpoint: str, size: int) -> None:
    """The peer of `ping_pong`; runs until it is killed."""
    with transport.open_session(endpoint, None) as session:
        publisher = session.declare_publisher(
            "pong",
            priority=zenoh.Priority.REAL_TIME,
            express=True,
            congestion_control=zenoh.CongestionControl.DROP,
        )
        padding = bytes(size - 8)
        session.declare_subscriber("ping", lambda s: publisher.put(s.payload.to_bytes()[:8] + padding))
        print("ready", flush=True)
        threading.Event().wait()


def through_a_model(
    path: Path, contact: str, seconds: float, *, viewer: bool
) -> tuple[RoundTrips, dict[str, Any]]:
    """Against a server of its own for the model in `path`, driven at one contact; and that server's last status.

    With `viewer` the surface is listened to as well, 60 times a second and by the same process: more work for both.
    """
    endpoint = free_endpoint()
    command = [sys.executable, "-m", "palpate_server", str(path), "--listen", endpoint, "--surface-hz", "60"]
    keys = wire.Keys("main")
    statuses: list[dict[str, Any]] = []
    with running(command, "serving"), transport.connect_session(endpoint, None) as session:
        if viewer:
            session.declare_subscriber(keys.surface, lambda sample: None)
        session.declare_subscriber(
            keys.status, lambda sample: statuses.append(msgpack.unpackb(sample.payload.to_bytes()))
        )
        with holding(session, keys, contact):
            trips = measure(
                session,
                keys.command(_CLIENT),
                keys.force,
                lambda sequence, now: encode_command(contact, sequence, now),
                lambda payload: int(msgpack.unpackb(payload)["sequence"][0]),
                seconds,
            )
            return trips, statuses[-1]


@contextlib.contextmanager
def holding(session: zenoh.Session, keys: wire.Keys, contact: str) -> Iterator[None]:
    """Hold a contact as the client of this module."""
    token = session.liveliness().declare_token(keys.client(_CLIENT))
    request = wire.pack({"contacts": [contact]})
    give_up = time.monotonic() + _START_S
    acquire = keys.control(_CLIENT, "acquire")
    while not any(reply.ok for reply in session.get(acquire, payload=request, timeout=2.0)):
        if time.monotonic() > give_up:
            raise transport.TransportError(f"contact {contact} could not be acquired")
        time.sleep(0.05)
    try:
        yield
    finally:
        token.undeclare()  # type: ignore[no-untyped-call]


def encode_command(contact: str, sequence: int, now_ns: int) -> bytes:
    command = {
        "sequence": sequence,
        "client_time_ns": now_ns,
        "displacement_m": {contact: [0.001, 0.002, -0.003]},
    }
    return wire.pack(command)


def measure(
    session: zenoh.Session,
    send_key: str,
    answer_key: str,
    encode: Callable[[int, int], bytes],
    answered: Callable[[bytes], int],
    seconds: float,
) -> RoundTrips:
    """Send at RATE_HZ and match the answers by sequence; what is sent while settling is not counted."""
    sent: dict[int, int] = {}
    trips: dict[int, int] = {}

    def on_answer(sample: zenoh.Sample) -> None:
        now = time.monotonic_ns()
        sequence = answered(sample.payload.to_bytes())
        if sequence in sent and sequence not in trips:
            trips[sequence] = now - sent[sequence]

    subscriber = session.declare_subscriber(answer_key, on_answer)
    publisher = session.declare_publisher(
        send_key,
        priority=zenoh.Priority.REAL_TIME,
        express=True,
        congestion_control=zenoh.CongestionControl.DROP,
    )
    time.sleep(0.5)
    start_s = time.monotonic()
    for sequence in range(1, int((seconds + SETTLE_S) * RATE_HZ)):
        wait = start_s + sequence / RATE_HZ - time.monotonic()
        if wait > 0:
            time.sleep(wait)
        now = time.monotonic_ns()
        sent[sequence] = now
        publisher.put(encode(sequence, now))
    time.sleep(0.2)
    subscriber.undeclare()  # type: ignore[no-untyped-call]
    counted = [s for s in sent if s > SETTLE_S * RATE_HZ]
    ordered = sorted(trips[s] * 1e-9 for s in counted if s in trips)
    if not ordered:
        raise transport.TransportError(f"nothing on {send_key} was answered on {answer_key}")
    return RoundTrips(
        p50_s=ordered[len(ordered) // 2],
        p99_s=ordered[int(0.99 * len(ordered))],
        unanswered=1 - len(ordered) / len(counted),
    )


def free_endpoint() -> str:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


@contextlib.contextmanager
def running(command: list[str], ready: str) -> Iterator[None]:
    """A process, from the line that says that it is ready; it is ended whatever happens."""
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
    watchdog = threading.Timer(_START_S, process.kill)
    watchdog.start()
    try:
        assert process.stdout is not None
        if not any(line.startswith(ready) for line in iter(process.stdout.readline, "")):
            raise transport.TransportError(f"{' '.join(command[1:3])} did not start")
        watchdog.cancel()
        yield
    finally:
        watchdog.cancel()
        process.terminate()
        try:
            process.wait(5)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
        if process.stdout is not None:
            process.stdout.close()


if __name__ == "__main__":
    pong(sys.argv[1], int(sys.argv[2]))
