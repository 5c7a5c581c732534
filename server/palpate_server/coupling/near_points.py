"""Which points of a surface are near each point, along the surface: found once, when a model is loaded."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from palpate_server.realtime.compiled import compiled

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

NONE = -1


class TooManyPoints(ValueError):
    """count: of points within the reach of one."""

    def __init__(self, count: int) -> None:
        super().__init__(f"{count} points are within the reach of one")
        self.count = count


def near_points(points: Floats, triangles: NDArray[np.int32], reach_m: float, most: int) -> Integers:
    """(n_points, k), k <= most: for each point those within reach_m, nearest first, itself included; NONE beyond them.

    Points that an edge connects with it are always near it. Another point counts only if edges within the reach connect it to the
    first, so that the far side of a thin lobe does not.
    Raises TooManyPoints where there are more than `most`.
    """
    starts, neighbors = _adjacency(len(points), triangles)
    table = np.full((len(points), most), NONE)
    largest = _fill(np.ascontiguousarray(points, dtype=float), starts, neighbors, reach_m, table)
    if largest > most:
        raise TooManyPoints(largest)
    return np.ascontiguousarray(table[:, : max(1, int(np.max(np.sum(table != NONE, axis=1), initial=1)))])


def _adjacency(n_points: int, triangles: NDArray[np.int32]) -> tuple[Integers, Integers]:
    """(n_points + 1,) and (n_edges,): the neighbors of point i are neighbors[starts[i] : starts[i + 1]]."""
    edges = np.concatenate([triangles[:, [i, j]] for i in range(3) for j in range(3) if i != j]).astype(
        np.int64
    )
    edges = np.unique(edges, axis=0) if len(edges) else edges.reshape(0, 2)
    starts = np.searchsorted(edges[:, 0], np.arange(n_points + 1))
    return starts.astype(np.int64), np.ascontiguousarray(edges[:, 1])


@compiled
def _fill(points: Floats, starts: Integers, neighbors: Integers, reach: float, table: Integers) -> int:
    """Walk over the edges from each point, within the reach. Returns the largest number of points found."""
    n = points.shape[0]
    seen, queue, distance = np.full(n, NONE), np.empty(n, np.int64), np.empty(n)
    largest = 0
    for start in range(n):
        queue[0], seen[start], distance[0] = start, start, 0.0
        count, next_one = 1, 0
        while next_one < count:
            here = queue[next_one]
            next_one += 1
            for e in range(starts[here], starts[here + 1]):
                other = neighbors[e]
                if seen[other] == start:
                    continue
                seen[other] = start
                apart = np.sqrt(np.sum((points[other] - points[start]) ** 2))
                if apart <= reach or here == start:
                    queue[count], distance[count] = other, apart
                    count += 1
        largest = max(largest, count)
        order = np.argsort(distance[:count])
        for k in range(min(count, table.shape[1])):
            table[start, k] = queue[order[k]]
    return largest
