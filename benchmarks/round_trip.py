"""Command to force, against a bare Zenoh ping/pong of the same sizes and settings, alternating in one run.

    python benchmarks/round_trip.py [MODEL.npz] [--runs 5] [--seconds 10]

Prints the medians over the runs of p50 and p99 and their ratios. The client, the rate (1 kHz), the pacing and the Zenoh
settings are the same for both; the ping/pong peer does nothing but put back as many bytes as a force message has.
"""

from __future__ import annotations

import argparse
import statistics
import tempfile
from pathlib import Path

import numpy as np

from palpate.model_file import load_model, save_model
from palpate_server import codec
from palpate_server.diagnostics.round_trips import (
    RATE_HZ,
    RoundTrips,
    encode_command,
    ping_pong,
    through_a_model,
)
from palpate_server.diagnostics.sample_model import spring_mass_model
from palpate_server.realtime.records import PORT_RECORD, TICK


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
        tool = model.contacts[0].name
        n = len(model.contacts)
        force_bytes = len(
            codec.ForceEncoder(n).encode(
                codec.as_words(np.zeros(1, TICK))[0], codec.as_words(np.zeros(n, PORT_RECORD))
            )
        )
        command_bytes = len(encode_command(10**6, 10**15, {tool: (0.1, 0.2, 0.3)}))
        print(
            f"order {model.order}, {n} tools; "
            f"command {command_bytes} bytes, force {force_bytes} bytes, {RATE_HZ} Hz"
        )
        bare, palpate = [], []
        for run in range(options.runs):
            bare.append(ping_pong(command_bytes, force_bytes, options.seconds))
            palpate.append(through_a_model(path, [tool], options.seconds, viewer=False)[0])
            print(f"run {run}: ping/pong {describe(bare[-1])}; palpate {describe(palpate[-1])}", flush=True)
        for name in ("p50_s", "p99_s"):
            b, p = (statistics.median(getattr(r, name) for r in results) for results in (bare, palpate))
            print(f"{name[:3]}: ping/pong {b * 1e6:.0f} us, palpate {p * 1e6:.0f} us, ratio {p / b:.2f}")


def describe(trips: RoundTrips) -> str:
    return f"p50 {trips.p50_s * 1e6:.0f} p99 {trips.p99_s * 1e6:.0f} us, {trips.unanswered:.2%} unanswered"


if __name__ == "__main__":
    main()
