"""The length, area or volume each node stands for, by handing out a fine sampling of the body to the nearest node."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from palpate.geometry.visibility import Sight

Array = NDArray[np.float64]

Indices = NDArray[np.intp]

_CANDIDATES = 16
"""Next to a gap, so many of the nearest nodes are asked whether they are in sight."""

_NEIGHBORS = 24
"""Of each node, so many of the nearest others are known where a sample's nearest node is looked for."""


def nearest_node(nodes: Array, samples: Array, sight: Sight | None = None) -> NDArray[np.intp]:
    """Index of the node nearest to each sample, (n_samples,); nodes (n_nodes, dim) and samples (n_samples, dim) in m.

    With the samples' sight, next to gaps it is the nearest of the nodes that the sample sees inside the body. A node that
    is nearest to none gets the sample nearest to it, so that it has a share wherever it lies; should two such nodes want
    the same sample, one of them stays without.
    """
    tree = cKDTree(nodes)
    owner = _nearest(nodes, tree, samples) if nodes.shape[1] == 3 else np.asarray(tree.query(samples)[1])
    if sight is not None and len(sight.beside):
        owner[sight.beside] = _nearest_in_sight(nodes, tree, owner[sight.beside], samples, sight)
    empty = np.flatnonzero(np.bincount(owner, minlength=len(nodes)) == 0)
    if len(empty):
        _, own_sample = cKDTree(samples).query(nodes[empty])
        owner[own_sample] = empty
    return owner


def _nearest(nodes: Array, tree: cKDTree, samples: Array) -> Indices:
    """(n_samples,): the nearest node, the first of equally near ones.

    Ten times as fast as asking the tree for every sample: the walk of `_walk` begins at the node nearest to the middle
    of a grid's cell. The tree is asked where a walk is lost, which happens in clouds whose spacing changes abruptly.
    """
    low, extent = nodes.min(axis=0), np.ptp(nodes, axis=0)
    size = float(np.cbrt(np.prod(np.maximum(extent, extent.max() / 1000)) / len(nodes))) or 1.0
    shape = (extent / size).astype(np.int64) + 1
    middles = low + (np.indices(tuple(shape)).reshape(3, -1).T + 0.5) * size
    starts = np.asarray(tree.query(middles)[1])
    k = min(_NEIGHBORS + 1, len(nodes))
    distances, neighbors = (np.reshape(a, (-1, k))[:, 1:] for a in tree.query(nodes, k=k))
    complete = k == len(nodes)
    owner = _walk(samples, nodes, neighbors, distances, complete, starts, low, size, shape)
    lost = np.flatnonzero(owner < 0)
    if len(lost):
        owner[lost] = tree.query(samples[lost])[1]
    return owner


@njit(cache=True)
def _walk(
    samples: Array,
    nodes: Array,
    neighbors: Indices,
    distances: Array,
    complete: bool,
    starts: Indices,
    low: Array,
    size: float,
    shape: NDArray[np.int64],
) -> Indices:
    """(n_samples,): the node nearest to each sample, by steps from node to neighbor; -1 where it can't be told.

    neighbors, distances (n_nodes, k): of each node the nearest others in ascending distance, m; complete if these are all.
    A node nearer to a sample than the one at distance d is within 2 d of that one. So the walk has arrived where none of
    the neighbors within 2 d is nearer, and is lost where the known neighbors end before.
    """
    owner = np.empty(len(samples), np.intp)
    for i in range(len(samples)):
        x, y, z = samples[i, 0], samples[i, 1], samples[i, 2]
        cell = 0
        for axis in range(3):
            along = int((samples[i, axis] - low[axis]) / size)
            cell = cell * shape[axis] + min(max(along, 0), shape[axis] - 1)
        at = starts[cell]
        nearest = (x - nodes[at, 0]) ** 2 + (y - nodes[at, 1]) ** 2 + (z - nodes[at, 2]) ** 2
        walking = True
        while walking:
            walking = False
            known = complete
            reach = 2 * np.sqrt(nearest) * (1 + 1e-9)
            for k in range(neighbors.shape[1]):
                if distances[at, k] > reach:
                    known = True
                    break
                j = neighbors[at, k]
                square = (x - nodes[j, 0]) ** 2 + (y - nodes[j, 1]) ** 2 + (z - nodes[j, 2]) ** 2
                if square < nearest or (square == nearest and j < at):
                    at, nearest, walking = j, square, True
                    break
        owner[i] = at if known else -1
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
    first, second = _moments(owner, nodes, samples, weights)
    away = first / shares[:, None]
    moments = second / shares[:, None, None] - away[:, :, None] * away[:, None, :]
    return Cells(shares * (total / shares.sum()), nodes + away, moments)


@njit(cache=True)
def _moments(owner: Indices, nodes: Array, samples: Array, weights: Array) -> tuple[Array, Array]:
    """(n_nodes, 3) and (n_nodes, 3, 3): the sums of w x and w x x^T over a node's samples, x from the node."""
    first, second = np.zeros((len(nodes), 3)), np.zeros((len(nodes), 3, 3))
    for i in range(len(samples)):
        o = owner[i]
        for a in range(3):
            moment = weights[i] * (samples[i, a] - nodes[o, a])
            first[o, a] += moment
            for b in range(3):
                second[o, a, b] += moment * (samples[i, b] - nodes[o, b])
    return first, second


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
