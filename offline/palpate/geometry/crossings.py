"""Which straight segments cross a triangle surface: a uniform grid of cells and the triangles in each, compiled."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from palpate.geometry.cloud import TriangleSurface

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

_MOST_CELLS = 4_000_000

_FEW = 4096
"""Segments below which starting threads takes longer than the search."""

_SLACK = 1e-9
"""How far beyond a triangle's edge a segment still hits it, and from its own ends no longer, as a fraction of each."""


@dataclass(frozen=True)
class TriangleGrid:
    """A surface's triangles by the cells that their boxes overlap.

    low      (3,), lowest corner of the grid, m
    size_m   edge of a cell, m
    shape    (3,), number of cells along x, y, z
    starts   (n_cells + 1,), where in `members` each cell's triangles begin
    members  (nnz,), triangles, cell by cell
    corners  (n_triangles, 3, 3), m
    """

    low: Array
    size_m: float
    shape: Indices
    starts: Indices
    members: Indices
    corners: Array

    def crossed(self, starts: Array, ends: Array) -> NDArray[np.bool_]:
        """(n,): whether the segments between the points (n, 3) and (n, 3), m, cross the surface between their ends."""
        starts, ends = np.ascontiguousarray(starts, float), np.ascontiguousarray(ends, float)
        search = _crossed if len(starts) < _FEW else _crossed_in_parallel
        return search(
            starts, ends, self.low, self.size_m, self.shape, self.starts, self.members, self.corners
        )


def triangle_grid(surface: TriangleSurface, size_m: float) -> TriangleGrid:
    """The surface in cells of `size_m`, or larger ones if those were more than some millions."""
    corners = np.ascontiguousarray(surface.vertices[surface.triangles])
    low = corners.min(axis=(0, 1))
    extent = corners.max(axis=(0, 1)) - low
    size_m = max(size_m, float(np.cbrt(np.prod(np.maximum(extent, size_m)) / _MOST_CELLS)))
    shape = np.floor(extent / size_m).astype(np.int64) + 1
    first = ((corners.min(axis=1) - low) / size_m).astype(np.int64)
    last = np.minimum(((corners.max(axis=1) - low) / size_m).astype(np.int64), shape - 1)
    starts, members = _cells(first, last, shape)
    return TriangleGrid(low, size_m, shape, starts, members, corners)


@njit(cache=True)
def _cells(first: Indices, last: Indices, shape: Indices) -> tuple[Indices, Indices]:
    """starts and members of the cells from each triangle's range of cells, first to last (n_triangles, 3)."""
    starts = np.zeros(shape[0] * shape[1] * shape[2] + 1, np.int64)
    members = np.empty(0, np.int64)
    for filling in range(2):
        for t in range(len(first)):
            for x in range(first[t, 0], last[t, 0] + 1):
                for y in range(first[t, 1], last[t, 1] + 1):
                    for z in range(first[t, 2], last[t, 2] + 1):
                        cell = (x * shape[1] + y) * shape[2] + z
                        if filling:
                            starts[cell + 1] -= 1
                            members[starts[cell + 1]] = t
                        else:
                            starts[cell + 1] += 1
        if not filling:
            starts = np.cumsum(starts)
            members = np.empty(starts[-1], np.int64)
    # Filling from the back has moved every cell's end to its beginning.
    starts[:-1] = starts[1:]
    starts[-1] = len(members)
    return starts, members


def _search(
    begins: Array,
    ends: Array,
    low: Array,
    size: float,
    shape: Indices,
    starts: Indices,
    members: Indices,
    corners: Array,
) -> NDArray[np.bool_]:
    crossed = np.zeros(len(begins), np.bool_)
    for i in prange(len(begins)):
        begin, end = begins[i], ends[i]
        length = 0.0
        for a in range(3):
            length = max(length, abs(end[a] - begin[a]))
        pieces = int(length / size) + 1
        for piece in range(pieces):
            first = np.empty(3, np.int64)
            last = np.empty(3, np.int64)
            for a in range(3):
                p = begin[a] + (end[a] - begin[a]) * piece / pieces - low[a]
                q = begin[a] + (end[a] - begin[a]) * (piece + 1) / pieces - low[a]
                first[a] = max(int(np.floor(min(p, q) / size - _SLACK)), 0)
                last[a] = min(int(np.floor(max(p, q) / size + _SLACK)), shape[a] - 1)
            for x in range(first[0], last[0] + 1):
                for y in range(first[1], last[1] + 1):
                    for z in range(first[2], last[2] + 1):
                        cell = (x * shape[1] + y) * shape[2] + z
                        for m in range(starts[cell], starts[cell + 1]):
                            if not crossed[i] and _crosses(begin, end, corners[members[m]]):
                                crossed[i] = True
            if crossed[i]:
                break
    return crossed


@njit(cache=True)
def _crosses(begin: Array, end: Array, triangle: Array) -> bool:
    """Whether a segment crosses a triangle (3, 3) (Möller & Trumbore 1997)."""
    ux, uy, uz = (
        triangle[1, 0] - triangle[0, 0],
        triangle[1, 1] - triangle[0, 1],
        triangle[1, 2] - triangle[0, 2],
    )
    vx, vy, vz = (
        triangle[2, 0] - triangle[0, 0],
        triangle[2, 1] - triangle[0, 1],
        triangle[2, 2] - triangle[0, 2],
    )
    dx, dy, dz = end[0] - begin[0], end[1] - begin[1], end[2] - begin[2]
    px, py, pz = dy * vz - dz * vy, dz * vx - dx * vz, dx * vy - dy * vx
    determinant = ux * px + uy * py + uz * pz
    if determinant == 0.0:
        return False
    sx, sy, sz = begin[0] - triangle[0, 0], begin[1] - triangle[0, 1], begin[2] - triangle[0, 2]
    u = (sx * px + sy * py + sz * pz) / determinant
    if u < -_SLACK or u > 1 + _SLACK:
        return False
    qx, qy, qz = sy * uz - sz * uy, sz * ux - sx * uz, sx * uy - sy * ux
    v = (dx * qx + dy * qy + dz * qz) / determinant
    if v < -_SLACK or u + v > 1 + _SLACK:
        return False
    t = (vx * qx + vy * qy + vz * qz) / determinant
    return _SLACK < t < 1 - _SLACK


_crossed = njit(cache=True)(_search)
_crossed_in_parallel = njit(parallel=True, cache=True)(_search)
