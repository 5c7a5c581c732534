"""Nodes spread over a curve, a surface or a body at a spacing that may vary from place to place."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from palpate.geometry.sampling import Samples
from palpate.geometry.spacing import SpacingField
from palpate.geometry.tributary import nearest_node
from palpate.geometry.visibility import Gaps

Array = NDArray[np.float64]

_DISC = {1: 0.75, 2: 0.81, 3: 0.86}
"""Distance over spacing at which points dropped at random until none fits have 1 node per spacing^dimension."""

_RELAXATIONS = 12


@dataclass(frozen=True)
class Placement:
    """What decides where nodes are placed.

    field  the spacing of the nodes, m, (n,) at points (n, 3)
    gaps   across which nodes do not see each other
    rng    of the random order in which nodes are placed
    """

    field: SpacingField
    gaps: Gaps
    rng: np.random.Generator

    def place(
        self,
        fixed: Array,
        samples: Samples,
        dimension: int,
        project: Callable[[Array], Array],
        room: NDArray[np.bool_] | None = None,
    ) -> Array:
        """The fixed nodes and, after them, new ones spread among the samples (those with room, if given) and relaxed.

        project  from points (n, 3), m, to the nearest of the curve, surface or body of the given dimension
        """
        candidates = samples.points if room is None else samples.points[room]
        free = self.spread(candidates, fixed, dimension)
        sight = self.gaps.sight(samples.points)
        weights = samples.measures / samples.spacing ** (dimension + 2)
        for _ in range(_RELAXATIONS):
            nodes = np.vstack([fixed, free])
            owner = nearest_node(nodes, samples.points, sight)
            mass = np.bincount(owner, weights, minlength=len(nodes))[len(fixed) :]
            moment = np.column_stack(
                [
                    np.bincount(owner, weights * x, minlength=len(nodes))[len(fixed) :]
                    for x in samples.points.T
                ]
            )
            centroids = moment / np.where(mass > 0, mass, 1.0)[:, None]
            free = project(np.where(mass[:, None] > 0, centroids, free))
        return np.vstack([fixed, free])

    def spread(self, candidates: Array, fixed: Array, dimension: int) -> Array:
        """The candidates in random order, less those within the disc of a fixed node or of one taken before, (n, 3).

        A disc ends at a gap.
        """
        if not len(candidates):
            return candidates
        tree = cKDTree(candidates)
        points = np.vstack([candidates, fixed])
        beside, eyes = self.gaps.beside(points), self.gaps.eyes(points)
        radii = _DISC[dimension] * self.field(points)
        alive = np.ones(len(candidates), dtype=bool)

        def clear_disc(i: int) -> None:
            near = np.array(tree.query_ball_point(points[i], radii[i]), dtype=np.intp)
            if beside[i]:
                near = near[~self.gaps.hidden(np.tile(eyes[i], (len(near), 1)), eyes[near])]
            alive[near] = False

        for i in range(len(candidates), len(points)):
            clear_disc(i)
        taken = []
        for i in self.rng.permutation(len(candidates)):
            if alive[i]:
                taken.append(i)
                clear_disc(i)
                alive[i] = False
        return candidates[taken]
