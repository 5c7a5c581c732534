"""Which nodes' supports cover which points."""

from __future__ import annotations

from itertools import chain

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.spatial import cKDTree


def covering_nodes(
    points: NDArray[np.float64], nodes: NDArray[np.float64], radii: NDArray[np.float64]
) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
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
