"""Rigid spheres in contact with the surface of a body: fixed material points against moving spheres.

Each tick finds the points near each sphere (`gaps`), solves all contacts of all tools as one system (`contact_solver`) and
advances the body.

Passivity. The same rows, normals and tilts map force and displacement, so the work of the contacts is exact. Contacts may only
lose energy, or give back what tissue and contacts have dissipated before: old penetration is pushed out with that, at most 1 mJ. Where an iterate that has
not converged would give out more, all forces are scaled back, to a share a of themselves, with which the loss a p - a² w is not
below minus that budget. So the work of the tools is what is stored in body and springs plus what is lost, at each tick.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate_client.wire import Flags
from palpate_server.bodies import elastic_surface
from palpate_server.bodies.elastic_surface import FREE_WORK, NOBODY, SELF_WORK, STORED, WORK
from palpate_server.coupling import contact_solver, gaps
from palpate_server.coupling.spheres import GRABBING, LIFTED, SphereContact, pressing, slots_of
from palpate_server.realtime.compiled import compiled

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Records = NDArray[np.void]
Record = Any  # one element of a structured array

_GRIP = 1e12  # N
_RELEASE_S = 0.02  # time constant of a bond after release
_LEAST_BOND_N = 1e-3
_LARGEST_BUDGET_J = 1e-3
_SLIDING_M = 1e-8  # slip of a tick below which a point at the friction limit is not called sliding

_IN_CONTACT, _SLIDING, _ATTACHED = int(Flags.IN_CONTACT), int(Flags.SLIDING), int(Flags.ATTACHED)


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
        gaps.move(contact, tool, center[tool], wanted[tool])
        if wanted[tool] != LIFTED:
            gaps.track(contact, tool)
        gaps.find_rows(contact, tool, wanted[tool])
    gaps.fill_matrix(contact)
    contact_solver.solve(contact.rows)
    share = load(contact)
    commit(contact, share)
    keep_forces(contact, share)
    for tool in range(center.shape[0]):
        settle(contact, tool, wanted[tool])
        _report(contact, tool, reactions[tool])
        for c in range(3):
            force[tool, c] = -contact.tools.reaction[tool, c]
    contact.tick[0] += 1


@compiled
def load(contact: SphereContact) -> float:
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
def commit(contact: SphereContact, share: float) -> None:
    """Advance the body. What it dissipates is at hand for pushing out penetration."""
    energy = contact.body.energy
    before = energy[WORK] - energy[STORED]
    elastic_surface.commit(contact.body, share)
    dissipated = energy[WORK] - energy[STORED] - before
    contact.budget[0] = min(max(0.0, contact.budget[0] + dissipated), _LARGEST_BUDGET_J)


@compiled
def keep_forces(contact: SphereContact, share: float) -> None:
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
def settle(contact: SphereContact, tool: int, wanted: int) -> None:
    """Count the tool's energies, move its sphere, and make or loosen bonds."""
    tools, slots, body = contact.tools, contact.slots, contact.body
    first, last = slots_of(contact, tool)
    work, squared = 0.0, 0.0
    for c in range(3):
        total = 0.0
        for slot in range(first, last):
            if slots.busy[slot] != 0:
                total += slots.force[slot, c] + pressing(slots, slot) * slots.tilt[slot, c]
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
        weight = max(0.0, pressing(slots, slot)) if slots.busy[slot] != 0 else 0.0
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
        if slots.busy[slot] != 0 and pressing(slots, slot) > 0.0:
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
