"""The length, area or volume each node stands for, by handing out a fine sampling of the body to the nearest node."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

Array = NDArray[np.float64]


def nearest_node(nodes: Array, samples: Array) -> NDArray[np.intp]:
    """Index of the node nearest to each sample, (n_samples,); nodes (n_nodes, 3) and samples (n_samples, 3) in m.

    A node that is nearest to none gets the sample nearest to it, so that it has a share wherever it lies; should
    two such nodes want the same sample, one of them stays without.
    """
    owner = np.asarray(cKDTree(nodes).query(samples, workers=-1)[1])
    empty = np.flatnonzero(np.bincount(owner, minlength=len(nodes)) == 0)
    if len(empty):
        _, own_sample = cKDTree(samples).query(nodes[empty])
        owner[own_sample] = empty
    return owner


def tributary_measures(nodes: Array, samples: Array, weights: Array, total: float) -> Array:
    """Measure of each node's Voronoi cell within the sampled set, (n_nodes,), summing to `total`.

    nodes    (n_nodes, 3), m
    samples  (n_samples, 3), m, points of the body (or of its surface), fine compared with the nodes
    weights  (n_samples,), the volume (m³) or area (m²) each sample stands for
    total    exact measure of the whole, m³ or m²; the sums are scaled to it

    Raises ValueError naming the first node without a share: the sampling is too coarse there.
    """
    measures = np.bincount(nearest_node(nodes, samples), weights, minlength=len(nodes))
    empty = np.flatnonzero(measures <= 0)
    if len(empty):
        raise ValueError(
            f"{len(empty)} of {len(nodes)} nodes have no share of the body, the first is node {empty[0]} at "
            f"{nodes[empty[0]].tolist()} m: expected nodes further apart, or a body that is thicker there"
        )
    return measures * (total / measures.sum())
