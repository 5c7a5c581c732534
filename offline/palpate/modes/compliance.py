"""Static compliance of a held body between points of its surface."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array, eye_array, kron

from palpate.modes.held_body import HeldBody

Array = NDArray[np.float64]

BLOCK = 96
"""Loads that are solved for at once."""


def static_compliance(held: HeldBody, points: Array) -> Array:
    """(3 n_points, 3 n_points), m/N: displacements at points (n_points, 3), m, under unit forces at them; symmetric.

    Raises SupportError where a point is outside the body, as `HeldBody.solve` otherwise.
    """
    c = held.body.n_components
    at_points = csr_array(kron(held.body.basis.at(points), eye_array(c), format="csr"))
    size = at_points.shape[0]
    compliance = np.empty((size, size))
    for start in range(0, size, BLOCK):
        loads = at_points[start : start + BLOCK].T.toarray()
        compliance[:, start : start + BLOCK] = at_points @ held.solve(loads)
    return (compliance + compliance.T) / 2
