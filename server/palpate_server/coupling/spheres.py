"""Rigid spheres on a body: their state, how it is made, saved and put to rest.

Each tool is a sphere on a massless coupling spring, which is between it and the device. Each has *slots*, in which points of the
surface near it are watched.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from palpate.model_file import SurfaceAccuracy, SurfaceModel
from palpate.model_file.contact_size import point_spacing, smallest_radius_m
from palpate_server.bodies import elastic_surface
from palpate_server.bodies.elastic_surface import NOBODY, ElasticSurface
from palpate_server.coupling import contact_solver
from palpate_server.coupling.contact_solver import Rows
from palpate_server.coupling.near_points import TooManyPoints, near_points
from palpate_server.coupling.tracking import Tracking
from palpate_server.realtime.compiled import compiled

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

LIFTED, TOUCHING, GRABBING = range(3)
"""What is wanted of a tool: to touch nothing, to touch, or to touch and hold on to the points that it touches."""

DEFAULT_STIFFNESS_N_PER_M = 700.0
DEFAULT_SWEEPS = 40

_MOST_NEAR = 400  # points near one, of which a sphere that is pressed in by its radius touches about half
_SPARE_SLOTS = 16  # for points in contact that are no longer near the anchor


class Tools(NamedTuple):
    """n tools; arrays (n,) where nothing else is said.

    radius m, friction, compliance m/N (of the coupling spring)
    device, center  (n, 3), m: of the device and of the sphere in the last tick; reaction (n, 3), N: that the sphere feels, times -1
    moved           (n, 3), m: by the device in this tick
    wanted, attached  of the last tick; attached: 1 while points are held
    work, stored, dissipated  J: work of the device, energy in the spring, energy lost in contact and spring
    drift           (n, 3), m: how far the tissue that the tool presses has moved, on average
    """

    radius: Floats
    friction: Floats
    compliance: Floats
    device: Floats
    center: Floats
    reaction: Floats
    moved: Floats
    wanted: Integers
    attached: Integers
    work: Floats
    stored: Floats
    dissipated: Floats
    drift: Floats


class Slots(NamedTuple):
    """Watched points, n_slots / n_tools for each tool.

    force (n_slots, 3), N, on the tissue, of the last tick; bond (n_slots,), N; gap (n_slots,), m
    normal (n_slots, 3), inward; busy (n_slots,): 1 where there is a force or a bond
    tilt   (n_slots, 3): of the sphere against it, its slope outwards from its axis
    """

    force: Floats
    bond: Floats
    gap: Floats
    normal: Floats
    tilt: Floats
    busy: Integers


class SphereContact(NamedTuple):
    """A body and the tools on it. budget (1,), J: dissipated before, for pushing out penetration; tick (1,)."""

    body: ElasticSurface
    tracking: Tracking
    tools: Tools
    slots: Slots
    rows: Rows
    budget: Floats
    tick: Integers

    @property
    def n_tools(self) -> int:
        return len(self.tools.radius)

    def arrays(self) -> list[NDArray[np.float64] | Integers]:
        """All that ticks change, what is shown first."""
        body, tools, slots = self.body, self.tools, self.slots
        return [
            *(getattr(body, name) for name in elastic_surface.STATE),
            *(self.tracking.anchor, self.tracking.complete, self.tracking.position),
            *tools,
            *(slots.force, slots.bond, slots.gap, slots.normal, slots.tilt, slots.busy),
            *(self.budget, self.tick),
        ]

    def state_size(self) -> int:
        return sum(values.size for values in self.arrays())

    def restore(self, state: Floats) -> None:
        """Restore a state that `save` wrote, of a contact with the same model. Raises ValueError for anything else."""
        if state.shape != (self.state_size(),):
            raise ValueError(f"state has shape {state.shape}: expected ({self.state_size()},)")
        if not np.all(np.isfinite(state)):
            raise ValueError("state: expected finite numbers")
        arrays = self.arrays()
        parts = np.split(state, np.cumsum([values.size for values in arrays])[:-1])
        for values, part in zip(arrays, parts, strict=True):
            if values.dtype == np.int64:  # compiled code takes them as indices
                is_point = values is self.body.watched or values is self.tracking.anchor
                last = len(self.tracking.points) if is_point else 2**53
                if np.any((part != np.floor(part)) | (part < NOBODY) | (part >= last)):
                    raise ValueError("state: expected one that `save` wrote with the same model")
        for values, part in zip(arrays, parts, strict=True):
            values[...] = part.reshape(values.shape)

    def shown_size(self) -> int:
        return self.body.q.size + self.body.force.size


def make(
    model: SurfaceModel,
    stiffness_n_per_m: float | Sequence[float] = DEFAULT_STIFFNESS_N_PER_M,
    sweeps: int = DEFAULT_SWEEPS,
) -> SphereContact:
    """The body at rest, with the tools of the model lifted.

    stiffness_n_per_m  of the coupling springs, of all or of each tool
    sweeps             of the solver at most in one tick

    Raises ValueError for a model without points, for a tool that is too large for points so close together, and as
    `elastic_surface.make_body`.
    """
    if model.n_points == 0:
        raise ValueError("points: expected at least one")
    n = len(model.tools)
    spacing = point_spacing(model.points, model.triangles)
    largest = max((tool.radius_m for tool in model.tools), default=0.0)
    # Half around the sphere, and a few points more; where points are sparse those that an edge connects.
    near = _near(model, largest, 1.25 * largest + float(np.median(spacing)))
    contact = _assemble(
        model, near, smallest_radius_m(spacing), n, n * (near.shape[1] + _SPARE_SLOTS), sweeps
    )
    stiffness = np.broadcast_to(np.asarray(stiffness_n_per_m, float), (n,))
    for i, tool in enumerate(model.tools):
        set_tool(contact, i, tool.radius_m, tool.friction, float(stiffness[i]))
        contact.tools.device[i] = contact.tools.center[i] = tool.home_m
    return contact


def empty(n_tools: int) -> SphereContact:
    """A contact without points, which is never advanced."""
    no_points = np.zeros((0, 3))
    model = SurfaceModel(
        name="", period_s=1e-3, n_nodes=0, tools=(), points=no_points, normals=no_points,
        triangles=np.zeros((0, 3), np.int32), held=np.zeros(0, bool), squared_frequencies=np.zeros(0),
        shapes=np.zeros((0, 3, 0), np.float32), residual=np.zeros((0, 0), np.float32), gamma=np.zeros(0),
        tau_s=np.zeros(0), band_hz=(0.0, 0.0), config="", config_sha256="", built_with="",
        accuracy=SurfaceAccuracy.unknown(0),
    )  # fmt: skip
    return _assemble(model, np.zeros((0, 1), np.int64), np.zeros(0), n_tools, 0, 0)


def _near(model: SurfaceModel, radius: float, reach_m: float) -> Integers:
    """As `near_points`, for a sphere. Raises ValueError where it is too large."""
    try:
        return near_points(model.points, model.triangles, reach_m, _MOST_NEAR)
    except TooManyPoints as error:
        fit = radius * math.sqrt(_MOST_NEAR / error.count)
        raise ValueError(
            f"a tool of radius_m = {radius:g} is near {error.count} points of {model.name!r} at once, of which it may touch "
            f"most: expected at most {_MOST_NEAR}, as with a radius of about {fit:.1g} m or a larger spacing of the points"
        ) from error


def _assemble(
    model: SurfaceModel, near: Integers, carried: Floats, n: int, slots: int, sweeps: int
) -> SphereContact:
    """With n tools and so many slots of all of them."""
    return SphereContact(
        body=elastic_surface.make_body(model, slots, n),
        tracking=Tracking(
            points=np.array(model.points, dtype=float, order="C"),
            normals=np.array(model.normals, dtype=float, order="C"),
            near=near,
            carried=carried,
            anchor=np.full(n, NOBODY),
            complete=np.zeros(n, np.int64),
            position=np.zeros((slots, 3)),
            mark=np.zeros(model.n_points, np.int64),
        ),
        tools=_make_tools(n),
        slots=Slots(
            force=np.zeros((slots, 3)),
            bond=np.zeros(slots),
            gap=np.zeros(slots),
            normal=np.zeros((slots, 3)),
            tilt=np.zeros((slots, 3)),
            busy=np.zeros(slots, np.int64),
        ),
        rows=contact_solver.make_rows(slots, n, sweeps),
        budget=np.zeros(1),
        tick=np.zeros(1, np.int64),
    )


def _make_tools(n: int) -> Tools:
    return Tools(
        radius=np.zeros(n),
        friction=np.zeros(n),
        compliance=np.zeros(n),
        device=np.zeros((n, 3)),
        center=np.zeros((n, 3)),
        reaction=np.zeros((n, 3)),
        moved=np.zeros((n, 3)),
        wanted=np.full(n, LIFTED),
        attached=np.zeros(n, np.int64),
        work=np.zeros(n),
        stored=np.zeros(n),
        dissipated=np.zeros(n),
        drift=np.zeros((n, 3)),
    )


def shown(model: SurfaceModel, state: Floats) -> NDArray[np.float32]:
    """(3 n_points,), m: the displacement of all points, from a state that `save_shown` wrote."""
    r = model.n_modes
    frequency = np.sqrt(model.squared_frequencies)
    prewarp = 2 / model.period_s * np.tan(frequency * model.period_s / 2) / frequency
    q, y = (state[:r] * prewarp).astype(np.float32), state[-3 * model.n_points :].astype(np.float32)
    pressed = np.flatnonzero(y)
    return model.shapes.reshape(3 * model.n_points, r) @ q + model.residual[:, pressed] @ y[pressed]


# For compiled code.


@compiled
def slots_of(contact: SphereContact, tool: int) -> tuple[int, int]:
    """The tool's slots: from the first one to before the last one."""
    per_tool = contact.slots.busy.size // contact.tools.radius.size
    return tool * per_tool, (tool + 1) * per_tool


@compiled
def pressing(slots: Slots, slot: int) -> float:
    """Normal force at a watched point, N."""
    force, normal = slots.force[slot], slots.normal[slot]
    return force[0] * normal[0] + force[1] * normal[1] + force[2] * normal[2]


@compiled
def set_tool(
    contact: SphereContact, tool: int, radius_m: float, friction: float, stiffness_n_per_m: float
) -> None:
    """Change a lifted tool between two ticks; its radius is at most that of the model's largest."""
    contact.tools.radius[tool] = radius_m
    contact.tools.friction[tool] = friction
    contact.tools.compliance[tool] = 1.0 / stiffness_n_per_m


@compiled
def put_to_rest(contact: SphereContact) -> None:
    """Put body and tools to rest, nothing in contact; the ledger starts again. Tools stay where they are."""
    elastic_surface.put_to_rest(contact.body)
    for tool in range(contact.tools.radius.size):
        contact.tracking.anchor[tool] = NOBODY
        contact.tracking.complete[tool] = 0
        contact.tools.wanted[tool] = LIFTED
        contact.tools.attached[tool] = 0
        contact.tools.work[tool] = contact.tools.stored[tool] = contact.tools.dissipated[tool] = 0.0
        for c in range(3):
            contact.tools.reaction[tool, c] = contact.tools.drift[tool, c] = 0.0
            contact.tools.center[tool, c] = contact.tools.device[tool, c]
    for slot in range(contact.slots.busy.size):
        contact.slots.bond[slot] = contact.slots.gap[slot] = 0.0
        contact.slots.busy[slot] = 0
        for c in range(3):
            contact.slots.force[slot, c] = contact.slots.normal[slot, c] = contact.slots.tilt[slot, c] = 0.0
    contact.budget[0] = 0.0


@compiled
def save(contact: SphereContact, state: Floats, place: int) -> int:
    """Copy all that ticks change into `state`, from `place` on. Returns the place behind it."""
    body, tools, slots, follow = contact.body, contact.tools, contact.slots, contact.tracking
    place = _copy(body.q, state, place)
    place = _copy(body.v, state, place)
    place = _copy(body.z, state, place)
    place = _copy(body.y, state, place)
    place = _copy(body.gram, state, place)
    place = _copy(body.force, state, place)
    place = _copy(body.modal_force, state, place)
    place = _copy(body.watched, state, place)
    place = _copy(body.images, state, place)
    place = _copy(body.image_of_force, state, place)
    place = _copy(body.energy, state, place)
    place = _copy(body.displacement, state, place)
    place = _copy(body.step, state, place)
    place = _copy(follow.anchor, state, place)
    place = _copy(follow.complete, state, place)
    place = _copy(follow.position, state, place)
    place = _copy(tools.radius, state, place)
    place = _copy(tools.friction, state, place)
    place = _copy(tools.compliance, state, place)
    place = _copy(tools.device, state, place)
    place = _copy(tools.center, state, place)
    place = _copy(tools.reaction, state, place)
    place = _copy(tools.moved, state, place)
    place = _copy(tools.wanted, state, place)
    place = _copy(tools.attached, state, place)
    place = _copy(tools.work, state, place)
    place = _copy(tools.stored, state, place)
    place = _copy(tools.dissipated, state, place)
    place = _copy(tools.drift, state, place)
    place = _copy(slots.force, state, place)
    place = _copy(slots.bond, state, place)
    place = _copy(slots.gap, state, place)
    place = _copy(slots.normal, state, place)
    place = _copy(slots.tilt, state, place)
    place = _copy(slots.busy, state, place)
    place = _copy(contact.budget, state, place)
    return _copy(contact.tick, state, place)


@compiled
def save_shown(contact: SphereContact, state: Floats) -> None:
    """Copy what `shown` needs into `state`, (shown_size,)."""
    place = _copy(contact.body.q, state, 0)
    _copy(contact.body.y[0], state, place)


@compiled
def _copy(values: NDArray[Any], state: Floats, place: int) -> int:
    flat = values.reshape(values.size)
    for i in range(flat.size):
        state[place + i] = flat[i]
    return place + flat.size
