"""The liver from surface to model at several node spacings: seconds and peak memory of every stage.

    python benchmarks/organ_scale.py [--spacings-mm 12 8 6.2 4.9] [--without-mkl]

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
    """A progress that prints and keeps (stage, wall s, processor s, peak GiB) of each stage that has ended."""

    def __init__(self) -> None:
        self.rows: list[tuple[str, float, float, float]] = []
        self._name = self._note = ""
        self._wall = self._cpu = 0.0

    def __call__(self, stage: str) -> None:
        wall, cpu = time.perf_counter(), time.process_time()
        if self._name:
            peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
            self.rows.append((self._name, wall - self._wall, cpu - self._cpu, peak))
            print(line(*self.rows[-1]), self._note, flush=True)
        self._name, self._note, self._wall, self._cpu = stage, "", wall, cpu

    def note(self, text: str) -> None:
        self._note = text

    def warn(self, text: str) -> None:
        print(f"warning: {text}", flush=True)


def line(stage: str, wall: float, cpu: float, peak: float) -> str:
    return f"{stage[:40]:40} {wall:8.1f} {cpu:8.1f} {peak:9.2f} "


def build(spacing_mm: float, without_mkl: bool) -> None:
    """Build the model and print the record as JSON."""
    from palpate.build import build_model
    from palpate.factorization import pardiso, solver_name
    from palpate.scene.schema import Config

    if without_mkl:
        pardiso.library = lambda: None  # type: ignore[assignment]
    scene = tomllib.loads((CONFIGS / "liver.toml").read_text(encoding="utf-8"))
    scene["geometry"]["spacing_m"] = spacing_mm / 1000
    recorder = Recorder()
    model = build_model(Config.model_validate(scene), CONFIGS, recorder)
    recorder("end")
    print(json.dumps({"nodes": model.n_nodes, "solver": solver_name(), "rows": recorder.rows}))


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--spacings-mm", type=float, nargs="+", default=[12.0, 8.0, 6.2, 4.9])
    parser.add_argument("--without-mkl", action="store_true", help="as if MKL PARDISO were not installed")
    parser.add_argument("--one", type=float, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.one is not None:
        build(options.one, options.without_mkl)
        return
    print(f"{platform.processor() or platform.machine()}, Python {platform.python_version()}")
    records = []
    for spacing in options.spacings_mm:
        command = [sys.executable, __file__, "--one", str(spacing)] + ["--without-mkl"] * options.without_mkl
        print(f"\n{f'{spacing:g} mm':40} {'wall s':>8} {'cpu s':>8} {'peak GiB':>9}", flush=True)
        record = run(command)
        if record is None:
            print(f"{spacing:g} mm failed", flush=True)
            continue
        records.append(record)
        _, walls, cpus, peaks = zip(*record["rows"], strict=True)
        title = f"all, {record['nodes']:,} nodes, {record['solver']}"
        print(line(title, sum(walls), sum(cpus), max(peaks)), flush=True)
    show_exponents(records)


def run(command: list[str]) -> dict | None:
    """The record of a build, whose other lines are shown as they come; None where it fails."""
    record = None
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        for text in process.stdout or ():
            if text.startswith("{"):
                record = json.loads(text)
            else:
                print(text, end="", flush=True)
    return record if process.returncode == 0 else None


def show_exponents(records: list[dict]) -> None:
    by_stage: dict[str, list[tuple[int, float]]] = {}
    for record in records:
        for stage, _, cpu, _ in record["rows"]:
            by_stage.setdefault(stage, []).append((record["nodes"], cpu))
    print(f"\n{'stage':40} {'exponent':>9} {'from nodes':>16}")
    for stage, points in by_stage.items():
        if len(points) > 1:
            nodes, seconds = np.log(np.array(points)).T
            print(
                f"{stage[:40]:40} {np.polyfit(nodes, seconds, 1)[0]:9.2f} {points[0][0]:7,}-{points[-1][0]:,}"
            )


if __name__ == "__main__":
    main()
