"""Which points each sphere touches in a tick, and how far they are from it.

Contact is that of linear theory (Hertz 1882; Sneddon 1965): gaps are measured, and the tissue is pressed, along its normals at
rest. The sphere feels the gradient of the gap, so a side force as well where it slopes.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from palpate_server.bodies import elastic_surface
from palpate_server.bodies.elastic_surface import NOBODY
from palpate_server.coupling import tracking
from palpate_server.coupling.spheres import LIFTED, SphereContact, pressing, slots_of
from palpate_server.realtime.compiled import compiled

Floats = NDArray[np.float64]

_MARGIN = 0.05  # of the radius: points with a smaller gap are rows of the system
_NEAR_GAP = 0.4  # of the radius: points with a larger gap are looked at only
_EVERY = 8  # ticks
_STEEPEST = 2.0  # m by which a gap closes at most where the sphere moves by 1 m: 1 / cos of 60 degrees
_SINE, _COSINE, _TANGENT = (
    math.sqrt(0.75),
    0.5,
    math.sqrt(3.0),
)  # of 60 degrees, where a sphere's side becomes a cone
_BLEED_S = 0.01  # time constant with which old penetration is pushed out
_LARGEST_BLEED_M_PER_S = 0.02


@compiled
def move(contact: SphereContact, tool: int, device: Floats, wanted: int) -> None:
    """Move the device; the sphere follows as it does under an unchanged force."""
    tools = contact.tools
    starts = tools.wanted[tool] == LIFTED
    for c in range(3):
        tools.moved[tool, c] = 0.0 if starts else device[c] - tools.device[tool, c]
        tools.device[tool, c] = device[c]
        tools.center[tool, c] = (
            device[c] - tools.moved[tool, c] - tools.compliance[tool] * tools.reaction[tool, c]
        )
    if starts:
        first, last = slots_of(contact, tool)
        contact.slots.gap[first:last] = 0.0  # not known: all points are looked at
    tools.wanted[tool] = wanted


@compiled
def track(contact: SphereContact, tool: int) -> None:
    """Choose the tool's anchor, and watch the points near it."""
    body, follow, center = contact.body, contact.tracking, contact.tools.center[tool]
    first, last = slots_of(contact, tool)
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
        tracking.watch_near(follow, body, tool, contact.slots.busy, contact.slots.gap, first, last)


@compiled
def find_rows(contact: SphereContact, tool: int, wanted: int) -> None:
    """Add the rows of a tool to the system: points with a force, and points that its sphere touches or nearly touches."""
    body, slots, follow = contact.body, contact.slots, contact.tracking
    first, last = slots_of(contact, tool)
    radius, moved = contact.tools.radius[tool], 0.0
    beneath = wanted != LIFTED and _is_beneath(contact, tool)
    contact.rows.spring[tool] = contact.tools.compliance[tool]
    for c in range(3):
        contact.rows.more[tool, c] = -contact.tools.reaction[tool, c]
        moved += contact.tools.moved[tool, c] ** 2
    closer = _STEEPEST * math.sqrt(moved)
    for slot in range(first, last):
        point = body.watched[slot]
        if point == NOBODY:
            continue
        if slots.busy[slot] == 0:
            if wanted == LIFTED:
                continue
            slots.gap[slot] -= closer  # no smaller than the gap, as long as the tissue rests
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
    first, last = slots_of(contact, tool)
    for slot in range(first, last):
        if contact.body.watched[slot] == anchor:
            height = max(0.0, follow.carried[anchor] - contact.tools.radius[tool])
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
    Where the points are too far apart for the sphere it is as blunt as they can carry, with the same lowest point: between the
    points a sharper one would touch none.
    """
    slots, body, follow, tools = contact.slots, contact.body, contact.tracking, contact.tools
    point, anchor = body.watched[slot], follow.anchor[tool]
    radius = max(tools.radius[tool], follow.carried[point])
    height, apart, along = radius - tools.radius[tool], 0.0, 0.0
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
    tilt, normal_force, tilted = slots.tilt[slot], pressing(slots, slot), 0.0
    for c in range(3):
        tilted += tilt[c] * contact.tools.moved[tool, c]
    for c in range(3):
        rows.normal[i, c], rows.tilt[i, c] = slots.normal[slot, c], tilt[c]
        rows.force[i, c] = slots.force[slot, c]
        rows.slip[3 * i + c] = (
            body.step[slot, c] - contact.tools.moved[tool, c] - tilted * slots.normal[slot, c]
        )
        rows.more[tool, c] += slots.force[slot, c] + normal_force * tilt[c]


@compiled
def fill_matrix(contact: SphereContact) -> None:
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
