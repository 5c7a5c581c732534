"""Which points of a body see each other: whether the straight line between them stays inside."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import igl
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from palpate.geometry.cloud import TriangleSurface
from palpate.geometry.crossings import TriangleGrid, triangle_grid
from palpate.geometry.measures import triangle_normals
from palpate.geometry.sampling import sample_elements

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

INSET = 0.25
"""Depth, in node spacings, to which points are moved before they look: so that a surface that is a little concave, or a
groove that nodes do not resolve, hides nothing, and a gap does however narrow it is."""

_SAMPLING, _REACH, _NEIGHBORS = 0.75, 1.25, 24
"""Gaps are looked for between surface samples: how close these are, how far they look (both in node spacings), and at
how many others."""

_CELLS = 40
"""At least so many cells along the body where gaps are looked for: few triangles in each, however large they are."""

_MOVES = 5


@dataclass(frozen=True)
class Gaps:
    """The inside of a body as one that moves within it knows it.

    surface  the body's boundary, closed
    places   (n, 3), points of the surface next to a gap or a concave edge, m: from them, a part of the surface within
             1.25 node spacings is hidden
    spacing  (n,), node spacing at the places, m
    """

    surface: TriangleSurface
    places: Array
    spacing: Array

    def beside(self, points: Array) -> Mask:
        """(n,): whether each of the points (n, 3) is within 1.5 spacings of a gap."""
        return self._beside(points)[0]

    def eyes(self, points: Array) -> Array:
        """The points (n, 3), m, those next to a gap moved inside, to look from."""
        beside, spacing = self._beside(points)
        eyes = points.copy()
        if beside.any():
            eyes[beside] = self.inset(points[beside], INSET * spacing[beside])
        return eyes

    def sight(self, points: Array) -> Sight:
        """What is needed, time and again, to ask what the points (n, 3), m, see."""
        beside = np.flatnonzero(self.beside(points))
        return Sight(self, beside, self.eyes(points[beside]))

    def hidden(self, eyes: Array, others: Array) -> Mask:
        """(n,): whether the line from a point to another leaves the body; points (n, 3) each, moved inside before, m."""
        return self._grid.crossed(eyes, others)

    def inset(self, points: Array, depth_m: Array) -> Array:
        """The points (n, 3), those less than `depth_m` (n,) inside moved to that depth, or as deep as a thin part is."""
        return inset(points, depth_m, self.surface)

    def _beside(self, points: Array) -> tuple[Mask, Array]:
        if not len(self.places):
            return np.zeros(len(points), dtype=bool), np.zeros(len(points))
        farthest = 1.5 * float(self.spacing.max())
        distance, place = self._tree.query(points, distance_upper_bound=farthest * (1 + 1e-9))
        # Beyond the bound the distance is infinite and the place is none.
        spacing = self.spacing[np.minimum(place, len(self.places) - 1)]
        return distance <= 1.5 * spacing, spacing

    @cached_property
    def _tree(self) -> cKDTree:
        return cKDTree(self.places)

    @cached_property
    def _grid(self) -> TriangleGrid:
        return _grid(self.surface)


@dataclass(frozen=True)
class Sight:
    """Those of a set of points that are next to a gap.

    beside  (n,), indices of the points
    eyes    (n, 3), the points moved inside, m
    """

    gaps: Gaps
    beside: NDArray[np.intp]
    eyes: Array


def find_gaps(surface: TriangleSurface, field: Callable[[Array], Array]) -> Gaps:
    """The gaps that a closed surface leaves between parts of the body; `field` is the node spacing at points (n, 3), m."""
    samples, _ = sample_elements(surface.vertices, surface.triangles, field, _SAMPLING)
    points, spacing = samples.points, samples.spacing
    eyes = inset(points, INSET * spacing, surface)
    k = min(_NEIGHBORS, len(points))
    found = cKDTree(points).query(points, k=k, workers=-1)
    distance, other = (np.reshape(a, (-1, k)) for a in found)
    own, column = np.nonzero(distance <= _REACH * spacing[:, None])
    hidden = _grid(surface).crossed(eyes[own], eyes[other[own, column]])
    beside = np.unique(own[hidden])
    return Gaps(surface, points[beside], spacing[beside])


def inset(points: Array, depth_m: Array, surface: TriangleSurface) -> Array:
    """As `Gaps.inset`."""
    normals, _ = triangle_normals(surface)
    deepest, reached = points.copy(), np.full(len(points), -np.inf)
    moved, short = points, np.arange(len(points))
    for move in range(_MOVES):
        outside, triangle, closest, _ = igl.signed_distance(
            np.ascontiguousarray(moved),
            surface.vertices,
            surface.triangles.astype(np.int64),
            igl.SignedDistanceType.SIGNED_DISTANCE_TYPE_PSEUDONORMAL,
        )
        depth = -outside
        better = depth > reached[short]
        deepest[short[better]], reached[short[better]] = moved[better], depth[better]
        wanted = depth_m[short]
        still = reached[short] < wanted * (1 - 1e-6)
        if move == _MOVES - 1 or not still.any():
            break
        on_surface = np.abs(depth) < 1e-6 * wanted
        inward = np.where(
            on_surface[:, None],
            -normals[triangle],
            (moved - closest) / np.where(on_surface, 1.0, depth)[:, None],
        )
        moved, short = (closest + wanted[:, None] * inward)[still], short[still]
    return deepest


def _grid(surface: TriangleSurface) -> TriangleGrid:
    extents = np.ptp(surface.vertices[surface.triangles], axis=1).max(axis=1)
    body = float(np.ptp(surface.vertices, axis=0).max())
    return triangle_grid(surface, min(float(np.median(extents)), body / _CELLS))
