"""Pictures of a tool that touches a surface model. Needs the extra `plots`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.model_file import SurfaceModel
from palpate.plots import in_band, write_picture

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Felt:
    """What one tool felt at each tick, and where the energy is.

    time_s (n_ticks,); position_m, force_n, normal (n_ticks, 3): center of the tool, force on it, normal of the contact, which is
    zero without one
    n_points    (n_ticks,), points in contact
    work_j      (n_ticks,), by the tool
    stored_j, dissipated_j  (n_ticks,), in body, coupling spring and contact
    """

    time_s: Array
    position_m: Array
    force_n: Array
    normal: Array
    n_points: NDArray[np.int_]
    work_j: Array
    stored_j: Array
    dissipated_j: Array

    @property
    def normal_n(self) -> Array:
        """(n_ticks,): force along the contact's normal; positive pushes the tool out."""
        return np.asarray(np.einsum("ti,ti->t", self.force_n, self.normal))

    @property
    def friction_n(self) -> Array:
        """(n_ticks,): force across the normal."""
        return np.asarray(np.linalg.norm(self.force_n - self.normal_n[:, None] * self.normal, axis=1))


def draw_slide(model: SurfaceModel, felt: Felt, full: Felt, displacement_m: Array, path: Path) -> None:
    """The body with displacements (n_points, 3) and the tool's path; forces, energies and error over time.

    full  the same with the full model
    """
    from matplotlib.colors import LogNorm
    from matplotlib.figure import Figure

    figure = Figure(figsize=(13.5, 7.2), layout="constrained")
    halves: Any = figure.subfigures(1, 2, width_ratios=[1.0, 1.15])
    left, right = halves
    moved = 1e3 * np.linalg.norm(displacement_m, axis=1)
    top = max(float(moved.max()), 1e-9)
    axis, mapper = draw_body(
        left,
        model,
        model.points + displacement_m,
        moved,
        LogNorm(vmin=0.02 * top, vmax=top, clip=True),
        felt.position_m,
    )
    axis.set_title(
        f"{model.name}: {model.n_points:,} points to touch, {model.n_modes} modes\nhalfway along the slide"
    )
    bar = left.colorbar(mapper, ax=axis, shrink=0.6, pad=0.02, label="displacement, mm", extend="min")
    ticks = [t for t in (0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1, 2, 5, 10, 20) if 0.02 * top <= t <= top]
    bar.set_ticks(ticks, labels=[f"{t:g}" for t in ticks])
    bar.minorticks_off()

    force, energy, error = right.subplots(3, 1, sharex=True)
    force.plot(full.time_s, full.normal_n, color="0.75", linewidth=3.5, label="full model")
    force.plot(full.time_s, full.friction_n, color="0.75", linewidth=3.5)
    draw_forces(force, felt)
    draw_energies(energy, felt)
    difference = felt.force_n - full.force_n
    largest = float(np.linalg.norm(full.force_n, axis=1).max())
    for values, style, label in (
        (difference, {"color": "0.75", "linewidth": 0.6}, "every frequency"),
        (in_band(difference, model.band_hz, model.period_s), {"color": "tab:blue"}, f"below {model.band_hz[1]:g} Hz"),
    ):  # fmt: skip
        relative = np.linalg.norm(values, axis=1) / largest
        error.semilogy(felt.time_s, np.maximum(relative, 1e-6), label=label, **style)
    stated = model.accuracy.error_in_working_area
    error.axhline(
        stated, color="tab:orange", linestyle="--", label=f"stated in-band error, {100 * stated:.2g} %"
    )
    error.set_ylim(1e-5, 10)
    error.set_ylabel("force error over\nlargest force")
    error.set_xlabel("time, s")
    error.legend(loc="upper right", ncols=3, frameon=False, fontsize="small")
    for axis in (force, energy, error):
        axis.grid(alpha=0.25)
        axis.spines[["top", "right"]].set_visible(False)
    right.suptitle("Press, slide, let go: what the client felt through the 1 kHz server")
    write_picture(figure, path)


def draw_forces(axis: Any, felt: Felt) -> None:
    """Normal force and friction over time."""
    axis.plot(felt.time_s, felt.normal_n, color="tab:red", linewidth=1.1, label="along the contact's normal")
    axis.plot(felt.time_s, felt.friction_n, color="tab:blue", linewidth=1.1, label="across: friction")
    axis.set_ylabel("force on the tool, N\n(positive: pushes it out)")
    axis.set_ylim(top=1.35 * float(felt.normal_n.max()))
    axis.legend(loc="upper right", ncols=3, frameon=False, fontsize="small")


def draw_energies(axis: Any, felt: Felt) -> None:
    """The ledger over time."""
    for values, label, color in (
        (felt.work_j, "work of the tool", "tab:red"),
        (felt.stored_j, "stored", "tab:blue"),
        (felt.dissipated_j, "dissipated", "0.5"),
    ):
        axis.plot(felt.time_s, 1e3 * values, label=label, color=color)
    total = 1e3 * (felt.stored_j + felt.dissipated_j)
    axis.plot(felt.time_s, total, "k:", linewidth=1.0, label="stored and dissipated")
    axis.set_ylabel("energy, mJ")
    axis.legend(frameon=False, fontsize="small")


def draw_body(
    figure: Any, model: SurfaceModel, points_m: Array, values: NDArray[Any], norm: Any, path_m: Array
) -> tuple[Any, Any]:
    """The surface with its points at (n_points, 3), colored by values (n_points,), seen from above a path (n, 3) of the tool.

    Returns the axis and the mapper of its colors.
    """
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import LightSource
    from mpl_toolkits.mplot3d.art3d import Poly3DCollection

    mapper = ScalarMappable(norm=norm, cmap="viridis")
    colors = mapper.to_rgba(values[model.triangles].mean(axis=1))
    axis = figure.add_subplot(projection="3d")
    nearest = np.argmin(np.linalg.norm(model.points - path_m[0], axis=1))
    x, y, z = model.normals[nearest]
    azimuth = float(np.degrees(np.arctan2(y, x)))
    elevation = float(np.degrees(np.arcsin(np.clip(z, -1, 1))))
    points = 1e3 * points_m
    axis.add_collection3d(
        Poly3DCollection(
            points[model.triangles],
            facecolors=colors,
            edgecolors=colors,
            linewidths=0.2,
            shade=True,
            lightsource=LightSource(azdeg=60 - azimuth, altdeg=min(elevation + 40, 90)),
        )
    )
    axis.plot(*(1e3 * path_m).T, color="tab:red", linewidth=2.5, zorder=10, label="path of the tool's center")
    low, high = points.min(axis=0), points.max(axis=0)
    axis.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]))
    axis.set_box_aspect(high - low, zoom=1.2)
    axis.view_init(elev=float(np.clip(elevation - 25, -60, 60)), azim=azimuth + 35)
    axis.set_axis_off()
    axis.legend(loc="upper left", frameon=False)
    return axis, mapper
