"""Draws docs/images/contact.png: what a tool does to the liver that is touched anywhere.

    python scripts/contact_figures.py liver-surface.npz OUT.png

A tool of the model presses, slides and lets go. Left: the error map of the file. Right: force, points in contact and energies.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from palpate.demo.surface import replayed, surface_path
from palpate.model_file import SurfaceModel, load_model
from palpate.surface_plots import Felt, draw_body, draw_energies, draw_forces

SECONDS, STIFFNESS_N_PER_M = 2.0, 700.0


def main() -> None:
    path, out = (Path(name) for name in sys.argv[1:3])
    model = load_model(path)
    if not isinstance(model, SurfaceModel):
        sys.exit(f"{path}: expected a surface model, this is of kind {model.kind!r}")
    felt = replayed(model, surface_path(model, SECONDS), STIFFNESS_N_PER_M)
    figure = Figure(figsize=(13.5, 7.2), layout="constrained")
    halves: Any = figure.subfigures(1, 2, width_ratios=[1.0, 1.15])
    left, right = halves
    draw_error_map(left, model, felt)
    draw_touch(right, felt)
    figure.savefig(out, dpi=110)


def draw_error_map(figure: Any, model: SurfaceModel, felt: Felt) -> None:
    error = 100 * model.accuracy.error_map.astype(float)
    norm = Normalize(0.0, float(np.percentile(error, 95)))
    axis, mapper = draw_body(figure, model, model.points, error, norm, felt.position_m)
    axis.set_title(f"{model.name}: {model.n_points:,} points, {model.n_modes} modes and Ritz modes")
    low_hz, high_hz = model.band_hz
    label = f"largest force error, {low_hz:g} to {high_hz:g} Hz, %"
    figure.colorbar(mapper, ax=axis, shrink=0.6, label=label, extend="max")


def draw_touch(figure: Any, felt: Felt) -> None:
    force, points, energy = figure.subplots(3, 1, sharex=True)
    draw_forces(force, felt)
    points.step(felt.time_s, felt.n_points, color="tab:green", where="post")
    points.set_ylabel("points in contact")
    draw_energies(energy, felt)
    energy.set_xlabel("time, s")
    for axis in (force, points, energy):
        axis.grid(alpha=0.25)
        axis.spines[["top", "right"]].set_visible(False)
    figure.suptitle("Press, slide, let go")


if __name__ == "__main__":
    main()
