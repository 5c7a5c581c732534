"""The edges and corners of a triangle surface that a smooth spread of nodes would round off."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from palpate.geometry.cloud import TriangleSurface
from palpate.geometry.measures import triangle_normals

Indices = NDArray[np.int64]

SHARP_RAD = np.deg2rad(50.0)
"""Turn of the normal, or of an edge's direction, from which on it counts as sharp."""


def sharp_edges(surface: TriangleSurface) -> tuple[Indices, Indices]:
    """Edges (n_edges, 2) where the normal turns by 50 degrees or more, and the corners (n_corners,), as vertices.

    A corner is where sharp edges end, fork, or turn by 50 degrees or more. The surface must be closed and oriented.
    """
    triangles = surface.triangles.astype(np.int64)
    directed = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    owner = np.tile(np.arange(len(triangles)), 3)
    forward = directed[:, 0] < directed[:, 1]
    order = np.lexsort(directed[forward].T)
    reverse_order = np.lexsort(directed[~forward][:, ::-1].T)
    edges = directed[forward][order]
    normals, _ = triangle_normals(surface)
    left, right = normals[owner[forward][order]], normals[owner[~forward][reverse_order]]
    edges = edges[np.einsum("ei,ei->e", left, right) <= np.cos(SHARP_RAD)]

    directions = surface.vertices[edges[:, 1]] - surface.vertices[edges[:, 0]]
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    ends = np.concatenate([edges[:, 0], edges[:, 1]])
    degree = np.bincount(ends, minlength=len(surface.vertices))
    # Unit vectors away from the vertex along its two edges add up to 0 when the edges continue straight.
    away = np.zeros_like(surface.vertices)
    np.add.at(away, ends, np.concatenate([directions, -directions]))
    turns = np.linalg.norm(away, axis=1) >= 2 * np.sin(SHARP_RAD / 2)
    corners = np.flatnonzero((degree > 0) & ((degree != 2) | turns))
    return edges, corners
