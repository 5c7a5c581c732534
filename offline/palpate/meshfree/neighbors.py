"""Which nodes' supports cover which points, within the body."""

from __future__ import annotations

from itertools import chain

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.spatial import cKDTree

from palpate.geometry.visibility import Gaps

Array = NDArray[np.float64]
Pattern = tuple[NDArray[np.int32], NDArray[np.int32]]

_INSET = 1 / 8
"""Depth to which points are moved before they look, over the support radius: about `visibility.INSET` of a spacing."""


def covering_nodes(points: Array, nodes: Array, radii: Array) -> Pattern:
    """CSR pattern (indptr (n_points + 1,), indices (nnz,)) of the nodes J with |x_i - x_J| <= r_J for every point i.

    points (n_points, dim), nodes (n_nodes, dim), radii (n_nodes,), m. The radius belongs to the node, so the search
    asks each node for its points and transposes.
    """
    covered = cKDTree(points).query_ball_point(nodes, radii, workers=-1)
    counts = np.fromiter(map(len, covered), dtype=np.int64, count=len(nodes))
    by_node = np.fromiter(chain.from_iterable(covered), dtype=np.int32, count=int(counts.sum()))
    starts = np.concatenate([[0], np.cumsum(counts)]).astype(np.int32)
    pattern = csr_array((np.ones(len(by_node), np.int8), by_node, starts), shape=(len(nodes), len(points)))
    transposed = pattern.T.tocsr()
    return transposed.indptr.astype(np.int32), transposed.indices.astype(np.int32)


def covering_nodes_inside(points: Array, nodes: Array, radii: Array, gaps: Gaps) -> tuple[Pattern, Array]:
    """The pattern of the nodes J whose supports cover point i along a path in the body, and each pair's radius (nnz,), m.

    Where the straight line leaves the body, the path is the shortest over one other node. The pair is dropped when the
    path is longer than r_J; else its radius is r_J |x_i - x_J| / path, so that its weight is that of the path (the
    diffraction method of Organ et al. 1996). All in m: points (n_points, 3), nodes (n_nodes, 3), radii (n_nodes,).
    """
    seen_nodes = gaps.inset(nodes, _INSET * radii)
    between = _distances_in_sight(nodes, seen_nodes, nodes, seen_nodes, radii, gaps)
    if points is nodes:
        pattern, distance = between
    else:
        _, nearest = cKDTree(nodes).query(points, workers=-1)
        eyes = gaps.inset(points, _INSET * radii[nearest])
        pattern, distance = _distances_in_sight(points, eyes, nodes, seen_nodes, radii, gaps)
    indptr, indices = pattern
    (node_indptr, node_indices), node_distance = between
    path = _paths(indptr, indices, distance, node_indptr, node_indices, node_distance)

    kept = np.isfinite(distance) | (path <= radii[indices])
    counts = np.concatenate([[0], np.cumsum(kept)])
    point = np.repeat(np.arange(len(points)), np.diff(indptr))[kept]
    straight = np.linalg.norm(points[point] - nodes[indices[kept]], axis=1)
    shortened = np.divide(straight, path[kept], out=np.ones(len(straight)), where=np.isinf(distance[kept]))
    return (counts[indptr].astype(np.int32), indices[kept]), radii[indices[kept]] * shortened


def _distances_in_sight(
    points: Array, eyes: Array, nodes: Array, seen_nodes: Array, radii: Array, gaps: Gaps
) -> tuple[Pattern, Array]:
    """The pattern of `covering_nodes` with indices ascending, and the distances (nnz,), m; inf where the pair is hidden.

    eyes and seen_nodes are the points and nodes moved inside the body, from where they look.
    """
    indptr, indices = covering_nodes(points, nodes, radii)
    point = np.repeat(np.arange(len(points)), np.diff(indptr))
    distance = np.linalg.norm(points[point] - nodes[indices], axis=1)
    distance[gaps.hidden(eyes[point], seen_nodes[indices])] = np.inf
    return (indptr, indices), distance


@njit(cache=True)
def _paths(
    indptr: NDArray[np.int32],
    indices: NDArray[np.int32],
    distance: Array,
    node_indptr: NDArray[np.int32],
    node_indices: NDArray[np.int32],
    node_distance: Array,
) -> Array:
    """The distances (nnz,), where they are inf the shortest by way of one other node in sight of both, m."""
    path = distance.copy()
    for i in range(len(indptr) - 1):
        for hidden in range(indptr[i], indptr[i + 1]):
            if not np.isinf(distance[hidden]):
                continue
            target = indices[hidden]
            for step in range(indptr[i], indptr[i + 1]):
                if distance[step] >= path[hidden]:
                    continue
                way = indices[step]
                row = node_indices[node_indptr[way] : node_indptr[way + 1]]
                k = np.searchsorted(row, target)
                if k < len(row) and row[k] == target:
                    path[hidden] = min(path[hidden], distance[step] + node_distance[node_indptr[way] + k])
    return path
