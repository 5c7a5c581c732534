"""Places on a part of a surface, well inside it and apart from each other."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

Array = NDArray[np.float64]

_INSIDE = 1 / 3
"""Least distance from the edge over the greatest that a point of the part has."""


def places_apart(points: Array, beyond: Array, count: int) -> NDArray[np.intp]:
    """(count,): of points (n, 3) of a part of a surface, the one in the middle, then each the farthest from those before.

    beyond  (m, 3), points of the surface that are not of the part: the places are at least a third as far from them as the
            innermost point is. None where the part has no edge.
    """
    inner = np.arange(len(points))
    if len(beyond):
        from_edge = np.asarray(cKDTree(beyond).query(points)[0])
        inner = np.flatnonzero(from_edge >= _INSIDE * from_edge.max())
    candidates = points[inner]
    chosen = [int(np.argmin(np.linalg.norm(candidates - points.mean(axis=0), axis=1)))]
    while len(chosen) < count:
        nearest, _ = cKDTree(candidates[chosen]).query(candidates)
        chosen.append(int(np.argmax(nearest)))
    return inner[chosen]
