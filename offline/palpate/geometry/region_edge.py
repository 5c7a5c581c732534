"""Nodes on both sides of the edge of a region, so that what the region holds ends there, whatever the cloud.

A body that is held at nodes acts as if the part that is held reached beyond the outermost of them, by about 0.3 of the spacing. So
nodes are placed in pairs along the edge: one that far inside, the other a spacing further out.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from palpate.geometry.cloud import TriangleSurface
from palpate.geometry.placing import Placement
from palpate.geometry.refinement import refine_surface
from palpate.geometry.sampling import closest_point, sample_elements
from palpate.geometry.sharp_edges import sharp_edges
from palpate.geometry.spacing import SpacingField

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
Distance = Callable[[Array], Array]
"""How far points (n, 3), m, are outside a region, (n,), m; negative within it."""

INSIDE = 0.3
"""Distance of the outermost held nodes from the edge, in spacings: what makes a block right that is held on a part of one face, with
Poisson's ratios of 0.3 and 0.45 and spacings of a seventh and a tenth of its side within 0.03 of it (docs/validation.md)."""

ON_EDGE = 1e-6
"""Points of the edge belong to the region: slack in node spacings."""

_FINENESS = 1 / 8
"""Edges of the triangles that the region's edge crosses over the spacing of the nodes."""

_CLEAR = 0.6
"""Smallest distance of a pair from other nodes, in spacings."""

_ASTRAY = 0.3
"""Largest distance, in spacings, by which a node of a pair is moved to lie on the surface."""


@dataclass(frozen=True)
class Crossings:
    """Where the edge of a region crosses lines or the triangles of a surface.

    points   (n, 3), m, of the edge of the region
    outward  (n, 3), unit vectors along the line or surface, across the edge and out of the region
    """

    points: Array
    outward: Array


@dataclass(frozen=True)
class RegionEdge:
    """The curve on the surface where a region ends.

    outside   how far points are outside the region
    inside    distance from the edge of the nodes within, in spacings; the others are a spacing further out
    points    (n_points, 3), m
    segments  (n_segments, 2), indices of points
    outward   (n_segments, 3), unit vectors in the surface, across the segment and out of the region
    on_sharp_edges  where it crosses the surface's sharp edges
    """

    outside: Distance
    inside: float
    points: Array
    segments: Indices
    outward: Array
    on_sharp_edges: Crossings


def region_edge(
    surface: TriangleSurface, outside: Distance, field: SpacingField, inside: float = INSIDE
) -> RegionEdge:
    """The edge of a region on a surface; it has no segments where the region holds all of it or nothing."""
    fine = refine_surface(surface, lambda p: np.maximum(2 * np.abs(outside(p)), _FINENESS * field(p)))
    vertices, triangles = fine.vertices, fine.triangles.astype(np.int64)
    value = outside(vertices) - ON_EDGE * field(vertices)
    within = value <= 0
    sides_of = within[triangles]
    crossed = sides_of.any(axis=1) & ~sides_of.all(axis=1)
    triangles, sides_of = triangles[crossed], sides_of[crossed]
    # One corner of a crossed triangle is alone on its side: the edge crosses the two sides that meet there.
    alone = np.where(sides_of.sum(axis=1) == 1, np.argmax(sides_of, axis=1), np.argmin(sides_of, axis=1))
    turned = np.take_along_axis(triangles, (alone[:, None] + np.arange(3)) % 3, axis=1)
    sides = np.sort(turned[:, [[0, 1], [0, 2]]].reshape(-1, 2), axis=1)
    unique, which = np.unique(sides, axis=0, return_inverse=True)
    points = _between(vertices, value, unique)
    segments = which.reshape(-1, 2)
    along = points[segments[:, 1]] - points[segments[:, 0]]
    length = np.linalg.norm(along, axis=1)
    a, b, c = np.moveaxis(vertices[turned], 1, 0)
    across = np.cross(np.cross(b - a, c - a), along)
    size = np.linalg.norm(across, axis=1)
    away = np.where(within[turned[:, 0]], 1.0, -1.0) * np.einsum("si,si->s", across, (b + c) / 2 - a)
    kept = (size > 0) & (length > ON_EDGE * field(a))
    outward = (across * np.sign(away)[:, None])[kept] / size[kept, None]
    return RegionEdge(outside, inside, points, segments[kept], outward, _on_sharp_edges(fine, value))


def _on_sharp_edges(fine: TriangleSurface, value: Array) -> Crossings:
    edges, _ = sharp_edges(fine)
    within = value[edges] <= 0
    edges = np.take_along_axis(edges, np.argsort(~within, axis=1, kind="stable"), axis=1)[
        within[:, 0] != within[:, 1]
    ]
    direction = fine.vertices[edges[:, 1]] - fine.vertices[edges[:, 0]]
    return Crossings(
        _between(fine.vertices, value, edges), direction / np.linalg.norm(direction, axis=1, keepdims=True)
    )


def _between(vertices: Array, value: Array, edges: Indices) -> Array:
    """(n, 3): where the value is 0 on edges (n, 2) with ends of different signs."""
    first, second = value[edges].T
    share = first / (first - second)
    return vertices[edges[:, 0]] + share[:, None] * (vertices[edges[:, 1]] - vertices[edges[:, 0]])


def spread_along(edge: RegionEdge, placement: Placement) -> Crossings:
    """Points of the edge about a spacing apart, none close to where it crosses a sharp edge."""
    if not len(edge.segments):
        return Crossings(np.empty((0, 3)), np.empty((0, 3)))
    samples, _ = sample_elements(edge.points, edge.segments, placement.field, _FINENESS)
    crossings = edge.on_sharp_edges.points

    def on_edge(points: Array) -> Array:
        return closest_point(points, edge.points, edge.segments)[0]

    points = placement.place(crossings, samples, 1, on_edge)[len(crossings) :]
    return Crossings(points, edge.outward[closest_point(points, edge.points, edge.segments)[1]])


def paired_nodes(
    edge: RegionEdge, at: Crossings, project: Callable[[Array], Array], field: SpacingField, taken: Array
) -> Array:
    """(2 n_pairs, 3), m: pairs of nodes across the edge at some of its points, none close to another pair or nodes taken (n, 3).

    project  from points (n, 3), m, to the nearest of the line or surface on which the nodes lie
    """
    if not len(at.points):
        return np.empty((0, 3))
    spacing = field(at.points)
    arms = np.array([-edge.inside, 1 - edge.inside])[:, None, None] * spacing[:, None] * at.outward
    aimed = (at.points + arms).reshape(-1, 3)
    nodes = project(aimed)
    astray = np.linalg.norm(nodes - aimed, axis=1).reshape(2, -1) > _ASTRAY * spacing
    inner, outer = nodes.reshape(2, -1, 3)
    good = ~astray.any(axis=0) & (edge.outside(inner) < 0) & (edge.outside(outer) > 0)
    if len(taken):
        tree = cKDTree(taken)
        for side in (inner, outer):
            good &= tree.query(side)[0] >= _CLEAR * spacing
    near = cKDTree(nodes).query_ball_point(nodes, _CLEAR * np.tile(spacing, 2))
    n, kept = len(spacing), []
    for i in range(n):
        if good[i]:
            kept.append(i)
            good[np.array(near[i] + near[n + i]) % n] = False
    return np.concatenate([inner[kept], outer[kept]])
