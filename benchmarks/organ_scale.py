"""The shipped liver from surface to model at several node spacings: seconds and peak memory of every stage.

    python benchmarks/organ_scale.py [--spacings-mm 12 8 6.2 4.9] [--superlu]

Each spacing runs in a process of its own, whose peak memory is read after every stage, so it never falls from stage to
stage. Processor seconds stand beside wall seconds: on a shared machine they are the ones to compare. The last table has
the exponent p of processor seconds ~ nodes^p of each stage, by least squares over the bodies that have the same stages.
"""

from __future__ import annotations

import argparse
import json
import platform
import resource
import subprocess
import sys
import time
import tomllib
from pathlib import Path

import numpy as np

CONFIGS = Path(__file__).parents[1] / "configs"


class Recorder:
    """A progress that keeps (stage, wall s, processor s, peak GiB) of each stage that has ended."""

    def __init__(self) -> None:
        self.rows: list[tuple[str, float, float, float]] = []
        self.notes: list[str] = []
        self._name = ""
        self._wall = self._cpu = 0.0

    def __call__(self, stage: str) -> None:
        wall, cpu = time.perf_counter(), time.process_time()
        if self._name:
            peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
            self.rows.append((self._name, wall - self._wall, cpu - self._cpu, peak))
        self._name, self._wall, self._cpu = stage, wall, cpu

    def note(self, text: str) -> None:
        self.notes.append(f"{self._name}: {text}")

    def warn(self, text: str) -> None:
        self.notes.append(f"warning: {text}")


def build(spacing_mm: float, superlu: bool) -> None:
    """Build the model and print the record as JSON."""
    from palpate.build import build_model
    from palpate.factorization import pardiso, solver_name
    from palpate.scene.schema import Config

    if superlu:
        pardiso.library = lambda: None  # type: ignore[assignment]
    scene = tomllib.loads((CONFIGS / "liver.toml").read_text(encoding="utf-8"))
    scene["geometry"]["spacing_m"] = spacing_mm / 1000
    recorder = Recorder()
    model = build_model(Config.model_validate(scene), CONFIGS, recorder)
    recorder("end")
    print(
        json.dumps(
            {"nodes": model.n_nodes, "solver": solver_name(), "rows": recorder.rows, "notes": recorder.notes}
        )
    )


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--spacings-mm", type=float, nargs="+", default=[12.0, 8.0, 6.2, 4.9])
    parser.add_argument("--superlu", action="store_true", help="without MKL PARDISO")
    parser.add_argument("--one", type=float, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.one is not None:
        build(options.one, options.superlu)
        return
    print(f"{platform.processor() or platform.machine()}, Python {platform.python_version()}")
    records = []
    for spacing in options.spacings_mm:
        command = [sys.executable, __file__, "--one", str(spacing)] + ["--superlu"] * options.superlu
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode != 0:
            print(f"{spacing:g} mm failed: {done.stderr.strip().splitlines()[-1]}", flush=True)
            continue
        record = json.loads(done.stdout.splitlines()[-1])
        records.append(record)
        show(spacing, record)
    show_exponents(records)


def show(spacing_mm: float, record: dict) -> None:
    print(f"\n{record['nodes']:,} nodes, {spacing_mm:g} mm, {record['solver']}")
    print(f"{'stage':60} {'wall s':>8} {'cpu s':>8} {'peak GiB':>9}")
    for stage, wall, cpu, peak in record["rows"]:
        print(f"{stage[:60]:60} {wall:8.1f} {cpu:8.1f} {peak:9.2f}")
    walls, cpus = (sum(row[k] for row in record["rows"]) for k in (1, 2))
    print(f"{'all':60} {walls:8.1f} {cpus:8.1f} {max(row[3] for row in record['rows']):9.2f}")
    print("\n".join(record["notes"]), flush=True)


def show_exponents(records: list[dict]) -> None:
    by_stage: dict[str, list[tuple[int, float]]] = {}
    for record in records:
        for stage, _, cpu, _ in record["rows"]:
            by_stage.setdefault(stage, []).append((record["nodes"], cpu))
    print(f"\n{'stage':60} {'exponent':>9} {'from nodes':>16}")
    for stage, points in by_stage.items():
        if len(points) > 1:
            nodes, seconds = np.log(np.array(points)).T
            print(
                f"{stage[:60]:60} {np.polyfit(nodes, seconds, 1)[0]:9.2f} {points[0][0]:7,}-{points[-1][0]:,}"
            )


if __name__ == "__main__":
    main()
