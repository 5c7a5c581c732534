"""The triangle surface whose vertices are the boundary nodes of a cloud."""

from __future__ import annotations

import igl
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from palpate.geometry.cloud import NodeCloud, TriangleSurface
from palpate.geometry.measures import triangle_normals
from palpate.geometry.refinement import refine_surface
from palpate.geometry.visibility import Gaps

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

_FINENESS = 1 / 6
"""Edges of the fine triangulation over the spacing of the nodes."""

_CANDIDATES = 8
"""Next to a gap, so many of the nearest nodes are asked whether they are in sight."""

_SIDES_APART = 0.5
"""Distance, in spacings, that a unit of difference between normals counts as: the far side of a thin part is another place."""


class NodeSurfaceError(ValueError):
    """The boundary nodes are too far apart to be the vertices of a closed surface; the message says where."""


def node_surface(cloud: NodeCloud) -> TriangleSurface:
    """The body's surface with the boundary nodes, in their order, as vertices.

    Every vertex of a fine triangulation of the surface is moved to the node nearest to it. Triangles whose corners went to
    three nodes are kept; they are the dual of the nodes' Voronoi cells on the surface. A map of this kind takes a closed
    surface to a closed one: triangles that come in both orientations are folds, and cancel (Valette & Chassery 2004
    simplify surfaces so).

    Raises NodeSurfaceError where the result is not closed with two triangles at every edge, touches itself in a node, or lacks one.
    """
    nodes, spacing = cloud.points[cloud.boundary], cloud.spacing[cloud.boundary]
    tree = cKDTree(nodes)
    fine = refine_surface(cloud.surface, lambda p: _FINENESS * spacing[tree.query(p, workers=-1)[1]])
    near = spacing[tree.query(fine.vertices, workers=-1)[1]]
    places = _with_sides(fine.vertices, _vertex_normals(fine), near)
    places_of_nodes = _with_sides(nodes, cloud.normals[cloud.boundary], spacing)
    _, near_nodes = cKDTree(places_of_nodes).query(places, k=min(_CANDIDATES, len(nodes)), workers=-1)
    nearest = _first_in_sight(near_nodes.reshape(len(places), -1), fine.vertices, nodes, cloud.gaps)
    triangles = _without_folds(nearest[fine.triangles])
    _require_closed(nodes, triangles)
    return TriangleSurface(nodes, triangles.astype(np.int32))


def _with_sides(points: Array, normals: Array, spacing: Array) -> Array:
    """(n, 6), m: places between which the distance grows with that between points and with the angle between normals."""
    return np.hstack([points, _SIDES_APART * spacing[:, None] * normals])


def _first_in_sight(candidates: Indices, vertices: Array, nodes: Array, gaps: Gaps | None) -> Indices:
    """(n_vertices,): of the candidates (n_vertices, k) of each vertex, nearest first, the first that no gap hides."""
    nearest = candidates[:, 0].copy()
    if gaps is None:
        return nearest
    sight, eyes = gaps.sight(vertices), gaps.eyes(nodes)
    blind = np.arange(len(sight.beside))
    for column in candidates[sight.beside].T:
        hidden = gaps.hidden(sight.eyes[blind], eyes[column[blind]])
        seen = blind[~hidden]
        nearest[sight.beside[seen]] = column[seen]
        blind = blind[hidden]
    return nearest


def _vertex_normals(surface: TriangleSurface) -> Array:
    """(n_vertices, 3): unit normals, the mean over the triangles at each vertex weighted with their areas."""
    normals, areas = triangle_normals(surface)
    weighted = np.repeat(areas[:, None] * normals, 3, axis=0)
    corners, n = surface.triangles.ravel(), len(surface.vertices)
    total = np.column_stack([np.bincount(corners, w, minlength=n) for w in weighted.T])
    length = np.linalg.norm(total, axis=1, keepdims=True)
    return total / np.where(length > 0, length, 1.0)


def _without_folds(corners: Indices) -> Indices:
    """(n, 3): the triangles with three distinct corners, each as often as it comes more in one orientation than in the other."""
    distinct = (corners != np.roll(corners, 1, axis=1)).all(axis=1)
    corners = corners[distinct]
    first = np.argmin(corners, axis=1)[:, None]
    turned = np.take_along_axis(corners, (first + np.arange(3)) % 3, axis=1)
    forward = turned[:, 1] < turned[:, 2]
    unique, which = np.unique(np.sort(corners, axis=1), axis=0, return_inverse=True)
    surplus = np.rint(np.bincount(which.ravel(), np.where(forward, 1.0, -1.0), minlength=len(unique)))
    kept = np.where((surplus > 0)[:, None], unique, unique[:, [0, 2, 1]])
    return np.repeat(kept, np.abs(surplus).astype(np.int64), axis=0)


def _require_closed(nodes: Array, triangles: Indices) -> None:
    edges = np.stack([triangles, np.roll(triangles, -1, axis=1)], axis=2).reshape(-1, 2)
    unique, counts = np.unique(edges, axis=0, return_counts=True)
    bad = unique[counts > 1].ravel()
    bad = np.concatenate([bad, np.setdiff1d(np.arange(len(nodes)), triangles)])
    if not len(bad):
        bad = np.flatnonzero(~igl.is_vertex_manifold(np.ascontiguousarray(triangles)))
    if len(bad):
        raise NodeSurfaceError(
            f"the surface nodes near {nodes[bad[0]].round(4).tolist()} m are too far apart for the shape of the body: "
            "expected a smaller spacing_m there"
        )
