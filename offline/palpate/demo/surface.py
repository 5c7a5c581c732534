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
from palpate_client import Connection, Surface, Tool, steps
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
_NUMBERS = ("force_scale", "n_contact_points", "work_j", "stored_j", "dissipated_j")
_VECTORS = ("position_m", "force_n", "normal")
_OF_TISSUE = ("tissue_stored_j", "tissue_dissipated_j")
_BALANCED_J = 1e-9


@dataclass(frozen=True)
class Slide:
    """Results of a slide.

    client         summary of the contract, as `palpate client --json` prints it
    felt           what the server sent
    full           the same motion with the full model
    displacement   (n_points, 3), m, of the surface about halfway along the slide, as the server sent it
    lost           ticks whose force message did not come: interpolated
    error          largest force error over the largest force
    error_in_band  the same within the model's band
    """

    model: SurfaceModel
    client: dict[str, Any]
    felt: Felt
    full: Felt
    displacement_m: Array
    lost: int
    error: float
    error_in_band: float

    def lines(self) -> list[str]:
        """Forces, energies and error, for a person."""
        lost = [
            f"lost          {self.lost:,} of {len(self.felt.time_s):,} ticks did not come and are interpolated"
        ]
        return [
            *lost[: self.lost],
            f"contact       {self._contact()}",
            f"energy        {self._energy()}",
            f"full model    served and full model's force differ by at most {100 * self.error_in_band:.2g} % of the largest force "
            f"below {self.model.band_hz[1]:g} Hz (the file states {100 * self.model.accuracy.error_in_working_area:.2g} %), by "
            f"{100 * self.error:.2g} % at every frequency",
        ]

    def _contact(self) -> str:
        felt, contact = self.felt, self.felt.n_points > 0
        if not np.any(contact):
            return "none"
        least = float(felt.normal_n[contact].min())
        pull = "never a pull" if least >= 0 else f"a pull (ticks: {np.count_nonzero(felt.normal_n < 0):,})"
        return (
            f"{felt.n_points.max()} points at most; force along its normal {least:+.3f} to {felt.normal_n.max():+.3f} N, {pull}; "
            f"friction up to {felt.friction_n.max():.3f} N"
        )

    def _energy(self) -> str:
        """At the last tick with an energy: the server counts anew when the tissue has come to rest."""
        felt = self.felt
        last = int(np.flatnonzero(felt.work_j)[-1]) if np.any(felt.work_j) else -1
        work, stored, dissipated = (x[last] for x in (felt.work_j, felt.stored_j, felt.dissipated_j))
        balance = "=" if abs(work - stored - dissipated) <= _BALANCED_J else "is not"
        return f"{1e3 * work:.3f} mJ of work by the tool {balance} {1e3 * stored:.3f} stored + {1e3 * dissipated:.3f} dissipated"

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

    Raises ClientError when server or client fail, ValueError when hardly anything was received.
    """
    progress(f"press, slide, let go, {seconds:g} s")
    tool = model.tools[0]
    sent = _moved(model, endpoint, surface_path(model, seconds), progress)
    felt, scale = _felt(sent, model.period_s)

    progress("full model")
    near = np.flatnonzero(cKDTree(felt.position_m).query(model.points)[0] < _NEAR * tool.radius_m)
    full_model = reference(near)
    # The server lifts a tool whose commands stay away, until they come again.
    full = replayed(full_model, felt.position_m, sent.stiffness_n_per_m, scale > 0)
    full = replace(full, force_n=scale[:, None] * full.force_n)
    progress.note(f"{len(near)} points, {full_model.n_modes:,} modes and Ritz modes")
    difference = felt.force_n - full.force_n
    largest = float(np.linalg.norm(full.force_n, axis=1).max())
    error, within_band = (
        float(np.linalg.norm(d, axis=1).max() / largest)
        for d in (difference, in_band(difference, model.band_hz, model.period_s))
    )
    lost = len(felt.time_s) - len(sent.forces)
    return Slide(model, sent.client, felt, full, sent.displacement_m(), lost, error, within_band)


@dataclass(frozen=True)
class _Sent:
    """What the server sent during a motion.

    forces             `row_of` each tick that came, in their order
    surfaces           about thirty a second
    stiffness_n_per_m  of the tool's spring
    client             summary of the contract
    """

    forces: list[tuple[float, ...]]
    surfaces: list[Surface]
    stiffness_n_per_m: float
    client: dict[str, Any]

    def displacement_m(self) -> Array:
        """(n_points, 3), of the surface nearest to halfway."""
        halfway = (self.forces[0][0] + self.forces[-1][0]) / 2
        nearest = min(self.surfaces, key=lambda surface: abs(surface.tick - halfway))
        return np.array(nearest.displacement_m, np.float64).reshape(-1, 3)


def _moved(model: SurfaceModel, endpoint: str, path: Array, progress: Progress) -> _Sent:
    """Have the server move the first tool along a path (n_ticks, 3), m. Errors as `slide`."""
    name, velocity = model.tools[0].name, np.asarray(np.gradient(path, model.period_s, axis=0))
    forces: list[tuple[float, ...]] = []
    surfaces: list[Surface] = []
    # A full collection looks at all objects of the build, for tenths of a second, in which no command is sent.
    gc.collect()
    gc.freeze()
    try:
        with Connection(endpoint, name="demo") as connection, Tool(connection, name) as moved:
            index = connection.description.index(name)
            connection.on_force(lambda message, arrival_ns: forces.append(row_of(message, index)))
            connection.on_surface(surfaces.append)
            for i in steps(len(path) * model.period_s, model.period_s):
                moved.move(path[i].tolist(), velocity[i].tolist())
            status = connection.next_status(_STATUS_WAIT_S)
    finally:
        gc.unfreeze()
    client = moved.contract.summary()
    progress.note(f"{client['commands_answered']:,} of {client['commands_sent']:,} commands answered")
    if len(forces) < 2 or not surfaces or status is None:
        raise ValueError(
            f"{len(forces)} ticks and {len(surfaces)} surfaces received, expected at least 2, 1 and a status"
        )
    return _Sent(forces, surfaces, status["tools"][name]["stiffness_n_per_m"], client)


def row_of(message: dict[str, Any], tool: int) -> tuple[float, ...]:
    """What is drawn of a force message, of a tool by its index: the tick, _NUMBERS, _VECTORS and _OF_TISSUE.

    Numbers alone: Python's garbage collector looks at every list of a message that is kept, and no command is sent meanwhile.
    """
    vectors = (value for name in _VECTORS for value in message[name][tool])
    return (
        message["tick"],
        *(message[name][tool] for name in _NUMBERS),
        *vectors,
        *(message[name] for name in _OF_TISSUE),
    )


def _felt(sent: _Sent, period_s: float) -> tuple[Felt, Array]:
    """What came over the wire, at every tick, and the scale of the force (n_ticks,). Lost ticks are interpolated."""
    received, *columns = np.array(sent.forces, np.float64).T
    ticks = np.arange(received[0], received[-1] + 1)
    at_every_tick = np.stack([np.interp(ticks, received, column) for column in columns], axis=1)
    scale, n_points, work, spring, lost = at_every_tick[:, :5].T
    position, force, normal = at_every_tick[:, 5:14].reshape(-1, 3, 3).transpose(1, 0, 2)
    stored, dissipated = at_every_tick[:, 14:].T
    felt = Felt(
        time_s=(ticks - ticks[0]) * period_s,
        position_m=position,
        force_n=force,
        normal=normal,
        n_points=n_points.astype(int),
        work_j=work,
        stored_j=stored + spring,
        dissipated_j=dissipated + lost,
    )
    return felt, scale


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
) -> Felt:
    """What the first tool feels in process, at positions (n_ticks, 3), one a tick.

    touching  (n_ticks,): whether the tool may touch; always if left out
    """
    simulation, name = Simulation(model, stiffness_n_per_m), model.tools[0].name
    rows, work, spring, lost = [], 0.0, 0.0, 0.0
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
    columns = np.array(rows).T
    return Felt(
        time_s=np.arange(len(position_m), dtype=np.float64) * model.period_s,
        position_m=position_m,
        force_n=columns[:3].T.copy(),
        normal=columns[3:6].T.copy(),
        n_points=columns[6].astype(int),
        work_j=columns[7],
        stored_j=columns[8],
        dissipated_j=columns[9],
    )
