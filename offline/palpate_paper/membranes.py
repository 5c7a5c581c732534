"""Node clouds of flat membranes with a held edge: a disc in rings, a square on a lattice."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from palpate.geometry.tributary import tributary_measures

Array = NDArray[np.float64]

_SAMPLES_A_SPACING = 8


@dataclass(frozen=True)
class Membrane:
    """Nodes that fill a flat region, its edge included.

    points   (n_nodes, 2), m
    areas    (n_nodes,), m²; they sum to the region's area
    edge     (n_nodes, 2), m: outward normal times the length of edge that the node stands for; zero inside
    spacing  (n_nodes,), m; local distance between neighboring nodes
    """

    points: Array
    areas: Array
    edge: Array
    spacing: Array

    @property
    def n_nodes(self) -> int:
        return len(self.points)

    @property
    def on_edge(self) -> NDArray[np.intp]:
        """(n_edge,), indices of the nodes on the edge."""
        return np.flatnonzero(np.any(self.edge != 0, axis=1))


def disc_membrane(n_nodes: int, radius_m: float = 1.0) -> Membrane:
    """Disc with a node at its center and equally spaced nodes on rings about one spacing apart.

    Ring k has about 2 pi k nodes, so that the spacing is the same everywhere (rings of equally many nodes crowd at the
    center, and collocation fails there). Raises ValueError below 19 nodes (center and two rings).
    """
    if n_nodes < 19:
        raise ValueError(f"n_nodes = {n_nodes}: expected at least 19")
    n_rings = round((-1 + np.sqrt(1 + 4 * (n_nodes - 1) / np.pi)) / 2)
    k = np.arange(1, n_rings + 1)
    ends = np.round((n_nodes - 1) * np.cumsum(k) / k.sum()).astype(int)
    counts = np.diff(ends, prepend=0)
    angles = [2 * np.pi * (np.arange(n) + 0.5 * (i % 2)) / n for i, n in enumerate(counts)]
    rings = [r * np.column_stack([np.cos(t), np.sin(t)]) for r, t in zip(k / n_rings, angles, strict=True)]
    points = radius_m * np.vstack([np.zeros((1, 2)), *rings])
    outer = np.arange(n_nodes) >= n_nodes - counts[-1]

    fine = _SAMPLES_A_SPACING * n_rings
    r, t = np.meshgrid((np.arange(fine) + 0.5) / fine, 2 * np.pi * (np.arange(7 * fine) + 0.5) / (7 * fine))
    samples = radius_m * np.column_stack([(r * np.cos(t)).ravel(), (r * np.sin(t)).ravel()])
    edge = np.where(outer[:, None], points * (2 * np.pi / counts[-1]), 0.0)
    return Membrane(
        points=points,
        areas=tributary_measures(points, samples, r.ravel(), np.pi * radius_m**2),
        edge=edge,
        spacing=np.full(n_nodes, radius_m / n_rings),
    )


def square_membrane(n_nodes: int, side_m: float = 1.0) -> Membrane:
    """Square [0, side]²: a square lattice inside and the rest of the nodes equally spaced along the edge.

    A perfect square makes one lattice of all; 200 nodes make 12 x 12 inside and 14 intervals a side. The areas are
    those of the points nearest to the node.

    Raises ValueError when n_nodes is below 16, or neither a multiple of 4 nor one more.
    """
    if n_nodes < 16 or n_nodes % 4 > 1:
        raise ValueError(
            f"n_nodes = {n_nodes}: expected at least 16, and a multiple of 4 or one more (an inner lattice of "
            "k x k nodes, and as many on each side)"
        )
    inner = min(range(n_nodes % 2, n_nodes, 2), key=lambda k: abs((k + 2) ** 2 - n_nodes))
    intervals = (n_nodes - inner**2) // 4
    lattice = np.arange(1, inner + 1) / (inner + 1)
    x, y = np.meshgrid(lattice, lattice, indexing="ij")
    along = np.arange(intervals) / intervals
    zero, one = np.zeros(intervals), np.ones(intervals)
    sides = ((along, zero), (one, along), (1 - along, one), (zero, 1 - along))
    points = np.vstack([np.column_stack([x.ravel(), y.ravel()]), *map(np.column_stack, sides)])

    fine = 2 * _SAMPLES_A_SPACING * (inner + 1)
    u, v = np.meshgrid(*[(np.arange(fine) + 0.5) / fine] * 2)
    samples = np.column_stack([u.ravel(), v.ravel()])
    return Membrane(
        points=side_m * points,
        areas=tributary_measures(points, samples, np.ones(len(samples)), side_m**2),
        edge=side_m * _square_edge(points, intervals),
        spacing=np.full(n_nodes, side_m / (inner + 1)),
    )


def _square_edge(points: Array, intervals: int) -> Array:
    """(n, 2): outward normal times tributary length of the nodes on the edge of the unit square."""
    edge = np.zeros_like(points)
    for axis in range(2):
        along = points[:, 1 - axis]
        length = np.where((along == 0) | (along == 1), 0.5, 1.0) / intervals
        edge[:, axis] = length * ((points[:, axis] == 1).astype(float) - (points[:, axis] == 0))
    return edge
