"""A server and a client at 1 kHz for a long time: success rate, lateness, memory, and what became of every command.

python benchmarks/server_soak.py [MODEL.npz] [--seconds 3600]
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import threading
from pathlib import Path
from typing import Any

import msgpack
import psutil

from palpate.model import save_model
from palpate_server import transport, wire
from palpate_server.round_trips import free_endpoint
from palpate_server.sample_model import spring_mass_model

CLIENT = Path(__file__).parents[1] / "client_examples" / "headless_client.py"
SAMPLE_S = 10.0


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("model", nargs="?", type=Path, help="(default: a sample of order 100)")
    parser.add_argument("--seconds", type=float, default=3600.0)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        path = options.model or Path(folder) / "sample.npz"
        if options.model is None:
            save_model(spring_mass_model(n_modes=50), path)
        endpoint = free_endpoint()
        server = subprocess.Popen(
            [sys.executable, "-m", "palpate_server", str(path), "--listen", endpoint],
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
        )
        try:
            assert server.stdout is not None
            assert server.stdout.readline().startswith("serving")
            run(server.pid, endpoint, options.seconds)
        finally:
            server.terminate()
            server.wait(10)


def run(server: int, endpoint: str, seconds: float) -> None:
    statuses: list[dict[str, Any]] = []
    memory: list[int] = []
    command = [sys.executable, str(CLIENT), "--connect", endpoint, "--json", "--duration-s", str(seconds)]
    with transport.connect_session(endpoint, None) as session:

        def keep_newest(sample: Any) -> None:
            statuses[:] = [msgpack.unpackb(sample.payload.to_bytes())]

        session.declare_subscriber(wire.Keys("main").status, keep_newest)
        client = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        done = threading.Event()

        def watch() -> None:
            while not done.wait(SAMPLE_S):
                memory.append(psutil.Process(server).memory_info().rss)

        watcher = threading.Thread(target=watch)
        watcher.start()
        try:
            out, _ = client.communicate(timeout=seconds + 60)
        finally:
            client.kill()
            done.set()
            watcher.join()
    summary, status = json.loads(out), statuses[-1]
    settled = memory[len(memory) // 4 :] or memory  # the first quarter is start-up
    print(f"client: {json.dumps(summary)}")
    print(f"commands: {summary['commands_sent']} sent, {status['accepted']} accepted, ", end="")
    print(f"{sum(status['refused'].values())} refused, {sum(status['malformed'].values())} malformed")
    print(f"answered: {summary['commands_answered']}; newer one used instead, or lost on the way: ", end="")
    print(summary["commands_unanswered"])
    print(f"forces: {summary['forces_received']} received, {summary['forces_lost']} lost")
    keys = ("ticks", "ticks_on_arrival", "late_ticks", "caught_up_ticks", "skipped_ticks", "faults")
    print("ticks: " + ", ".join(f"{key} {status[key]}" for key in keys))
    for key in ("timer_lateness_s", "tick_lateness_s", "compute_time_s", "input_age_s"):
        print(
            f"{key}: " + ", ".join(f"{k} {v * 1e6:.0f} us" for k, v in status[key].items() if v is not None)
        )
    if settled:
        print(
            f"memory: {settled[0] / 2**20:.1f} MiB after start-up, {settled[-1] / 2**20:.1f} MiB at the end"
        )


if __name__ == "__main__":
    main()
