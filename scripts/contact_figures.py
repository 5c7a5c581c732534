"""Draws docs/images/contact.png: what a tool does to the liver that is touched anywhere.

    python scripts/contact_figures.py liver-surface.npz OUT.png

A tool of the model presses, slides and lets go. Left: the error map of the file. Right: force, points in contact and energies.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LightSource, Normalize
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d.art3d import Poly3DCollection
from numpy.typing import NDArray

from palpate.model_file import SurfaceModel, load_model
from palpate_server.simulation import Simulation

Array = NDArray[np.float64]

CLEAR_M, DEPTH_M, SLIDE_M = 1e-3, 4e-3, 0.015
PRESSED_S, SLID_S, LIFTED_S = 0.4, 1.4, 1.8  # when each part ends; then 0.2 s without contact


def main() -> None:
    path, out = (Path(name) for name in sys.argv[1:3])
    model = load_model(path)
    if not isinstance(model, SurfaceModel):
        sys.exit(f"{path}: expected a surface model, this is of kind {model.kind!r}")
    start, along, normal = frame(model)
    time_s: Array = np.linspace(0.0, 2.0, round(2.0 / model.period_s), endpoint=False)
    positions, felt = touch(model, time_s, start, along, normal)

    figure = Figure(figsize=(13.5, 7.2), layout="constrained")
    halves: Any = figure.subfigures(1, 2, width_ratios=[1.0, 1.15])
    left, right = halves
    draw_error_map(left, model, positions, normal)
    draw_touch(right, time_s, felt)
    figure.savefig(out, dpi=110)


def frame(model: SurfaceModel) -> tuple[Array, Array, Array]:
    """Where the first tool's center touches, the direction in which it slides, and the outward normal there; (3,) each."""
    tool = model.tools[0]
    away = model.points - np.asarray(tool.home_m)
    point = int(np.argmin(np.linalg.norm(away, axis=1)))
    normal = model.normals[point]
    along = np.cross(normal, [0.0, 1.0, 0.0] if abs(normal[1]) < 0.9 else [0.0, 0.0, 1.0])
    return model.points[point] + tool.radius_m * normal, along / np.linalg.norm(along), normal


def touch(
    model: SurfaceModel, time_s: Array, start: Array, along: Array, normal: Array
) -> tuple[Array, dict[str, Array]]:
    """Centers of the tool, (n_ticks, 3), m, and what was felt and where the energy is, by name, (n_ticks,)."""
    depth = np.interp(time_s, [0, PRESSED_S, SLID_S, LIFTED_S], [-CLEAR_M, DEPTH_M, DEPTH_M, -CLEAR_M])
    slid = np.interp(time_s, [PRESSED_S, SLID_S], [0, SLIDE_M])
    positions = start - depth[:, None] * normal + slid[:, None] * along
    simulation, name = Simulation(model), model.tools[0].name
    rows = []
    for position in positions:
        reaction = simulation.step({name: position})[name]
        across = reaction.force_n @ reaction.normal
        friction = float(np.linalg.norm(reaction.force_n - across * reaction.normal))
        stored, dissipated = simulation.energy()
        rows.append(
            (
                across,
                friction,
                reaction.n_points,
                reaction.work_j,
                stored + reaction.stored_j,
                dissipated + reaction.dissipated_j,
            )
        )
    return positions, dict(
        zip(("normal", "friction", "points", "work", "stored", "lost"), np.array(rows).T, strict=True)
    )


def draw_error_map(figure: Any, model: SurfaceModel, positions: Array, normal: Array) -> None:
    error = 100 * model.accuracy.error_map.astype(float)
    mapper = ScalarMappable(norm=Normalize(0.0, float(np.percentile(error, 99))), cmap="viridis")
    colors = mapper.to_rgba(error[model.triangles].mean(axis=1))
    axis = figure.add_subplot(projection="3d")
    azimuth = float(np.degrees(np.arctan2(normal[1], normal[0])))
    elevation = float(np.degrees(np.arcsin(normal[2])))
    points = 1e3 * model.points
    axis.add_collection3d(
        Poly3DCollection(
            points[model.triangles],
            facecolors=colors,
            edgecolors=colors,
            linewidths=0.2,
            shade=True,
            lightsource=LightSource(azdeg=60 - azimuth, altdeg=60),
        )
    )
    axis.plot(*(1e3 * positions).T, color="tab:red", linewidth=3, zorder=10, label="path of the tool")
    low, high = points.min(axis=0), points.max(axis=0)
    axis.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]))
    axis.set_box_aspect(high - low, zoom=1.15)
    axis.view_init(elev=elevation, azim=azimuth)
    axis.set_axis_off()
    axis.legend(loc="upper left", frameon=False)
    low_hz, high_hz = model.band_hz
    axis.set_title(f"{model.name}: {model.n_points:,} points, {model.n_modes} modes")
    figure.colorbar(
        mapper,
        ax=axis,
        shrink=0.6,
        label=f"largest force error, {low_hz:g} to {high_hz:g} Hz, %",
        extend="max",
    )


def draw_touch(figure: Any, time_s: Array, felt: dict[str, Array]) -> None:
    force, points, energy = figure.subplots(3, 1, sharex=True)
    force.plot(time_s, felt["normal"], color="tab:blue", label="along the contact's normal")
    force.plot(time_s, felt["friction"], color="tab:orange", label="across: friction")
    force.set_ylabel("force on the tool, N")
    points.step(time_s, felt["points"], color="tab:green", where="post")
    points.set_ylabel("points in contact")
    for name, label, color in (
        ("work", "work of the tool", "tab:red"),
        ("stored", "stored", "tab:blue"),
        ("lost", "dissipated", "0.5"),
    ):
        energy.plot(time_s, 1e3 * felt[name], label=label, color=color)
    energy.plot(
        time_s, 1e3 * (felt["stored"] + felt["lost"]), "k:", linewidth=1.0, label="stored and dissipated"
    )
    energy.set_ylabel("energy, mJ")
    energy.set_xlabel("time, s")
    for axis in (force, points, energy):
        for moment in (PRESSED_S, SLID_S, LIFTED_S):
            axis.axvline(moment, color="0.8", linewidth=0.8)
        axis.grid(alpha=0.25)
        axis.spines[["top", "right"]].set_visible(False)
    for axis in (force, energy):
        axis.legend(frameon=False, fontsize="small")
    figure.suptitle("Press, slide, let go")


if __name__ == "__main__":
    main()
