"""All that differs between the kinds of model: functions that are chosen by the model's type."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from palpate.model_file import ReducedModel
from palpate_server.coupling import fixed_patch
from palpate_server.coupling.running import Running

Floats = NDArray[np.float64]
Vector = tuple[float, float, float]
Model = ReducedModel


@dataclass(frozen=True)
class ToolOfModel:
    """A tool of a model, in its frame.

    start_m: where its tip touches the undeformed tissue without pressing
    normal: outward there, of length 1
    """

    name: str
    start_m: Vector
    normal: Vector
    radius_m: float


def tools_of(model: Model) -> tuple[ToolOfModel, ...]:
    return tuple(ToolOfModel(c.name, c.center_m, c.normal, c.radius_m) for c in model.contacts)


def make_running(model: Model) -> Running:
    """The model at rest."""
    return _patches(model, None)


def make_settled(model: Model, displacement: Floats) -> Running:
    """The model settled where its tips are at `displacement` (n_tools, 3), m, from their starts."""
    return _patches(model, displacement)


def _patches(model: ReducedModel, displacement: Floats | None) -> Running:
    normals = np.array([contact.normal for contact in model.contacts])
    n_nodes = np.array([contact.n_nodes for contact in model.contacts])
    return Running(fixed_patch.make(model.discrete, normals, n_nodes, displacement))


def surface_at_rest(model: Model) -> tuple[Floats, NDArray[np.int32]]:
    """The vertices (n_vertices, 3), m, and the triangles (n, 3) of the surface that is shown."""
    return model.surface.vertices, model.surface.triangles


def shown_displacement(model: Model, state: Floats, displacement: Floats) -> NDArray[np.float32]:
    """(3 n_vertices,), m: of the surface that is shown, from what `running.save_shown` wrote and the tips' displacement."""
    surface = model.surface
    shown = surface.output @ state.astype(np.float32)
    shown += surface.feedthrough @ displacement.ravel().astype(np.float32)
    return shown
