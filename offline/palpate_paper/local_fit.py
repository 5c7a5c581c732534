"""The Laplacian from a local quadratic fit around every node, the weight centered there and frozen.

Cheaper and more stable than the full second derivatives of the shape functions: no derivative of the weight enters, and
nodal values are used as they are. (Generalised finite differences; "diffuse" derivatives of moving least squares.)
"""

from __future__ import annotations

from itertools import chain

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.spatial import cKDTree

from palpate.meshfree.kernel import quartic_spline
from palpate.meshfree.shape_functions import SMALLEST_PIVOT, SupportError

NEIGHBOURS = 12
"""With 12, rings and lattices have nearly real spectra; with 15 and more, complex pairs that grow appear."""

REACH = 1.05
"""Support radius over the distance to the last of the neighbors."""


def local_fit_laplacian(points: NDArray[np.float64]) -> csr_array:
    """(n_nodes, n_nodes), 1/m²: the Laplacian at the nodes of a plane cloud (n_nodes, 2), m, from the nodal values.

    Exact for quadratics. Raises SupportError naming the node where the neighbors don't determine a quadratic.
    """
    n = len(points)
    tree = cKDTree(points)
    distance, _ = tree.query(points, k=[NEIGHBOURS + 1])
    radius = REACH * np.ravel(distance)
    near = tree.query_ball_point(points, radius, return_sorted=True)
    counts = np.fromiter(map(len, near), dtype=np.int64, count=n)
    node = np.repeat(np.arange(n), counts)
    other = np.fromiter(chain.from_iterable(near), dtype=np.int64, count=int(counts.sum()))
    offset = (points[other] - points[node]) / radius[node, None]
    weight = quartic_spline(np.linalg.norm(offset, axis=1))
    x, y = offset.T
    basis = np.column_stack([np.ones_like(x), x, y, x * x, y * y, x * y])
    moments = np.zeros((n, 6, 6))
    np.add.at(moments, node, (weight[:, None] * basis)[:, :, None] * basis[:, None, :])
    eigenvalues = np.linalg.eigvalsh(moments)
    bad = np.flatnonzero(eigenvalues[:, 0] < SMALLEST_PIVOT * eigenvalues[:, -1])
    if len(bad):
        raise SupportError(
            f"the {counts[bad[0]]} nodes around node {bad[0]} at {points[bad[0]].tolist()} don't determine a quadratic "
            f"({len(bad)} such nodes in all): expected nodes spread evenly in all directions"
        )
    # The fitted quadratic's Laplacian: twice the coefficients of x² and y².
    target = np.zeros((n, 6, 1))
    target[:, 3:5] = 2 / radius[:, None, None] ** 2
    coefficients = np.linalg.solve(moments, target)[:, :, 0]
    data = weight * np.sum(basis * coefficients[node], axis=1)
    return csr_array((data, (node, other)), shape=(n, n))
