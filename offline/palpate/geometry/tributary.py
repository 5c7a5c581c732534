"""The volume or area each node stands for, by handing out a fine sampling of the body to the nearest node."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

Array = NDArray[np.float64]


def tributary_measures(nodes: Array, samples: Array, weights: Array, total: float) -> Array:
    """Measure of each node's Voronoi cell within the sampled set, (n_nodes,), summing to `total`.

    nodes    (n_nodes, 3), m
    samples  (n_samples, 3), m, points of the body (or of its surface), fine compared with the nodes
    weights  (n_samples,), the volume (m³) or area (m²) each sample stands for
    total    exact measure of the whole, m³ or m²; the sums are scaled to it

    Raises ValueError naming the first node that no sample is nearest to: the sampling is too coarse there.
    """
    _, nearest = cKDTree(nodes).query(samples, workers=-1)
    measures = np.bincount(nearest, weights, minlength=len(nodes))
    empty = np.flatnonzero(measures == 0)
    if len(empty):
        raise ValueError(
            f"{len(empty)} of {len(nodes)} nodes got no share of the body, the first is node {empty[0]} at "
            f"{nodes[empty[0]].tolist()} m: expected a finer sampling, or nodes further apart"
        )
    return measures * (total / measures.sum())
