"""The edges and corners of a triangle surface that a smooth spread of nodes would round off."""

from __future__ import annotations

import igl
import numpy as np
from numpy.typing import NDArray

from palpate.geometry.cloud import TriangleSurface

Indices = NDArray[np.int64]

SHARP_RAD = np.deg2rad(50.0)
"""Smallest turn of the normal, or of an edge's direction, that counts as sharp."""


def sharp_edges(surface: TriangleSurface) -> tuple[Indices, Indices]:
    """Edges (n_edges, 2) where the normal turns by 50 degrees or more, and the corners (n_corners,), as vertices.

    A corner is where sharp edges end, fork, or turn by 50 degrees or more. The surface must be closed and oriented.
    """
    edges = igl.sharp_edges(surface.vertices, surface.triangles.astype(np.int64), float(SHARP_RAD))
    edges = np.sort(edges, axis=1)
    edges = edges[np.lexsort(edges.T)]  # nodes are placed in this order, whatever the library's is
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
