"""The picture of the demonstration. Needs the extra `plots`."""

from __future__ import annotations

import importlib.util
import io
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.signal import butter, sosfiltfilt

from palpate.files import write_atomically
from palpate.lti.stepping import step_through
from palpate.model_file import ReducedModel

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Touch:
    """One recorded poke and the full model's answer to it.

    time_s           (n_ticks,), s
    displacement_m   (n_ticks, n_inputs), applied by the server at each tick
    force_n          (n_ticks, n_outputs), what the device renders, as received over the wire
    force_full_n     (n_ticks, n_outputs), the same with the full model's exact response to this displacement
    """

    time_s: Array
    displacement_m: Array
    force_n: Array
    force_full_n: Array


def in_band(signal: Array, band_hz: tuple[float, float], period_s: float) -> Array:
    """The part of a signal (n_ticks, k) within a band, without delay."""
    low, high = band_hz
    if low == 0:
        filter_ = butter(4, high, "lowpass", fs=1 / period_s, output="sos")
    else:
        filter_ = butter(4, (low, high), "bandpass", fs=1 / period_s, output="sos")
    return np.asarray(sosfiltfilt(filter_, signal, axis=0))


def require_matplotlib() -> None:
    """Raise ValueError with what to install when matplotlib is missing."""
    if importlib.util.find_spec("matplotlib") is None:
        raise ValueError("pictures need matplotlib: pip install 'palpate[plots]'")


def write_picture(figure: Any, path: Path) -> None:
    """Write a matplotlib figure as PNG; the folder must exist. Raises OSError."""
    picture = io.BytesIO()
    figure.savefig(picture, format="png", dpi=110)
    write_atomically(path, picture.getvalue())


def draw_touch(model: ReducedModel, touch: Touch, path: Path) -> None:
    """The body at the deepest poke of its first contact, and tip displacement, force and error over time."""
    from matplotlib.figure import Figure

    inward = -np.asarray(model.contacts[0].normal)
    depth = touch.displacement_m[:, :3] @ inward
    served, full = touch.force_n[:, :3] @ -inward, touch.force_full_n[:, :3] @ -inward
    largest = float(np.max(np.linalg.norm(touch.force_full_n, axis=1)))
    deepest = int(np.argmax(np.abs(depth)))

    figure = Figure(figsize=(13.5, 7.2), layout="constrained")
    halves: Any = figure.subfigures(1, 2, width_ratios=[1.0, 1.15])
    left, right = halves
    _draw_body(left, model, surface_displacement(model, touch.displacement_m[: deepest + 1]))

    axes = right.subplots(3, 1, sharex=True)
    axes[0].plot(touch.time_s, 1e3 * depth, color="tab:green")
    axes[0].set_ylabel("tip displacement, mm\n(into the tissue)")
    axes[0].axvline(touch.time_s[deepest], color="0.6", linewidth=0.8, linestyle=":")
    axes[1].plot(
        touch.time_s, full, color="0.55", linewidth=3.0, label=f"full model, {model.n_states_full:,} states"
    )
    axes[1].plot(
        touch.time_s, served, color="tab:red", linewidth=1.1, label=f"over the wire, order {model.order}"
    )
    axes[1].set_ylabel("force on the device, N\n(positive: pushes it out)")
    axes[1].set_ylim(top=1.35 * float(max(full.max(), served.max())))
    axes[1].legend(loc="upper right", ncols=2, frameon=False, fontsize="small")
    difference = touch.force_n - touch.force_full_n
    for values, style, label in (
        (difference, {"color": "0.75", "linewidth": 0.6}, "every frequency"),
        (
            in_band(difference, model.accuracy.band_hz, model.period_s),
            {"color": "tab:blue"},
            f"below {model.accuracy.band_hz[1]:g} Hz",
        ),
    ):
        error = np.linalg.norm(values, axis=1) / largest
        axes[2].semilogy(touch.time_s, np.maximum(error, 1e-6), label=label, **style)
    stated = model.accuracy.error_in_band
    axes[2].axhline(
        stated, color="tab:orange", linestyle="--", label=f"stated in-band error, {100 * stated:.2g} %"
    )
    axes[2].set_ylim(1e-5, 10)
    axes[2].set_ylabel("force error over\nlargest force")
    axes[2].set_xlabel("time, s")
    axes[2].legend(loc="upper right", ncols=3, frameon=False, fontsize="small")
    for axis in axes:
        axis.grid(alpha=0.25)
        axis.spines[["top", "right"]].set_visible(False)
    right.suptitle("What the client felt through the 1 kHz server")
    write_picture(figure, path)


def surface_displacement(model: ReducedModel, displacement_m: Array) -> Array:
    """(n_vertices, 3), m: the surface after the displacements (n_ticks, n_inputs) have been applied from rest."""
    _, state = step_through(model.discrete, displacement_m[:-1])
    moved = model.surface.output @ state + model.surface.feedthrough @ displacement_m[-1]
    return np.asarray(moved, dtype=float).reshape(-1, 3)


def _draw_body(figure: Any, model: ReducedModel, displacement: Array) -> None:
    """The deformed surface, colored by how far it moved, seen from above the first contact."""
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import LightSource, LogNorm
    from mpl_toolkits.mplot3d.art3d import Poly3DCollection

    patch = model.contacts[0]
    normal = np.asarray(patch.normal)
    elevation = float(np.degrees(np.arcsin(np.clip(normal[2], -1, 1))))
    azimuth = float(np.degrees(np.arctan2(normal[1], normal[0])))
    vertices = 1e3 * (model.surface.vertices + displacement)
    moved = 1e3 * np.linalg.norm(displacement, axis=1)
    top = max(float(moved.max()), 1e-9)
    mapper = ScalarMappable(norm=LogNorm(vmin=0.02 * top, vmax=top, clip=True), cmap="magma")
    colors = mapper.to_rgba(moved[model.surface.triangles].mean(axis=1))

    axis = figure.add_subplot(projection="3d")
    light = LightSource(azdeg=60 - azimuth, altdeg=min(elevation + 20, 90))
    axis.add_collection3d(
        Poly3DCollection(
            vertices[model.surface.triangles],
            facecolors=colors,
            edgecolors=colors,
            linewidths=0.3,
            shade=True,
            lightsource=light,
        )
    )
    tip = 1e3 * np.asarray(patch.center_m)
    shaft = np.stack([tip, tip + 45 * normal])
    axis.plot(*shaft.T, color="tab:cyan", linewidth=3, zorder=10)
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    axis.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]))
    axis.set_box_aspect(high - low, zoom=1.3)
    axis.view_init(elev=float(np.clip(elevation - 25, -60, 60)), azim=azimuth + 35)
    axis.set_axis_off()
    size = " x ".join(f"{extent:.0f}" for extent in high - low)
    axis.set_title(f"{model.name}, {size} mm, at the deepest point of the poke\ntool at '{patch.name}'")
    bar = figure.colorbar(mapper, ax=axis, shrink=0.6, pad=0.02, label="displacement, mm", extend="min")
    ticks = [t for t in (0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 50) if 0.02 * top <= t <= top]
    bar.set_ticks(ticks, labels=[f"{t:g}" for t in ticks])
    bar.minorticks_off()
