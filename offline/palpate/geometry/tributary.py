"""The length, area or volume each node stands for, by handing out a fine sampling of the body to the nearest node."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from palpate.geometry.visibility import Sight

Array = NDArray[np.float64]

_CANDIDATES = 16
"""Next to a gap, so many of the nearest nodes are asked whether they are in sight."""


def nearest_node(nodes: Array, samples: Array, sight: Sight | None = None) -> NDArray[np.intp]:
    """Index of the node nearest to each sample, (n_samples,); nodes (n_nodes, 3) and samples (n_samples, 3) in m.

    With the samples' sight, next to gaps it is the nearest of the nodes that the sample sees inside the body. A node that
    is nearest to none gets the sample nearest to it, so that it has a share wherever it lies; should two such nodes want
    the same sample, one of them stays without.
    """
    tree = cKDTree(nodes)
    owner = np.asarray(tree.query(samples, workers=-1)[1])
    if sight is not None and len(sight.beside):
        owner[sight.beside] = _nearest_in_sight(nodes, tree, owner[sight.beside], samples, sight)
    empty = np.flatnonzero(np.bincount(owner, minlength=len(nodes)) == 0)
    if len(empty):
        _, own_sample = cKDTree(samples).query(nodes[empty])
        owner[own_sample] = empty
    return owner


def _nearest_in_sight(
    nodes: Array, tree: cKDTree, nearest: NDArray[np.intp], samples: Array, sight: Sight
) -> NDArray[np.intp]:
    """The nearest node in sight of each sample next to a gap; the very nearest, as given, where none of the next is."""
    places = sight.gaps.eyes(nodes)
    owner = nearest.copy()
    blind = np.flatnonzero(sight.gaps.hidden(sight.eyes, places[owner]))
    if not len(blind):
        return owner
    k = min(_CANDIDATES, len(nodes))
    _, candidates = tree.query(samples[sight.beside[blind]], k=k, workers=-1)
    next_ones = np.reshape(candidates, (-1, k))
    for column in range(1, k):
        seen = ~sight.gaps.hidden(sight.eyes[blind], places[next_ones[:, column]])
        owner[blind[seen]] = next_ones[seen, column]
        blind, next_ones = blind[~seen], next_ones[~seen]
    return owner


@dataclass(frozen=True)
class Cells:
    """The parts of a body that nodes stand for.

    volumes    (n_nodes,), m³; they sum to the body's volume
    centroids  (n_nodes, 3), m
    moments    (n_nodes, 3, 3), m²: the mean over the cell of (x - centroid) (x - centroid)^T
    """

    volumes: Array
    centroids: Array
    moments: Array


def tributary_cells(
    nodes: Array, samples: Array, weights: Array, total: float, sight: Sight | None = None
) -> Cells:
    """The Voronoi cells of the nodes within the sampled body. Arguments and errors as `tributary_measures`."""
    owner = nearest_node(nodes, samples, sight)
    shares = _shares(owner, nodes, weights)
    moment = [np.bincount(owner, weights * x, minlength=len(nodes)) for x in samples.T]
    centroids = np.column_stack(moment) / shares[:, None]
    away = samples - centroids[owner]
    moments = np.empty((len(nodes), 3, 3))
    for a, b in ((0, 0), (1, 1), (2, 2), (0, 1), (1, 2), (0, 2)):
        second = np.bincount(owner, weights * away[:, a] * away[:, b], minlength=len(nodes)) / shares
        moments[:, a, b] = moments[:, b, a] = second
    return Cells(shares * (total / shares.sum()), centroids, moments)


def tributary_measures(
    nodes: Array, samples: Array, weights: Array, total: float, sight: Sight | None = None
) -> Array:
    """Measure of each node's Voronoi cell within the sampled set, (n_nodes,), summing to `total`.

    nodes    (n_nodes, 3), m
    samples  (n_samples, 3), m, points of the body (or of its surface), fine compared with the nodes
    weights  (n_samples,), the volume (m³) or area (m²) each sample stands for
    total    exact measure of the whole, m³ or m²; the sums are scaled to it
    sight    of the samples: nothing is handed out across gaps

    Raises ValueError naming the first node without a share: the sampling is too coarse there.
    """
    shares = _shares(nearest_node(nodes, samples, sight), nodes, weights)
    return shares * (total / shares.sum())


def _shares(owner: NDArray[np.intp], nodes: Array, weights: Array) -> Array:
    """(n_nodes,): the sum of the samples' weights that each node owns. Raises ValueError naming the first without any."""
    shares = np.bincount(owner, weights.astype(np.float64), minlength=len(nodes)).astype(np.float64)
    empty = np.flatnonzero(shares <= 0)
    if len(empty):
        raise ValueError(
            f"{len(empty)} of {len(nodes)} nodes have no share of the body, the first is node {empty[0]} at "
            f"{nodes[empty[0]].tolist()} m: expected nodes further apart, or a body that is thicker there"
        )
    return shares
