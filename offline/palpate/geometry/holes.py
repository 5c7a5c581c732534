"""Closes the holes of a triangle surface, each by the triangulation of its rim that has the least area.

G. Barequet, M. Sharir: Filling gaps in the boundary of a polyhedron, Computer Aided Geometric Design 12 (1995).
"""

from __future__ import annotations

import igl
import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

LONGEST_RIM = 2000
"""Vertices; the time grows with the third power, and is some ten seconds here."""


def rims(triangles: Indices) -> list[Indices]:
    """The vertices around each hole of a manifold, oriented surface, in the order in which triangles close it."""
    edges = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    run = set(map(tuple, edges.tolist()))
    loops = [np.array(loop, np.int64) for loop in igl.boundary_loop_all(triangles)]
    return [loop[::-1] if (loop[0], loop[1]) in run else loop for loop in loops]


def close(vertices: Array, rim: Indices) -> Indices:
    """Triangles (len(rim) - 2, 3) that close a hole. Raises ValueError if the rim is too long."""
    if len(rim) > LONGEST_RIM:
        raise ValueError(f"a hole of {len(rim):,} edges, expected at most {LONGEST_RIM:,}")
    split = _best_splits(np.ascontiguousarray(vertices[rim]))
    triangles, spans = [], [(0, len(rim) - 1)]
    while spans:
        first, last = spans.pop()
        if last - first > 1:
            middle = int(split[first, last])
            triangles.append((first, middle, last))
            spans += [(first, middle), (middle, last)]
    return rim[np.array(triangles, np.int64)]


@njit(cache=True)
def _best_splits(outline: Array) -> NDArray[np.int32]:
    """(n, n): the third corner of the triangle on the chord (i, k) in the triangulation of the vertices i to k."""
    n = len(outline)
    area = np.zeros((n, n))
    split = np.zeros((n, n), np.int32)
    for width in range(2, n):
        for i in range(n - width):
            k = i + width
            least = np.inf
            ux, uy, uz = outline[k] - outline[i]
            for j in range(i + 1, k):
                vx, vy, vz = outline[j] - outline[i]
                cx, cy, cz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
                total = area[i, j] + area[j, k] + 0.5 * np.sqrt(cx * cx + cy * cy + cz * cz)
                if total < least:
                    least = total
                    split[i, k] = j
            area[i, k] = least
    return split
