"""Split a surface's triangles where a view needs them smaller, without opening cracks."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from palpate.geometry.cloud import TriangleSurface

Array = NDArray[np.float64]

_CORNERS_TO_CHILDREN = {
    # Which of the three edges (01, 12, 20) are halved -> children, as corners 0..2 and edge midpoints 3..5.
    (True, False, False): [(0, 3, 2), (3, 1, 2)],
    (False, True, False): [(0, 1, 4), (0, 4, 2)],
    (False, False, True): [(0, 1, 5), (5, 1, 2)],
    (True, True, False): [(3, 1, 4), (0, 3, 4), (0, 4, 2)],
    (False, True, True): [(4, 2, 5), (1, 4, 5), (0, 1, 5)],
    (True, False, True): [(0, 3, 5), (3, 1, 5), (1, 2, 5)],
    (True, True, True): [(0, 3, 5), (3, 1, 4), (5, 4, 2), (3, 4, 5)],
}


def refine_surface(surface: TriangleSurface, longest_edge: Callable[[Array], Array]) -> TriangleSurface:
    """Halve edges until none is longer than `longest_edge` at its midpoint; the shape stays as it is.

    longest_edge  from points (n, 3), m, to lengths (n,), m, all above 0

    An edge is halved for both of its triangles at once, so a closed surface stays closed and oriented.
    """
    vertices, triangles = surface.vertices, surface.triangles.astype(np.int64)
    while True:
        edges = np.stack([triangles, np.roll(triangles, -1, axis=1)], axis=2).reshape(-1, 2)
        unique, edge_of = np.unique(np.sort(edges, axis=1), axis=0, return_inverse=True)
        ends = vertices[unique]
        middle = ends.mean(axis=1)
        halved = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1) > longest_edge(middle)
        if not halved.any():
            return TriangleSurface(vertices, triangles.astype(np.int32))
        midpoint = np.where(halved, len(vertices) + np.cumsum(halved) - 1, -1)
        vertices = np.vstack([vertices, middle[halved]])
        edge_of = edge_of.reshape(-1, 3)
        corners = np.hstack([triangles, midpoint[edge_of]])  # (n, 6)
        split = halved[edge_of]
        parts = [triangles[~split.any(axis=1)]]
        for pattern, children in _CORNERS_TO_CHILDREN.items():
            chosen = corners[(split == pattern).all(axis=1)]
            parts += [chosen[:, list(child)] for child in children]
        triangles = np.vstack(parts)
