"""Which straight segments cross a triangle surface: a uniform grid of cells and the triangles in each, compiled."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from palpate.geometry.cloud import TriangleSurface

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

_MOST_CELLS = 4_000_000

_SLACK = 1e-9
"""How far beyond a triangle's edge a segment still hits it, and from its own ends no longer, as a fraction of each."""


class TriangleGrid(NamedTuple):
    """A surface's triangles by the cells that their boxes overlap. A NamedTuple, as compiled code takes no data classes.

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
        return _crossed(starts, ends, self)


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


@njit(cache=True)
def _crossed(begins: Array, ends: Array, grid: TriangleGrid) -> NDArray[np.bool_]:
    low, size, shape, starts = grid.low, grid.size_m, grid.shape, grid.starts
    crossed = np.zeros(len(begins), np.bool_)
    for i in range(len(begins)):
        ax, ay, az = begins[i, 0] - low[0], begins[i, 1] - low[1], begins[i, 2] - low[2]
        dx, dy, dz = ends[i, 0] - begins[i, 0], ends[i, 1] - begins[i, 1], ends[i, 2] - begins[i, 2]
        pieces = int(max(abs(dx), abs(dy), abs(dz)) / size) + 1
        for piece in range(pieces):
            s, t = piece / pieces, (piece + 1) / pieces
            x_first, x_last = _range(ax + s * dx, ax + t * dx, size, shape[0])
            y_first, y_last = _range(ay + s * dy, ay + t * dy, size, shape[1])
            z_first, z_last = _range(az + s * dz, az + t * dz, size, shape[2])
            if z_first > z_last:
                continue
            for x in range(x_first, x_last + 1):
                for y in range(y_first, y_last + 1):
                    row = (x * shape[1] + y) * shape[2]
                    for m in range(starts[row + z_first], starts[row + z_last + 1]):
                        if not crossed[i] and _crosses(begins, ends, i, grid.corners, grid.members[m]):
                            crossed[i] = True
            if crossed[i]:
                break
    return crossed


@njit(cache=True)
def _range(p: float, q: float, size: float, count: int) -> tuple[int, int]:
    """First and last cell along an axis between p and q, m from the grid's lowest corner; empty outside the grid."""
    first = int(np.floor(min(p, q) / size - _SLACK))
    last = int(np.floor(max(p, q) / size + _SLACK))
    return max(first, 0), min(last, count - 1)


@njit(cache=True)
def _crosses(begins: Array, ends: Array, i: int, corners: Array, t: int) -> bool:
    """Whether segment i crosses triangle t (Möller & Trumbore 1997)."""
    ox, oy, oz = corners[t, 0, 0], corners[t, 0, 1], corners[t, 0, 2]
    ux, uy, uz = corners[t, 1, 0] - ox, corners[t, 1, 1] - oy, corners[t, 1, 2] - oz
    vx, vy, vz = corners[t, 2, 0] - ox, corners[t, 2, 1] - oy, corners[t, 2, 2] - oz
    dx, dy, dz = ends[i, 0] - begins[i, 0], ends[i, 1] - begins[i, 1], ends[i, 2] - begins[i, 2]
    px, py, pz = dy * vz - dz * vy, dz * vx - dx * vz, dx * vy - dy * vx
    determinant = ux * px + uy * py + uz * pz
    if determinant == 0.0:
        return False
    sx, sy, sz = begins[i, 0] - ox, begins[i, 1] - oy, begins[i, 2] - oz
    u = (sx * px + sy * py + sz * pz) / determinant
    if u < -_SLACK or u > 1 + _SLACK:
        return False
    qx, qy, qz = sy * uz - sz * uy, sz * ux - sx * uz, sx * uy - sy * ux
    v = (dx * qx + dy * qy + dz * qz) / determinant
    if v < -_SLACK or u + v > 1 + _SLACK:
        return False
    along = (vx * qx + vy * qy + vz * qz) / determinant
    return _SLACK < along < 1 - _SLACK
