"""Command to force, against a bare Zenoh ping/pong of the same sizes and settings, alternating in one run.

    python benchmarks/round_trip.py [MODEL.npz] [--runs 5] [--seconds 10]

Prints the medians over the runs of p50 and p99 and their ratios. The client, the rate (1 kHz), the pacing and the Zenoh
settings are the same for both; the ping/pong peer does nothing but put back as many bytes as a force message has.
"""

from __future__ import annotations

import argparse
import json
import socket
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from pathlib import Path

import msgpack
import zenoh

from palpate.model import load_model, save_model
from palpate_server import transport, wire
from palpate_server.sample_model import spring_mass_model

RATE_HZ = 1000
SETTLE_S = 1.0  # the deadlines need a quarter of a second to settle behind the commands

# In a process of its own: the least that a Python peer can do.
PONG = """
import sys, threading, zenoh
from palpate_server import transport
with transport.open_session(sys.argv[1], None) as session:
    pong = session.declare_publisher("pong", priority=zenoh.Priority.REAL_TIME, express=True,
                                     congestion_control=zenoh.CongestionControl.DROP)
    padding = bytes(int(sys.argv[2]) - 8)
    ping = session.declare_subscriber("ping", lambda s: pong.put(s.payload.to_bytes()[:8] + padding))
    print("ready", flush=True)
    threading.Event().wait()
"""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("model", nargs="?", type=Path, help="(default: a sample of order 100)")
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("--seconds", type=float, default=10.0)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        path = options.model or Path(folder) / "sample.npz"
        if options.model is None:
            save_model(spring_mass_model(n_modes=50), path)
        model = load_model(path)
        contact = model.contacts[0].name
        inputs, motion = [[10**6] * 4] * len(model.contacts), [[0.1] * 8] * len(model.contacts)
        force_bytes = len(wire.encode_force(10**6, 10**15, inputs, motion))
        command_bytes = len(encode_command(contact, 10**6, 10**15))
        print(f"order {model.order}, {len(model.contacts)} contacts; ", end="")
        print(f"command {command_bytes} bytes, force {force_bytes} bytes, {RATE_HZ} Hz")
        bare, palpate = [], []
        for run in range(options.runs):
            bare.append(ping_pong(command_bytes, force_bytes, options.seconds))
            palpate.append(through_the_model(path, contact, options.seconds))
            print(f"run {run}: ping/pong {describe(bare[-1])}; palpate {describe(palpate[-1])}", flush=True)
        for name, index in (("p50", 0), ("p99", 1)):
            b = statistics.median(result[index] for result in bare)
            p = statistics.median(result[index] for result in palpate)
            print(f"{name}: ping/pong {b:.0f} us, palpate {p:.0f} us, ratio {p / b:.2f}")


def describe(result: tuple[float, float, float]) -> str:
    return f"p50 {result[0]:.0f} p99 {result[1]:.0f} us, {result[2]:.2%} unanswered"


def encode_command(contact: str, sequence: int, now_ns: int) -> bytes:
    command = {
        "sequence": sequence,
        "client_time_ns": now_ns,
        "displacement_m": {contact: [0.001, 0.002, -0.003]},
    }
    return msgpack.packb(command)


def ping_pong(command_bytes: int, force_bytes: int, seconds: float) -> tuple[float, float, float]:
    endpoint = free_endpoint()
    server = start([sys.executable, "-c", PONG, endpoint, str(force_bytes)], "ready")
    try:
        with zenoh.open(client_config(endpoint)) as session:
            padding = bytes(command_bytes - 8)
            return measure(
                session,
                "ping",
                "pong",
                lambda sequence, now: sequence.to_bytes(8, "little") + padding,
                lambda payload: int.from_bytes(payload[:8], "little"),
                seconds,
            )
    finally:
        end(server)


def through_the_model(path: Path, contact: str, seconds: float) -> tuple[float, float, float]:
    endpoint = free_endpoint()
    server = start([sys.executable, "-m", "palpate_server", str(path), "--listen", endpoint], "serving")
    try:
        with zenoh.open(client_config(endpoint)) as session:
            keys = wire.Keys("main")
            token = session.liveliness().declare_token(keys.client("bench"))
            request = wire.pack({"client": "bench", "contacts": [contact]})
            granted = False
            while not granted:
                granted = any(r.ok for r in session.get(keys.control("acquire"), payload=request, timeout=2))
            result = measure(
                session,
                keys.command("bench"),
                keys.force,
                lambda sequence, now: encode_command(contact, sequence, now),
                lambda payload: msgpack.unpackb(payload)["sequence"][0],
                seconds,
            )
            token.undeclare()
            return result
    finally:
        end(server)


def measure(
    session: zenoh.Session,
    send_key: str,
    answer_key: str,
    encode: Callable[[int, int], bytes],
    answered: Callable[[bytes], int],
    seconds: float,
) -> tuple[float, float, float]:
    """Send at RATE_HZ; p50 and p99 in microseconds and the share that was not answered, after settling."""
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
    subscriber.undeclare()
    counted = [s for s in sent if s > SETTLE_S * RATE_HZ]
    ordered = sorted(trips[s] / 1000 for s in counted if s in trips)
    lost = 1 - len(ordered) / len(counted)
    return ordered[len(ordered) // 2], ordered[int(0.99 * len(ordered))], lost


def client_config(endpoint: str) -> zenoh.Config:
    config = zenoh.Config()
    settings = {
        "mode": "peer",
        "listen/endpoints": [],
        "connect/endpoints": [endpoint],
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "transport/link/tx/lease": transport.LEASE_MS,
    }
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))
    return config


def free_endpoint() -> str:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


def start(command: list[str], ready: str) -> subprocess.Popen[str]:
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    watchdog = threading.Timer(60, process.kill)
    watchdog.start()
    assert process.stdout is not None
    for line in process.stdout:
        if line.startswith(ready):
            watchdog.cancel()
            return process
    raise SystemExit(f"{command[1:3]} did not start")


def end(process: subprocess.Popen[str]) -> None:
    process.terminate()
    try:
        process.wait(5)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


if __name__ == "__main__":
    main()
