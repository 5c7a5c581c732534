"""The demonstration of a surface model: a tool presses, slides and lets go, beside the same with the full model."""

from __future__ import annotations

import gc
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from palpate.model_file import SurfaceModel
from palpate.plots import in_band
from palpate.progress import Progress
from palpate.surface_plots import Felt, draw_slide
from palpate_client import Connection, Tool, steps
from palpate_server.simulation import Simulation

Array = NDArray[np.float64]
Points = NDArray[np.intp]

CLEAR, DEPTH, LENGTH = 0.4, 0.6, 5.0
"""Of the path, in radii of the tool: height before and after, depth of the slide, its length."""

_MOMENTS = (0.0, 0.1, 0.2, 0.7, 0.8, 1.0)
"""Ends of: waiting, pressing, sliding, lifting, waiting; of the whole time."""

_NEAR = 2.4
"""Radii from the tool's center within which points may be touched."""

_STATUS_WAIT_S = 1.0
_FIELDS = ("position_m", "force_n", "force_scale", "normal")


@dataclass(frozen=True)
class Slide:
    """Results of a slide.

    client         summary of the contract, as `palpate client --json` prints it
    felt           what came over the wire, and where the energy was
    full           the same motion with the full model
    displacement   (n_points, 3), m, of the surface halfway along the slide
    error          largest force error over the largest force
    error_in_band  the same within the model's band
    """

    model: SurfaceModel
    client: dict[str, Any]
    felt: Felt
    full: Felt
    displacement_m: Array
    error: float
    error_in_band: float

    def lines(self) -> list[str]:
        """Forces, energies and error, for a person."""
        felt, contact = self.felt, self.felt.n_points > 0
        return [
            f"contact       {felt.n_points.max()} points at most; force along its normal {felt.normal_n[contact].min():+.3f} to "
            f"{felt.normal_n.max():+.3f} N, never a pull; friction up to {felt.friction_n.max():.3f} N",
            f"energy        {1e3 * felt.work_j[-1]:.3f} mJ of work by the tool = {1e3 * felt.stored_j[-1]:.3f} stored "
            f"+ {1e3 * felt.dissipated_j[-1]:.3f} dissipated",
            f"full model    served and full model's force differ by at most {100 * self.error_in_band:.2g} % of the largest force "
            f"below {self.model.band_hz[1]:g} Hz (the file states {100 * self.model.accuracy.error_in_working_area:.2g} %), by "
            f"{100 * self.error:.2g} % at every frequency",
        ]

    def draw(self, picture: Path) -> None:
        draw_slide(self.model, self.felt, self.full, self.displacement_m, picture)


def slide(
    model: SurfaceModel,
    endpoint: str,
    seconds: float,
    reference: Callable[[Points], SurfaceModel],
    progress: Progress,
) -> Slide:
    """Move the first tool of the model that is served at an endpoint over the surface.

    reference  makes the full model of some points

    Raises ClientError when server or client fail, ValueError when hardly any tick was received.
    """
    progress(f"press, slide, let go, {seconds:g} s")
    tool = model.tools[0]
    path = surface_path(model, seconds)
    velocity: Array = np.asarray(np.gradient(path, model.period_s, axis=0))
    messages: list[dict[str, Any]] = []
    # A full collection looks at all objects of the build, for tenths of a second, in which no command is sent.
    gc.collect()
    gc.freeze()
    try:
        with Connection(endpoint, name="demo") as connection, Tool(connection, tool.name) as moved:
            index = connection.description.index(tool.name)
            connection.on_force(lambda message, arrival_ns: messages.append(message))
            for i in steps(seconds, model.period_s):
                moved.move(path[i].tolist(), velocity[i].tolist())
            status = connection.next_status(_STATUS_WAIT_S)
    finally:
        gc.unfreeze()
    client = moved.contract.summary()
    progress.note(f"{client['commands_answered']:,} of {client['commands_sent']:,} commands answered")
    if len(messages) < 2 or status is None:
        raise ValueError(f"{len(messages)} ticks received, expected at least 2 and a status")

    progress("full model")
    over_wire = {name: np.array([message[name][index] for message in messages]) for name in _FIELDS}
    received = np.array([message["tick"] for message in messages])
    received -= received[0]
    # Force messages may be lost: the position of such a tick is interpolated.
    ticks = np.arange(received[-1] + 1)
    position = np.stack([np.interp(ticks, received, x) for x in over_wire["position_m"].T], axis=1)
    scale = np.interp(ticks, received, over_wire["force_scale"])
    near = np.flatnonzero(cKDTree(position).query(model.points)[0] < _NEAR * tool.radius_m)
    full_model = reference(near)
    stiffness = status["tools"][tool.name]["stiffness_n_per_m"]
    # The server lifts a tool whose commands stay away, until they come again.
    felt, displacement = replayed(model, position, stiffness, scale > 0)
    full, _ = replayed(full_model, position, stiffness, scale > 0)
    full = replace(full, force_n=scale[:, None] * full.force_n)
    for name in ("force_n", "normal"):
        getattr(felt, name)[received] = over_wire[name]
    progress.note(f"{len(near)} points, {full_model.n_modes:,} modes and Ritz modes")
    difference = felt.force_n - full.force_n
    largest = float(np.linalg.norm(full.force_n, axis=1).max())
    error, within_band = (
        float(np.linalg.norm(d, axis=1).max() / largest)
        for d in (difference, in_band(difference, model.band_hz, model.period_s))
    )
    return Slide(model, client, felt, full, displacement, error, within_band)


def surface_path(model: SurfaceModel, seconds: float) -> Array:
    """(n_ticks, 3), m: centers of the first tool, that begins above the point nearest to its home, presses, slides and lets go.

    The depth is kept over a polynomial of third order that is fitted to the surface around the path.
    """
    tool = model.tools[0]
    start = int(np.argmin(np.linalg.norm(model.points - tool.home_m, axis=1)))
    outward = model.normals[start]
    along = np.cross(outward, [0.0, 1.0, 0.0] if abs(outward[1]) < 0.9 else [0.0, 0.0, 1.0])
    frame = np.stack([along / np.linalg.norm(along), np.zeros(3), outward])
    frame[1] = np.cross(outward, frame[0])
    local = (model.points - model.points[start]) @ frame.T
    length = LENGTH * tool.radius_m
    fitted = (np.linalg.norm(local, axis=1) < length) & (model.normals @ outward > 0.5)
    x, y, height = local[fitted].T
    terms = [(i, j) for i in range(4) for j in range(4 - i)]
    weights = np.linalg.lstsq(np.stack([x**i * y**j for i, j in terms], axis=1), height)[0]

    time = np.linspace(0, 1, round(seconds / model.period_s), endpoint=False)
    above = tool.radius_m * np.interp(time, _MOMENTS, [CLEAR, CLEAR, -DEPTH, -DEPTH, CLEAR, CLEAR])
    x = length * np.interp(time, _MOMENTS, [0, 0, 0, 1, 1, 1])
    height = sum(w * x**i for w, (i, j) in zip(weights, terms, strict=True) if j == 0)
    slope_x = sum(w * i * x ** (i - 1) for w, (i, j) in zip(weights, terms, strict=True) if j == 0 and i)
    slope_y = sum(w * x**i for w, (i, j) in zip(weights, terms, strict=True) if j == 1)
    normal = np.stack([-slope_x, -slope_y, np.ones_like(x)], axis=1)
    normal /= np.linalg.norm(normal, axis=1)[:, None]
    center = np.stack([x, np.zeros_like(x), height], axis=1) + (tool.radius_m + above)[:, None] * normal
    return model.points[start] + center @ frame


def replayed(
    model: SurfaceModel,
    position_m: Array,
    stiffness_n_per_m: float,
    touching: NDArray[np.bool_] | None = None,
) -> tuple[Felt, Array]:
    """What the first tool feels at positions (n_ticks, 3), one a tick, and the displacement, (n_points, 3), halfway.

    touching  (n_ticks,): whether the tool may touch; always if left out
    """
    simulation, name = Simulation(model, stiffness_n_per_m), model.tools[0].name
    rows, displacement, work, spring, lost = [], np.zeros_like(model.points), 0.0, 0.0, 0.0
    for i, position in enumerate(position_m):
        force, normal, n_points = np.zeros(3), np.zeros(3), 0
        if touching is None or touching[i]:
            one = simulation.step({name: position})[name]
            force, normal, n_points = one.force_n, one.normal, one.n_points
            work, spring, lost = one.work_j, one.stored_j, one.dissipated_j
        else:
            simulation.step({})
        stored, dissipated = simulation.energy()
        rows.append((*force, *normal, n_points, work, stored + spring, dissipated + lost))
        if i == len(position_m) // 2:
            displacement = simulation.positions() - model.points
    columns = np.array(rows).T
    felt = Felt(
        time_s=np.arange(len(position_m), dtype=np.float64) * model.period_s,
        position_m=position_m,
        force_n=columns[:3].T.copy(),
        normal=columns[3:6].T.copy(),
        n_points=columns[6].astype(int),
        work_j=columns[7],
        stored_j=columns[8],
        dissipated_j=columns[9],
    )
    return felt, displacement
