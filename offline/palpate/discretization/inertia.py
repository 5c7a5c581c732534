"""The volumes whose masses the nodes carry, so that the kinetic energy is right to second order in the spacing.

With the cells' own volumes the kinetic energy is the trapezoidal rule of |v|², which exceeds the integral by h²/12 times its
normal derivative over the surface. By the midpoint rule, with the velocities at the centroids of the cells, it would fall
short by half as much, so a third of the one and two thirds of the other are right: Simpson's rule. To keep each mass at a
node, the two thirds are not taken at the centroid: a part of the cell's volume goes to the nodes on that side, which moves
its mean by two thirds of the way to the centroid. On a lattice with its nearest neighbors these are the weights 5/12, 13/12,
1, 1, ... of Gregory's rule.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from palpate.discretization.nodal import NodalBasis
from palpate.geometry.cloud import NodeCloud
from palpate.meshfree.kernel import quartic_spline

Array = NDArray[np.float64]

_SHARE = 2 / 3
"""Of the way from a node to the centroid of its cell."""


def inertial_volumes(cloud: NodeCloud, basis: NodalBasis) -> Array:
    """(n_nodes,), m³, positive; they sum to the body's volume."""
    node = np.repeat(np.arange(cloud.n_nodes), np.diff(basis.value.indptr))
    other = basis.value.indices
    way = cloud.centroids - cloud.points
    offset = cloud.points[other] - cloud.points[node]
    ahead = np.maximum(np.einsum("ja,ja->j", offset, way[node]), 0.0)
    distance = np.linalg.norm(offset, axis=1) / basis.radii[other]
    weight = ahead * quartic_spline(np.minimum(distance, 1.0))

    def summed(values: Array) -> Array:
        return np.asarray(np.bincount(node, values, minlength=cloud.n_nodes), dtype=np.float64)

    # The mean of the nodes ahead lies summed(weight * ahead) / summed(weight) / |way| along the way.
    lever, total = summed(weight * ahead), summed(weight)
    scale = np.divide(
        _SHARE * cloud.volumes * np.sum(way**2, axis=1), lever, out=np.zeros(cloud.n_nodes), where=lever > 0
    )
    # A cell never gives more than half of what it has: positive masses keep the body stable.
    scale = np.minimum(
        scale, np.divide(cloud.volumes / 2, total, out=np.zeros(cloud.n_nodes), where=total > 0)
    )
    given = scale[node] * weight
    return cloud.volumes - summed(given) + np.bincount(other, given, minlength=cloud.n_nodes)
