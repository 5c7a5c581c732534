"""Which points of the surface a tool can touch, followed from tick to tick.

Each tool has an *anchor*, the surface point nearest to its center, and slots in which the body watches the points near the anchor.
In contact the next anchor is looked for among the watched points alone: the tool is tracked along the surface, so a deep poke or a
thin lobe does not change its side. Without contact the nearest of all points at rest is taken.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from palpate_server.bodies import elastic_surface
from palpate_server.bodies.elastic_surface import NOBODY, ElasticSurface
from palpate_server.realtime.compiled import compiled

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

JOIN = 4
"""Points that a tool begins to watch in one tick at most: each costs a product with rows of the residual."""


class Tracking(NamedTuple):
    """m points, n tools with n_slots / n slots each.

    points, normals (m, 3), at rest; near (m, k), see near_points
    carried  (m,), m: radius of the smallest sphere that the points around each can carry
    anchor   (n,): a point; complete (n,): 1 when all points near it are watched
    position (n_slots, 3), m: of watched points, as it was found last
    mark     (m,): scratch, zero between uses
    """

    points: Floats
    normals: Floats
    near: Integers
    carried: Floats
    anchor: Integers
    complete: Integers
    position: Floats
    mark: Integers


@compiled
def nearest_at_rest(points: Floats, x: float, y: float, z: float) -> int:
    """The point nearest to a position, m."""
    nearest, least = 0, np.inf
    for i in range(points.shape[0]):
        a, b, c = points[i, 0] - x, points[i, 1] - y, points[i, 2] - z
        squared = a * a + b * b + c * c
        if squared < least:
            nearest, least = i, squared
    return nearest


@compiled
def nearest_watched(tracking: Tracking, body: ElasticSurface, center: Floats, first: int, last: int) -> int:
    """The nearest point watched in slots first .. last - 1, of those whose outward side faces the center if there are any."""
    nearest, least = NOBODY, np.inf
    behind, least_behind = NOBODY, np.inf
    for slot in range(first, last):
        point = body.watched[slot]
        if point == NOBODY:
            continue
        squared, height = 0.0, 0.0
        for c in range(3):
            away = center[c] - tracking.position[slot, c]
            squared += away * away
            height += away * tracking.normals[point, c]
        if height > 0.0 and squared < least:
            nearest, least = point, squared
        if squared < least_behind:
            behind, least_behind = point, squared
    return nearest if nearest != NOBODY else behind


@compiled
def watch_near(
    tracking: Tracking, body: ElasticSurface, tool: int, busy: Integers, gap: Floats, first: int, last: int
) -> None:
    """Watch the points near a tool's anchor in its slots, nearest first, at most JOIN new ones.

    busy (n_slots,): not zero for slots that must stay; gap (n_slots,), m: zero after this for new ones, so that they are looked at
    """
    near, mark, watched = tracking.near[tracking.anchor[tool]], tracking.mark, body.watched
    for k in range(near.size):
        if near[k] != NOBODY:
            mark[near[k]] = 1
    for slot in range(first, last):
        if watched[slot] != NOBODY and mark[watched[slot]] == 1:
            mark[watched[slot]] = 2
    joined, complete, slot = 0, 1, first
    for k in range(near.size):
        point = near[k]
        if point == NOBODY or mark[point] != 1:
            continue
        while slot < last and (busy[slot] or (watched[slot] != NOBODY and mark[watched[slot]] != 0)):
            slot += 1
        if slot == last or joined == JOIN:
            complete = 0
            break
        elastic_surface.watch(body, slot, point)
        mark[point], gap[slot] = 2, 0.0
        joined += 1
        elastic_surface.place(body, slot)
        for c in range(3):
            tracking.position[slot, c] = tracking.points[point, c] + body.displacement[slot, c]
    for k in range(near.size):
        if near[k] != NOBODY:
            mark[near[k]] = 0
    tracking.complete[tool] = complete
