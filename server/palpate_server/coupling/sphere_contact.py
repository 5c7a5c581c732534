"""Rigid spheres in contact with the surface of a body: fixed material points against moving spheres.

Contact is that of linear theory (Hertz 1882; Sneddon 1965): gaps are measured, and the tissue is pressed, along its normals at
rest. The sphere feels the gradient of the gap, so a side force as well where it slopes.

Each tool is a sphere on a massless coupling spring, which is between it and the device. Each tick finds the points near each
sphere (`tracking`), solves all contacts of all tools as one system (`contact_solver`) and advances the body.

Passivity. The same rows, normals and tilts map force and displacement, so the work of the contacts is exact. Contacts may
only lose energy: where an iterate that has not converged would give some out, all forces are scaled back, to a share a of
themselves, with which the loss a p - a² w is not negative. Old penetration is pushed out with energy that contacts lost before,
and never more. So the work of the tools is what is stored in body and springs plus what is lost, at each tick.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from palpate.model_file import SurfaceAccuracy, SurfaceModel
from palpate_client.wire import Flags
from palpate_server.bodies import elastic_surface
from palpate_server.bodies.elastic_surface import FREE_WORK, NOBODY, SELF_WORK, STORED, WORK, ElasticSurface
from palpate_server.coupling import contact_solver, tracking
from palpate_server.coupling.contact_solver import Rows
from palpate_server.coupling.near_points import TooManyPoints, near_points
from palpate_server.coupling.tracking import Tracking
from palpate_server.realtime.compiled import compiled

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Records = NDArray[np.void]
Record = Any  # one element of a structured array

LIFTED, TOUCHING, GRABBING = range(3)
"""What is wanted of a tool: to touch nothing, to touch, or to touch and hold on to the points that it touches."""

DEFAULT_STIFFNESS_N_PER_M = 700.0
DEFAULT_SWEEPS = 40

_MOST_NEAR = 400  # points near one, of which a sphere that is pressed in by its radius touches about half
_SPARE_SLOTS = 16  # for points in contact that are no longer near the anchor
_MARGIN = 0.05  # of the radius: points with a smaller gap are rows of the system
_NEAR_GAP = 0.4  # of the radius: points with a larger gap are looked at only
_EVERY = 8  # ticks
_SINE, _COSINE, _TANGENT = (
    math.sqrt(0.75),
    0.5,
    math.sqrt(3.0),
)  # of 60 degrees, where a sphere's side becomes a cone
_GRIP = 1e12  # N
_RELEASE_S = 0.02  # time constant of a bond after release
_LEAST_BOND_N = 1e-3
_BLEED_S = 0.05  # time constant with which old penetration is pushed out
_LARGEST_BLEED_M_PER_S = 0.02
_LARGEST_BUDGET_J = 1e-3
_SLIDING_M = 1e-8  # slip of a tick below which a point at the friction limit is not called sliding

_IN_CONTACT, _SLIDING, _ATTACHED = int(Flags.IN_CONTACT), int(Flags.SLIDING), int(Flags.ATTACHED)


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
    """A body and the tools on it. budget (1,), J: lost in contacts, for pushing out penetration; tick (1,)."""

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
        """Restore a state that `save` wrote, of a contact with the same model. Raises ValueError for another size."""
        if state.shape != (self.state_size(),):
            raise ValueError(f"state has shape {state.shape}: expected ({self.state_size()},)")
        place = 0
        for values in self.arrays():
            values[...] = state[place : place + values.size].reshape(values.shape)
            place += values.size

    def shown_size(self) -> int:
        return self.body.q.size + self.body.force.size

    @property
    def largest_radius_m(self) -> float:
        """Of a tool that the table of near points is made for."""
        return float(self.tracking.largest_radius[0])


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
    largest = max((tool.radius_m for tool in model.tools), default=0.0)
    near = _near(model, largest)
    per_tool = near.shape[1] + _SPARE_SLOTS
    contact = _assemble(model, near, n, per_tool, largest, sweeps)
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
    return _assemble(model, np.zeros((0, 1), np.int64), n_tools, 0, 0.0, 0)


def _near(model: SurfaceModel, radius: float) -> Integers:
    """As `near_points`, for a sphere. Raises ValueError where it is too large."""
    try:
        return near_points(model.points, model.triangles, _reach(model, radius), _MOST_NEAR)
    except TooManyPoints as error:
        fit = radius * math.sqrt(_MOST_NEAR / error.count)
        raise ValueError(
            f"a tool of radius_m = {radius:g} is near {error.count} points of {model.name!r} at once, of which it may touch "
            f"most: expected at most {_MOST_NEAR}, as with a radius of about {fit:.1g} m or a larger spacing of the points"
        ) from error


def _reach(model: SurfaceModel, radius: float) -> float:
    """How far along the surface a sphere of this radius touches, m: half around it, and a few points more."""
    edges = model.points[model.triangles[:, [0, 1, 2]]] - model.points[model.triangles[:, [1, 2, 0]]]
    spacing = float(np.median(np.linalg.norm(edges, axis=2))) if len(edges) else 0.0
    return 1.25 * radius + spacing


def _assemble(
    model: SurfaceModel, near: Integers, n: int, per_tool: int, largest: float, sweeps: int
) -> SphereContact:
    slots = n * per_tool
    return SphereContact(
        body=elastic_surface.make_body(model, slots, n),
        tracking=Tracking(
            points=np.array(model.points, dtype=float, order="C"),
            normals=np.array(model.normals, dtype=float, order="C"),
            near=near,
            anchor=np.full(n, NOBODY),
            complete=np.zeros(n, np.int64),
            position=np.zeros((slots, 3)),
            mark=np.zeros(model.n_points, np.int64),
            largest_radius=np.array([largest]),
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
    return model.shapes.reshape(-1, r) @ q + model.residual[:, pressed] @ y[pressed]


# For compiled code.


@compiled
def set_tool(
    contact: SphereContact, tool: int, radius_m: float, friction: float, stiffness_n_per_m: float
) -> None:
    """Change a lifted tool between two ticks; its radius is at most `largest_radius_m`."""
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
def ledger(contact: SphereContact, out: Floats) -> None:
    """Write the body's energies, J, (2,): stored, and dissipated since rest.

    The sum of the tools' work is the sum of these two and of all tools' stored and dissipated energy.
    """
    out[0] = contact.body.energy[STORED]
    out[1] = contact.body.energy[WORK] - contact.body.energy[STORED]


@compiled
def advance(
    contact: SphereContact, center: Floats, wanted: Integers, force: Floats, reactions: Records
) -> None:
    """One tick.

    center     (n, 3), m: of the devices, in the model's frame
    wanted     (n,): LIFTED, TOUCHING or GRABBING
    force      (n, 3), N, written: of the tissue on each tool, which the device feels
    reactions  (n,) REACTION, written
    """
    elastic_surface.predict(contact.body)
    contact.rows.n_rows[0] = 0
    for tool in range(center.shape[0]):
        _move(contact, tool, center[tool], wanted[tool])
        if wanted[tool] != LIFTED:
            _track(contact, tool)
        _find_rows(contact, tool, wanted[tool])
    _fill_matrix(contact)
    contact_solver.solve(contact.rows)
    share = _load(contact)
    elastic_surface.commit(contact.body, share)
    _keep_forces(contact, share)
    for tool in range(center.shape[0]):
        _settle(contact, tool, wanted[tool])
        _report(contact, tool, reactions[tool])
        for c in range(3):
            force[tool, c] = -contact.tools.reaction[tool, c]
    contact.tick[0] += 1


@compiled
def _move(contact: SphereContact, tool: int, device: Floats, wanted: int) -> None:
    """Move the device; the sphere follows as it does under an unchanged force."""
    tools = contact.tools
    starts = tools.wanted[tool] == LIFTED
    for c in range(3):
        tools.moved[tool, c] = 0.0 if starts else device[c] - tools.device[tool, c]
        tools.device[tool, c] = device[c]
        tools.center[tool, c] = (
            device[c] - tools.moved[tool, c] - tools.compliance[tool] * tools.reaction[tool, c]
        )
    tools.wanted[tool] = wanted


@compiled
def _track(contact: SphereContact, tool: int) -> None:
    """Choose the tool's anchor, and watch the points near it."""
    body, follow, center = contact.body, contact.tracking, contact.tools.center[tool]
    per_tool = contact.slots.busy.size // contact.tools.radius.size
    first, last = tool * per_tool, (tool + 1) * per_tool
    in_contact = False
    for slot in range(first, last):
        in_contact = in_contact or contact.slots.busy[slot] != 0
    anchor = follow.anchor[tool]
    if in_contact:
        anchor = tracking.nearest_watched(follow, body, center, first, last)
    else:
        anchor = tracking.nearest_at_rest(follow.points, center[0], center[1], center[2])
    if anchor != follow.anchor[tool] or follow.complete[tool] == 0:
        follow.anchor[tool] = anchor
        tracking.watch_near(follow, body, tool, contact.slots.busy, first, last)


@compiled
def _find_rows(contact: SphereContact, tool: int, wanted: int) -> None:
    """Add the rows of a tool to the system: points with a force, and points that its sphere touches or nearly touches."""
    body, slots, follow = contact.body, contact.slots, contact.tracking
    per_tool = slots.busy.size // contact.tools.radius.size
    radius = contact.tools.radius[tool]
    beneath = wanted != LIFTED and _is_beneath(contact, tool)
    contact.rows.spring[tool] = contact.tools.compliance[tool]
    for c in range(3):
        contact.rows.more[tool, c] = -contact.tools.reaction[tool, c]
    for slot in range(tool * per_tool, (tool + 1) * per_tool):
        point = body.watched[slot]
        if point == NOBODY:
            continue
        if slots.busy[slot] == 0:
            if wanted == LIFTED:
                continue
            if slots.gap[slot] > _NEAR_GAP * radius and (contact.tick[0] + slot) % _EVERY != 0:
                continue
        elastic_surface.place(body, slot)
        for c in range(3):
            follow.position[slot, c] = follow.points[point, c] + body.displacement[slot, c]
        touches = _face(contact, tool, slot, beneath)
        if touches or slots.busy[slot] != 0:
            _add_row(contact, tool, slot, wanted)


@compiled
def _is_beneath(contact: SphereContact, tool: int) -> bool:
    """Whether the tool's center is beneath the surface at its anchor."""
    follow, anchor = contact.tracking, contact.tracking.anchor[tool]
    per_tool = contact.slots.busy.size // contact.tools.radius.size
    for slot in range(tool * per_tool, (tool + 1) * per_tool):
        if contact.body.watched[slot] == anchor:
            height = 0.0
            for c in range(3):
                away = contact.tools.center[tool, c] - follow.position[slot, c]
                height += away * follow.normals[anchor, c]
            return height < 0.0
    return False


@compiled
def _face(contact: SphereContact, tool: int, slot: int, beneath: bool) -> bool:
    """Write gap, normal and tilt of a watched point against a tool. Returns whether it is to be a row.

    The gap is the way from the sphere to the point along the normal at rest. Sidewards the sphere stands where it is over the
    tissue at rest, moved by the drift. Beyond _SINE of the radius from its axis the tip is the cone that touches it there.
    """
    slots, body, follow, tools = contact.slots, contact.body, contact.tracking, contact.tools
    point, radius, anchor = body.watched[slot], tools.radius[tool], follow.anchor[tool]
    height, apart, along = 0.0, 0.0, 0.0
    for c in range(3):
        away = follow.points[point, c] - tools.center[tool, c]
        height -= (away + body.displacement[slot, c]) * follow.normals[point, c]
        away += tools.drift[tool, c]
        apart += away * away
        along += away * follow.normals[point, c]
    lateral = math.sqrt(max(0.0, apart - along * along))
    if lateral < _SINE * radius:
        depth = math.sqrt(radius * radius - lateral * lateral)
        slope = 1.0 / depth
    else:
        depth = (_COSINE + _SINE * _TANGENT) * radius - _TANGENT * lateral
        slope = _TANGENT / lateral
    gap, approach, alignment = height - depth, 0.0, 0.0
    for c in range(3):
        outward = follow.normals[point, c]
        beside = follow.points[point, c] + tools.drift[tool, c] - tools.center[tool, c] - along * outward
        slots.normal[slot, c] = -outward
        slots.tilt[slot, c] = slope * beside if slots.bond[slot] == 0.0 else 0.0
        approach -= outward * (body.step[slot, c] - tools.moved[tool, c])
        approach -= slots.tilt[slot, c] * tools.moved[tool, c]
        alignment += outward * follow.normals[anchor, c]
    if height <= 0.0:
        slots.gap[slot] = min(gap, 0.0) if beneath else gap
        return beneath and alignment > 0.0 and lateral < radius
    slots.gap[slot] = gap
    return gap + approach < _MARGIN * radius


@compiled
def _add_row(contact: SphereContact, tool: int, slot: int, wanted: int) -> None:
    rows, slots, body = contact.rows, contact.slots, contact.body
    i = rows.n_rows[0]
    rows.n_rows[0] = i + 1
    rows.slot[i], rows.tool[i] = slot, tool
    rows.fixed[i] = 1 if wanted == LIFTED else 0
    rows.friction[i], rows.bond[i] = contact.tools.friction[tool], slots.bond[slot]
    gap = slots.gap[slot]
    bleed = 0.0
    if gap < 0.0 and slots.bond[slot] == 0.0 and contact.budget[0] > 0.0:
        period = body.period_s[0]
        bleed = min(-gap * period / _BLEED_S, _LARGEST_BLEED_M_PER_S * period)
    rows.slack[i] = max(gap, 0.0) - bleed if slots.bond[slot] == 0.0 else 0.0
    tilt, pressing, tilted = slots.tilt[slot], _pressing(slots, slot), 0.0
    for c in range(3):
        tilted += tilt[c] * contact.tools.moved[tool, c]
    for c in range(3):
        rows.normal[i, c], rows.tilt[i, c] = slots.normal[slot, c], tilt[c]
        rows.force[i, c] = slots.force[slot, c]
        rows.slip[3 * i + c] = (
            body.step[slot, c] - contact.tools.moved[tool, c] - tilted * slots.normal[slot, c]
        )
        rows.more[tool, c] += slots.force[slot, c] + pressing * tilt[c]


@compiled
def _pressing(slots: Slots, slot: int) -> float:
    """Normal force at a watched point, N."""
    force, normal = slots.force[slot], slots.normal[slot]
    return force[0] * normal[0] + force[1] * normal[1] + force[2] * normal[2]


@compiled
def _fill_matrix(contact: SphereContact) -> None:
    """A: the one-tick compliance of the tissue between all rows."""
    rows, body = contact.rows, contact.body
    n = rows.n_rows[0]
    compliance, matrix = body.compliance, rows.matrix
    for i in range(n):
        first = 3 * body.watched[rows.slot[i]]
        for j in range(n):
            column = 3 * body.watched[rows.slot[j]]
            for c in range(3):
                place = (3 * i + c) * 3 * n + 3 * j
                for d in range(3):
                    matrix[place + d] = compliance[first + c, column + d]


@compiled
def _load(contact: SphereContact) -> float:
    """Put the forces on the body. Returns the share of them with which the contacts give out no more than the budget."""
    rows, body, tools = contact.rows, contact.body, contact.tools
    elastic_surface.begin_load(body)
    for i in range(rows.n_rows[0]):
        x, y, z = rows.force[i, 0], rows.force[i, 1], rows.force[i, 2]
        if x != 0.0 or y != 0.0 or z != 0.0:
            elastic_surface.add_load(body, rows.tool[i], rows.slot[i], x, y, z)
    elastic_surface.finish_load(body)
    given, taken = -body.energy[FREE_WORK], body.energy[SELF_WORK]
    for tool in range(tools.radius.size):
        for c in range(3):
            total = tools.reaction[tool, c] + rows.more[tool, c]
            given += total * (tools.moved[tool, c] + tools.compliance[tool] * tools.reaction[tool, c])
            taken += tools.compliance[tool] * total * total
    budget = contact.budget[0]
    share = 1.0
    if given - taken < -budget:
        share = min(1.0, (given + math.sqrt(given * given + 4.0 * taken * budget)) / (2.0 * taken))
        share = max(share, 0.0)
    contact.budget[0] = min(max(0.0, budget + share * given - share * share * taken), _LARGEST_BUDGET_J)
    return share


@compiled
def _keep_forces(contact: SphereContact, share: float) -> None:
    """Keep the rows' forces for the next tick."""
    rows, slots = contact.rows, contact.slots
    for i in range(rows.n_rows[0]):
        slot = rows.slot[i]
        slots.busy[slot] = 1 if slots.bond[slot] > 0.0 else 0
        for c in range(3):
            slots.force[slot, c] = share * rows.force[i, c]
            if slots.force[slot, c] != 0.0:
                slots.busy[slot] = 1


@compiled
def _settle(contact: SphereContact, tool: int, wanted: int) -> None:
    """Count the tool's energies, move its sphere, and make or loosen bonds."""
    tools, slots, body = contact.tools, contact.slots, contact.body
    per_tool = slots.busy.size // tools.radius.size
    first, last = tool * per_tool, (tool + 1) * per_tool
    work, squared = 0.0, 0.0
    for c in range(3):
        total = 0.0
        for slot in range(first, last):
            if slots.busy[slot] != 0:
                total += slots.force[slot, c] + _pressing(slots, slot) * slots.tilt[slot, c]
        tools.reaction[tool, c] = total
        tools.center[tool, c] = tools.device[tool, c] - tools.compliance[tool] * total
        work += total * tools.moved[tool, c]
        squared += total * total
    stored = 0.5 * tools.compliance[tool] * squared
    tools.work[tool] += work
    tools.dissipated[tool] += work - body.group_work[tool] - (stored - tools.stored[tool])
    tools.stored[tool] = stored
    _follow_tissue(contact, tool, first, last)
    if wanted == GRABBING and tools.attached[tool] == 0:
        _attach(contact, tool, first, last)
    elif wanted != GRABBING:
        _loosen(contact, first, last, wanted)
        tools.attached[tool] = 0


@compiled
def _follow_tissue(contact: SphereContact, tool: int, first: int, last: int) -> None:
    """The drift: the mean displacement of the points that are pressed, weighted with their force; without any, that of the anchor."""
    slots, body, drift = contact.slots, contact.body, contact.tools.drift[tool]
    pressed = 0.0
    for c in range(3):
        drift[c] = 0.0
    for slot in range(first, last):
        weight = max(0.0, _pressing(slots, slot)) if slots.busy[slot] != 0 else 0.0
        pressed += weight
        for c in range(3):
            drift[c] += weight * body.displacement[slot, c]
    for c in range(3):
        drift[c] = drift[c] / pressed if pressed > 0.0 else 0.0
    if pressed == 0.0:
        for slot in range(first, last):
            if body.watched[slot] != NOBODY and body.watched[slot] == contact.tracking.anchor[tool]:
                for c in range(3):
                    drift[c] = body.displacement[slot, c]


@compiled
def _attach(contact: SphereContact, tool: int, first: int, last: int) -> None:
    """Hold on to the points that are pressed."""
    slots = contact.slots
    for slot in range(first, last):
        if slots.busy[slot] != 0 and _pressing(slots, slot) > 0.0:
            slots.bond[slot] = _GRIP
            slots.busy[slot] = 1
            contact.tools.attached[tool] = 1


@compiled
def _loosen(contact: SphereContact, first: int, last: int, wanted: int) -> None:
    """Let bonds go: from the force that each has to none within some time constants."""
    slots = contact.slots
    for slot in range(first, last):
        if slots.bond[slot] == 0.0:
            continue
        squared = 0.0
        for c in range(3):
            squared += slots.force[slot, c] * slots.force[slot, c]
        bond = min(slots.bond[slot], math.sqrt(squared)) * math.exp(-contact.body.period_s[0] / _RELEASE_S)
        slots.bond[slot] = bond if bond > _LEAST_BOND_N and wanted != LIFTED else 0.0


@compiled
def _report(contact: SphereContact, tool: int, one: Record) -> None:
    """Write what a tool's contact is like, and its energies."""
    tools, rows, flags = contact.tools, contact.rows, 0
    n0, n1, n2, s0, s1, s2 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    pressed, sliding, points = 0.0, 0.0, 0
    for i in range(rows.n_rows[0]):
        slot = rows.slot[i]
        if rows.tool[i] != tool or not _is_pressed(contact, slot):
            continue
        points += 1
        x, y, z = rows.normal[i, 0], rows.normal[i, 1], rows.normal[i, 2]
        r0, r1, r2 = rows.slip[3 * i], rows.slip[3 * i + 1], rows.slip[3 * i + 2]
        normal = x * rows.force[i, 0] + y * rows.force[i, 1] + z * rows.force[i, 2]
        along = x * r0 + y * r1 + z * r2
        r0, r1, r2 = r0 - along * x, r1 - along * y, r2 - along * z
        weight = abs(normal)
        tilt = rows.tilt[i]
        n0, n1, n2 = n0 - weight * (x + tilt[0]), n1 - weight * (y + tilt[1]), n2 - weight * (z + tilt[2])
        s0, s1, s2 = s0 + weight * r0, s1 + weight * r1, s2 + weight * r2
        pressed += weight
        if math.sqrt(r0 * r0 + r1 * r1 + r2 * r2) > _SLIDING_M:
            sliding += weight
    length = math.sqrt(n0 * n0 + n1 * n1 + n2 * n2)
    scale = 1.0 / length if length > 0.0 else 0.0
    one.normal[0], one.normal[1], one.normal[2] = n0 * scale, n1 * scale, n2 * scale
    one.slip_m = math.sqrt(s0 * s0 + s1 * s1 + s2 * s2) / pressed if pressed > 0.0 else 0.0
    one.penetration_m = _depth(contact, tool) if points > 0 else 0.0
    one.n_contact_points = points
    if points > 0:
        flags |= _IN_CONTACT
    if sliding > 0.5 * pressed:
        flags |= _SLIDING
    if tools.attached[tool] != 0:
        flags |= _ATTACHED
    one.flags = flags
    one.work_j, one.stored_j, one.dissipated_j = tools.work[tool], tools.stored[tool], tools.dissipated[tool]


@compiled
def _is_pressed(contact: SphereContact, slot: int) -> bool:
    """Whether there is a force at a watched point."""
    force = contact.slots.force
    return force[slot, 0] != 0.0 or force[slot, 1] != 0.0 or force[slot, 2] != 0.0


@compiled
def _depth(contact: SphereContact, tool: int) -> float:
    """How deep the device's sphere is beneath the surface at rest, at the anchor, m."""
    anchor, depth = contact.tracking.anchor[tool], contact.tools.radius[tool]
    for c in range(3):
        away = contact.tools.device[tool, c] - contact.tracking.points[anchor, c]
        depth -= away * contact.tracking.normals[anchor, c]
    return max(0.0, depth)


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
