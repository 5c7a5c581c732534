"""How long after a cursor message the bridge to Haply's service sends a force that knows of it.

A service that speaks Haply's JSON moves the hand by a step into the tissue and out again, ten times a second. The time from the first
state that shows the hand inside to the first command with a force is the whole way: service, bridge, server, bridge, service. Beside
it, in the same run, a bare client answers each state at once: the way through the WebSocket alone.

    python benchmarks/haply_latency.py [--seconds 10] [--model FILE.npz]
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from websockets.sync.client import connect

from inverse_service import InverseService, Vector
from palpate.model_file import save_model
from palpate_client.local_server import free_endpoint, running
from palpate_server.diagnostics.sample_model import spring_mass_model

BRIDGE = Path(__file__).parents[1] / "client_examples" / "haply_bridge.py"
NO_FORCE = (0.0, 0.0, 0.0)
STEP_S, DEPTH_M = 0.05, 1e-3
WARM_UP_S = 4.0  # the bridge connects and measures the round trip


def stepping(t: float) -> Vector:
    inside = t > WARM_UP_S and int(t / STEP_S) % 2
    return 0.0, 0.0, -DEPTH_M if inside else DEPTH_M / 10


def until_a_force(service: InverseService) -> np.ndarray:
    """Seconds from each first state inside to the first command with a force after it; NaN where none came before the hand left."""
    sent = np.array([t for t, _ in service.states])
    inside = np.array([position[2] < 0 for _, position in service.states])
    forces = np.array([t for t, force in service.forces if force != NO_FORCE])
    entered = sent[1:][inside[1:] & ~inside[:-1]]
    left = sent[1:][~inside[1:] & inside[:-1]]
    found = []
    for start, end in zip(entered, left, strict=False):
        later = forces[(forces > start) & (forces < end)]
        found.append((later[0] - start) * 1e-9 if len(later) else np.nan)
    return np.array(found)


def until_the_next_command(service: InverseService) -> np.ndarray:
    """Seconds from each state to the command that came next."""
    sent = np.array([t for t, _ in service.states])
    came = np.array([t for t, _ in service.forces])
    after = np.searchsorted(came, sent)
    inside = after < len(came)
    return (came[after[inside]] - sent[inside]) * 1e-9


def bare(seconds: float) -> np.ndarray:
    """The same exchange with a client that answers each state at once."""
    command = '{"inverse3": [{"device_id": "04a1", "commands": {"set_cursor_force": {"values": {"x": 0, "y": 0, "z": 0}}}}]}'
    with InverseService(lambda t: NO_FORCE) as service, connect(service.url, compression=None) as socket:
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            socket.recv()
            socket.send(command)
        return until_the_next_command(service)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--model", type=Path, help="model file (default: a sample of one patch)")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        model = options.model or Path(folder) / "sample.npz"
        if options.model is None:
            save_model(spring_mass_model(1, 20), model)
        endpoint = free_endpoint()
        serve = [sys.executable, "-m", "palpate_server", str(model), "--listen", endpoint]
        with running(serve, "serving"), InverseService(stepping) as service:
            place = ["--connect", endpoint, "--service", service.url, "--silence-s", "5"]
            done = subprocess.run(
                [sys.executable, str(BRIDGE), *place, "--duration-s", str(options.seconds)], check=False
            )
            assert not service.errors, service.errors
            whole = until_a_force(service)
        exchange = bare(1.0)
    came = whole[np.isfinite(whole)]
    print(
        f"steps into the tissue      {len(whole)}, without a force in {STEP_S * 1e3:g} ms: {len(whole) - len(came)}"
    )
    for name, times in (("cursor to force", came), ("bare WebSocket", exchange)):
        p50, p95, p99 = np.percentile(times, [50, 95, 99]) * 1e3
        print(
            f"{name:<26} p50 {p50:.3f}, p95 {p95:.3f}, p99 {p99:.3f} ms; within 2 ms: {np.mean(times < 2e-3):.1%}"
        )
    print(f"ratio of the medians       {np.median(came) / np.median(exchange):.2f}")
    return done.returncode


if __name__ == "__main__":
    sys.exit(main())
