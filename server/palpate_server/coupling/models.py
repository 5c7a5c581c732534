"""All that differs between the kinds of model: functions that are chosen by the model's type."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from palpate.model_file import ReducedModel, SurfaceModel
from palpate_server.coupling import fixed_patch, running, settle, spheres
from palpate_server.coupling.running import Running, Tip
from palpate_server.coupling.settle import Touch
from palpate_server.coupling.spheres import DEFAULT_STIFFNESS_N_PER_M

Floats = NDArray[np.float64]
Vector = tuple[float, float, float]
Model = ReducedModel | SurfaceModel

_CLOSE_M = 1e-3  # a tip that is farther outside does not touch


@dataclass(frozen=True)
class ToolOfModel:
    """A tool of a model, in its frame.

    start_m: where its tip touches the undeformed tissue without pressing: a patch's center, or the center of a sphere
    normal: outward there, of length 1
    friction: of a sphere; None for a patch
    """

    name: str
    start_m: Vector
    normal: Vector
    radius_m: float
    friction: float | None


def tools_of(model: Model) -> tuple[ToolOfModel, ...]:
    if isinstance(model, ReducedModel):
        return tuple(ToolOfModel(c.name, c.center_m, c.normal, c.radius_m, None) for c in model.contacts)
    return tuple(
        ToolOfModel(
            tool.name, start_of(model, i, tool.radius_m), _way_in(model, i)[1], tool.radius_m, tool.friction
        )
        for i, tool in enumerate(model.tools)
    )


def start_of(model: SurfaceModel, tool: int, radius_m: float) -> Vector:
    """Where the center of a sphere is that comes from the tool's home towards the nearest point, and just touches the surface."""
    nearest, outward, height = _way_in(model, tool)
    away = model.points - nearest
    along = away @ np.array(outward)
    beside = np.sum(away**2, axis=1) - along**2
    in_the_way = (beside < radius_m**2) & (along <= height)
    reach = np.max(along[in_the_way] + np.sqrt(radius_m**2 - beside[in_the_way]))
    x, y, z = (nearest + reach * np.array(outward)).tolist()
    return x, y, z


def _way_in(model: SurfaceModel, tool: int) -> tuple[Floats, Vector, float]:
    """The point nearest to a tool's home, (3,), m, the direction from there to the home, and its distance, m."""
    home = np.array(model.tools[tool].home_m)
    away = home - model.points
    distance = np.linalg.norm(away, axis=1)
    nearest = int(np.argmin(distance))
    x, y, z = (
        away[nearest] / distance[nearest] if distance[nearest] > 0 else model.normals[nearest]
    ).tolist()
    return model.points[nearest], (x, y, z), float(distance[nearest])


def largest_radius(model: SurfaceModel) -> float:
    """m, of a sphere that the model can be touched with."""
    return max(tool.radius_m for tool in model.tools)


def off_the_patches(model: Model, displacement: Floats) -> list[str]:
    """The tools that are not on their patches at this displacement (n_tools, 3), m; none for a surface model.

    A patch follows its tip in every direction: it can't stand for tissue beside it, or for a tip in the air.
    """
    if isinstance(model, SurfaceModel):
        return []
    away = []
    for contact, moved in zip(model.contacts, displacement, strict=True):
        height = float(moved @ contact.normal)
        beside = float(np.linalg.norm(moved - height * np.array(contact.normal)))
        if beside > contact.radius_m or height > _CLOSE_M:
            away.append(contact.name)
    return away


def tips_of_file(model: Model) -> tuple[Tip, ...]:
    """The tips of the tools of a surface model as its file has them; none for a patch model."""
    return tuple(
        Tip(tool.radius_m, tool.friction, DEFAULT_STIFFNESS_N_PER_M, tool.start_m)
        for tool in tools_of(model)
        if tool.friction is not None
    )


def make_running(model: Model, tips: Sequence[Tip] | None = None) -> Running:
    """The model at rest; tips: of each tool of a surface model, by default as its file has them."""
    if isinstance(model, ReducedModel):
        return _patches(model, None)
    if tips is None:
        tips = tips_of_file(model)
    contact = spheres.make(model, [tip.stiffness_n_per_m for tip in tips])
    contact.tools.radius[:] = [tip.radius_m for tip in tips]
    contact.tools.friction[:] = [tip.friction for tip in tips]
    return running.of_contact(contact, np.array([tip.start_m for tip in tips]))


def make_settled(model: Model, tips: Sequence[Tip], displacement: Floats, touch: Touch) -> Running:
    """The model settled where its tools are at `displacement` (n_tools, 3), m, from their starts, and touch it like that."""
    if isinstance(model, ReducedModel):
        return _patches(model, displacement)
    settled = make_running(model, tips)
    settle.press(settled, displacement, touch, [tip.radius_m for tip in tips])
    return settled


def _patches(model: ReducedModel, displacement: Floats | None) -> Running:
    normals = np.array([contact.normal for contact in model.contacts])
    n_nodes = np.array([contact.n_nodes for contact in model.contacts])
    return running.of_patch(fixed_patch.make(model.discrete, normals, n_nodes, displacement))


def surface_at_rest(model: Model) -> tuple[Floats, NDArray[np.int32]]:
    """The vertices (n_vertices, 3), m, and the triangles (n, 3) of the surface that is shown."""
    if isinstance(model, ReducedModel):
        return model.surface.vertices, model.surface.triangles
    return model.points, model.triangles


def shown_displacement(model: Model, state: Floats, displacement: Floats) -> NDArray[np.float32]:
    """(3 n_vertices,), m: of the surface that is shown, from what `running.save_shown` wrote and the tips' displacement."""
    if isinstance(model, SurfaceModel):
        return spheres.shown(model, state)
    surface = model.surface
    shown = surface.output @ state.astype(np.float32)
    shown += surface.feedthrough @ displacement.ravel().astype(np.float32)
    return shown
