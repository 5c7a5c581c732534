"""Derivatives of the meshfree field in terms of its nodal values instead of its parameters."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import lu_factor, lu_solve
from scipy.sparse import csr_array

from palpate.geometry.cloud import NodeCloud
from palpate.meshfree import ShapeFunctions, shape_functions


def nodal_shape_functions(cloud: NodeCloud, support_radius_factor: float, derivatives: int) -> ShapeFunctions:
    """The linear shape functions of all nodes at all nodes; node J's support radius is the factor times its spacing.

    Raises ValueError when the factor is not above 1, SupportError when a support is too small.
    """
    if not (np.isfinite(support_radius_factor) and support_radius_factor > 1):
        raise ValueError(f"support_radius_factor = {support_radius_factor}: expected a number above 1")
    radii = support_radius_factor * cloud.spacing
    return shape_functions(cloud.points, cloud.points, radii, order=1, derivatives=derivatives)


class NodalValues:
    """The map U = H⁻¹ u from nodal values to the parameters of the shape functions, which do not interpolate.

    In nodal values a prescribed displacement is a row, and the mass is diagonal. H is (n_nodes, n_nodes), well
    conditioned, and factorized once.
    """

    def __init__(self, value: csr_array) -> None:
        self._factor = lu_factor(value.toarray(order="F"), overwrite_a=True, check_finite=False)

    def operator(self, matrix: csr_array) -> NDArray[np.float64]:
        """(rows, n_nodes): A H⁻¹ for a sparse A (rows, n_nodes) that acts on parameters."""
        return lu_solve(
            self._factor, matrix.T.toarray(order="F"), trans=1, overwrite_b=True, check_finite=False
        ).T

    def vector_operator(self, matrix: csr_array) -> NDArray[np.float64]:
        """(rows, 3 n_nodes): the same for a sparse A (rows, 3 n_nodes) that acts on x, y, z of node 0, then of node 1, ..."""
        rows = np.empty(matrix.shape)
        for component in range(3):
            rows[:, component::3] = self.operator(matrix[:, component::3])
        return rows
