"""A server and a client at 1 kHz for a long time: success rate, lateness, memory, and what became of every command.

    python benchmarks/server_soak.py [MODEL.npz] [--seconds 3600] [--picture OUT.png]

Every command that was sent and not answered is accounted for: it did not reach the server, or the server refused it, or a
newer one replaced it before a tick used it, or the force that answered it did not reach the client. With a surface viewer
at 60 Hz, as long as it lasts.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import psutil

from palpate.model_file import load_model, save_model
from palpate_client import Connection, Surface
from palpate_client.local_server import free_endpoint, running
from palpate_client.wire import Keys
from palpate_server.diagnostics.sample_model import spring_mass_model
from palpate_server.realtime import shared_memory
from palpate_server.realtime.safety import Limits
from palpate_server.session import transport
from palpate_server.session.server import Server, ServerOptions

SAMPLE_S = 10.0
REPORT_S = 300.0


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("model", nargs="?", type=Path, help="(default: a sample of order 100)")
    parser.add_argument("--seconds", type=float, default=3600.0)
    parser.add_argument("--picture", type=Path, help="histogram of lateness, and memory over time")
    parser.add_argument("--serve", nargs=2, metavar=("ENDPOINT", "OUT"), help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.serve:
        serve(options.model, options.serve[0], Path(options.serve[1]))
        return
    with tempfile.TemporaryDirectory() as folder:
        path = options.model or Path(folder) / "sample.npz"
        if options.model is None:
            save_model(spring_mass_model(n_modes=50), path)
        endpoint, out = free_endpoint(), Path(folder) / "histograms.npz"
        # As `palpate serve` does: a pool of BLAS threads would spin.
        os.environ["OPENBLAS_NUM_THREADS"] = "1"
        command = [sys.executable, __file__, str(path), "--serve", endpoint, str(out)]
        with running(command, "serving") as (server, _):
            memory = run(server.pid, endpoint, options.seconds)
        if options.picture:
            with np.load(out) as file:
                draw(file["histograms"], file["longest_ns"], memory, options.picture)


def serve(path: Path, endpoint: str, out: Path) -> None:
    """What `palpate serve` does, and at the end the histograms, which a status only has percentiles of."""
    stop = threading.Event()
    signal.signal(signal.SIGTERM, lambda *_: stop.set())
    limits = Limits(10.0, 2000.0, 1.0, 0.1, 0.0)
    with transport.open_session(endpoint, None) as session:
        options = ServerOptions(limits, path.parent, surface_hz=60.0)
        server = Server(load_model(path), session, Keys(), options)
        server.start()
        print("serving", flush=True)
        while not stop.wait(0.1):
            server.publish_status()
        server.stop()
    np.savez(out, histograms=server.state.memory.histograms, longest_ns=server.state.memory.longest_ns)


def run(server: int, endpoint: str, seconds: float) -> list[tuple[float, float]]:
    """The server's memory over time: (s, MiB)."""
    statuses: list[dict[str, Any]] = []
    memory: list[tuple[float, float]] = []
    surfaces = 0
    command = [sys.executable, "-m", "palpate_client.poke", "--connect", endpoint, "--json"]
    command += ["--duration-s", str(seconds)]
    with Connection(endpoint) as connection:

        def keep_newest(status: dict[str, Any]) -> None:
            statuses[:] = [status]

        def count(surface: Surface) -> None:
            nonlocal surfaces
            surfaces += 1

        connection.on_status(keep_newest)
        connection.on_surface(count)
        client = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        done = threading.Event()
        start = time.monotonic()

        def watch() -> None:
            report_at = REPORT_S
            while not done.wait(SAMPLE_S):
                elapsed = time.monotonic() - start
                memory.append((elapsed, psutil.Process(server).memory_info().rss / 2**20))
                if elapsed >= report_at:
                    report_at += REPORT_S
                    ticks, skipped = statuses[-1]["ticks"], statuses[-1]["skipped_ticks"]
                    print(
                        f"{elapsed:.0f} s: {ticks} ticks, {skipped} skipped, {memory[-1][1]:.1f} MiB",
                        flush=True,
                    )

        watcher = threading.Thread(target=watch)
        watcher.start()
        try:
            out, _ = client.communicate(timeout=seconds + 60)
            time.sleep(0.3)  # until a status counts the last command
        finally:
            client.kill()
            done.set()
            watcher.join()
    report(json.loads(out), statuses[-1], surfaces)
    if memory:
        values = [value for _, value in memory]
        print(
            f"memory: {values[0]:.1f} MiB after {SAMPLE_S:.0f} s, at most {max(values):.1f}, at the end {values[-1]:.1f}"
        )
    return memory


def report(summary: dict[str, Any], status: dict[str, Any], surfaces: int) -> None:
    print(f"client: {json.dumps(summary)}")
    sent, answered = summary["commands_sent"], summary["commands_answered"]
    refused, malformed = sum(status["refused"].values()), sum(status["malformed"].values())
    arrived = status["accepted"] + refused + malformed
    superseded = status["dropped"]["superseded"]
    used = status["accepted"] - superseded
    print(
        f"commands: {sent} sent = {sent - arrived} lost on the way + {refused + malformed} refused + ", end=""
    )
    print(
        f"{superseded} superseded + {used} used; of these {answered} answered, {used - answered} answers lost"
    )
    # An answer can be lost only with its force, and no more commands can arrive than were sent.
    unexplained = max(0, used - answered - summary["forces_lost"]) + max(0, arrived - sent)
    print(f"unexplained: {unexplained}")
    print(f"forces: {summary['forces_received']} received, {summary['forces_lost']} lost, ", end="")
    print(f"{status['dropped']['unsent_force']} not sent; surfaces: {surfaces}")
    for name, tool in status["tools"].items():
        print(f"success rate of {name} since the start: {tool['success_rate_since_start']:.5f}")
    keys = ("ticks", "ticks_on_arrival", "late_ticks", "caught_up_ticks", "skipped_ticks", "faults")
    print("ticks: " + ", ".join(f"{key} {status[key]}" for key in keys))
    for key in ("timer_lateness_s", "tick_lateness_s", "compute_time_s", "input_age_s"):
        print(
            f"{key}: " + ", ".join(f"{k} {v * 1e6:.0f} us" for k, v in status[key].items() if v is not None)
        )


def draw(histograms: Any, longest_ns: Any, memory: list[tuple[float, float]], path: Path) -> None:
    import matplotlib.pyplot as plt

    figure, (left, right) = plt.subplots(1, 2, figsize=(11, 4), layout="constrained")
    for row, label in (
        (shared_memory.TIMER_LATENESS, "deadline timer"),
        (shared_memory.TICK_LATENESS, "tick"),
    ):
        counts = histograms[row]
        edges = np.unique(np.round(np.geomspace(1, len(counts), 60)).astype(int)) - 1
        sums = np.add.reduceat(counts, edges[:-1])
        left.stairs(sums / counts.sum(), edges + 1, label=f"{label}, longest {longest_ns[row] * 1e-6:.1f} ms")
    left.set(xscale="log", yscale="log", xlabel="lateness, µs", ylabel="share of the wakes, of the ticks")
    left.legend()
    times, values = np.array(memory).T
    right.plot(times / 60, values)
    right.set(
        xlabel="time, min", ylabel="memory of the server, MiB", xlim=(0, None), ylim=(0, 1.2 * values.max())
    )
    figure.savefig(path, dpi=110)


if __name__ == "__main__":
    main()
