"""Lateness of the deadline timer with a client and a surface viewer at work, against cyclictest under the same policy.

    python benchmarks/tick_lateness.py [MODEL.npz] [--runs 3] [--seconds 20]

cyclictest (Debian: rt-tests) wakes once a millisecond and does nothing, while a second copy of everything runs: it is
the machine's own floor under the same load. Prints p50 and p99 of both in microseconds, and the ratio.
"""

from __future__ import annotations

import argparse
import shutil
import statistics
import subprocess
import tempfile
import threading
from pathlib import Path
from typing import Any

from palpate.model_file import load_model, save_model
from palpate_server.diagnostics.round_trips import through_a_model
from palpate_server.diagnostics.sample_model import spring_mass_model
from palpate_server.realtime import threads


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("model", nargs="?", type=Path, help="(default: a sample of order 100)")
    parser.add_argument("--runs", type=int, default=3)
    parser.add_argument("--seconds", type=float, default=20.0)
    options = parser.parse_args()
    fifo = may_use_fifo()
    print(f"scheduling policy: {'FIFO ' + str(threads.LOOP_PRIORITY) if fifo else 'OTHER'}")
    ours, floor = [], []
    with tempfile.TemporaryDirectory() as folder:
        path = options.model or Path(folder) / "sample.npz"
        if options.model is None:
            save_model(spring_mass_model(n_modes=50), path)
        contact = load_model(path).contacts[0].name
        for run in range(options.runs):
            status, bare = measure(Path(folder), path, contact, options.seconds, fifo)
            timer = status["timer_lateness_s"]
            ours.append((timer["p50"] * 1e6, timer["p99"] * 1e6))
            floor.append(bare)
            print(
                f"run {run}: palpate p50 {ours[-1][0]:.0f} p99 {ours[-1][1]:.0f}, "
                f"cyclictest p50 {bare[0]:.0f} p99 {bare[1]:.0f} us; {status['ticks']} ticks, "
                f"{status['late_ticks']} late, {status['skipped_ticks']} skipped",
                flush=True,
            )
    for name, index in (("p50", 0), ("p99", 1)):
        a, b = (statistics.median(result[index] for result in results) for results in (ours, floor))
        print(f"{name}: palpate {a:.0f} us, cyclictest {b:.0f} us, ratio {a / b:.2f}")


def may_use_fifo() -> bool:
    """Whether this user may; tried on a thread of its own, so that nothing else changes."""
    result: list[bool] = []

    def attempt() -> None:
        result.append(threads.raise_priority() is None)

    thread = threading.Thread(target=attempt)
    thread.start()
    thread.join()
    return result[0]


def measure(
    folder: Path, path: Path, contact: str, seconds: float, fifo: bool
) -> tuple[dict[str, Any], tuple[float, float]]:
    """The server's last status, and p50 and p99 of cyclictest beside it, in microseconds."""
    output = folder / "cyclictest.txt"  # more text than a pipe holds
    bare = cyclictest(seconds, fifo, output)
    try:
        _, status = through_a_model(path, [contact], seconds, viewer=True)
    finally:
        bare.wait()
    return status, read_histogram(output.read_text())


def cyclictest(seconds: float, fifo: bool, output: Path) -> subprocess.Popen[str]:
    program = shutil.which("cyclictest") or next(
        (str(p) for p in (Path("/usr/bin/cyclictest"), Path("/usr/sbin/cyclictest")) if p.exists()), None
    )
    if program is None:
        raise SystemExit("cyclictest is not installed (Debian: apt install rt-tests)")
    policy = ["-p", str(threads.LOOP_PRIORITY)] if fifo else ["--policy=other"]
    command = [program, "-q", "-m", "-t1", "-i1000", "-D", str(int(seconds)), "-h", "20000", *policy]
    with output.open("w") as file:
        return subprocess.Popen(command, stdout=file, stderr=subprocess.DEVNULL, text=True)


def read_histogram(text: str) -> tuple[float, float]:
    """p50 and p99 from lines of `microseconds count`."""
    rows = [line.split() for line in text.splitlines() if line and not line.startswith("#")]
    counts = [(int(row[0]), int(row[1])) for row in rows if len(row) == 2 and row[0].isdigit()]
    total = sum(count for _, count in counts)

    def at(share: float) -> float:
        seen = 0
        for microseconds, count in counts:
            seen += count
            if seen >= share * total:
                return float(microseconds)
        return float(counts[-1][0])

    return at(0.5), at(0.99)


if __name__ == "__main__":
    main()
