"""The shape functions of a node cloud, and the step from their parameters to nodal values."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_array, csr_array
from scipy.sparse.linalg import gmres

from palpate.geometry.visibility import Gaps
from palpate.meshfree import ShapeFunctions, shape_functions

Array = NDArray[np.float64]
RealOrComplex = NDArray[Any]

SUPPORT_RADIUS_FACTOR = 2.2
"""Support radius over node spacing. By `collocation` the paper's cube is stable here, and not at 2.0, 2.4 or 2.6 for some
layouts; by `conservative` 1.8 is a little better on lattices and 2.6 worse on scattered nodes."""

_EXACT, _RESTART, _RESTARTS = 1e-15, 150, 20
"""Residual, relative, at which the iteration for the parameters ends; its Krylov vectors; and how often it begins again. The
liver's 15,364 nodes take 290 vectors, a second."""


@dataclass(frozen=True)
class NodalBasis:
    """The map u = H U from the parameters of the shape functions, which do not interpolate, to nodal values.

    points  (n_nodes, dim), m
    radii   (n_nodes,), m, support radii
    value   (n_nodes, n_nodes), H: h_J(x_I), well conditioned
    gaps    of the body, across which no support reaches
    """

    points: Array
    radii: Array
    value: csr_array
    gaps: Gaps | None = None

    def values(self, parameters: RealOrComplex) -> RealOrComplex:
        """(c n_nodes, k): nodal values of fields (c n_nodes, k) given by their parameters, c components a node."""
        return _on_each_component(self.value, parameters)

    def loads(self, forces: Array) -> Array:
        """(c n_nodes, k): Hᵀ f, the loads on the parameters that forces (c n_nodes, k) on the nodes are, N."""
        return _on_each_component(self.value.T, forces)

    def parameters(self, values: Array) -> Array:
        """(n_nodes, k): the parameters of fields (n_nodes, k) given by their nodal values, of one component.

        By iteration, because a factor of H takes more memory than the stiffness matrix. Raises LinAlgError where the iteration
        does not converge to round-off.
        """
        return np.column_stack([self._parameters(field) for field in np.asarray(values, np.float64).T])

    def _parameters(self, values: Array) -> Array:
        """(n_nodes,), from (n_nodes,)."""
        found, _ = gmres(self.value, values, rtol=_EXACT, atol=0.0, restart=_RESTART, maxiter=_RESTARTS)
        error = np.linalg.norm(values - self.value @ found)
        if not error <= 100 * _EXACT * np.linalg.norm(values):
            raise np.linalg.LinAlgError(
                f"the parameters of a nodal field are wrong by {error / np.linalg.norm(values):.1e} of it after "
                f"{_RESTART * _RESTARTS} iterations, expected {_EXACT:.0e}: the shape functions of some nodes are nearly the same"
            )
        return np.asarray(found)

    def at(self, points: Array) -> csr_array:
        """(n_points, n_nodes): the field at the points (n_points, dim), m, from its parameters.

        Raises SupportError naming the first point that too few nodes cover.
        """
        return shape_functions(points, self.points, self.radii, gaps=self.gaps).value

    def values_at(self, points: Array, parameters: RealOrComplex) -> RealOrComplex:
        """(c n_points, k): fields (c n_nodes, k) given by their parameters, at the points. Raises as `at`."""
        return _on_each_component(self.at(points), parameters)


def _on_each_component(operator: csr_array | csc_array, parameters: RealOrComplex) -> RealOrComplex:
    """(c n_rows, k): the operator (n_rows, n_nodes) on each component of fields (c n_nodes, k)."""
    n_rows, n_nodes = operator.shape
    by_node = parameters.reshape(n_nodes, -1)
    return (operator @ by_node).reshape(n_rows * len(parameters) // n_nodes, -1)


def nodal_basis(
    points: Array, spacing: Array, support_radius_factor: float, derivatives: int, gaps: Gaps | None = None
) -> tuple[NodalBasis, ShapeFunctions]:
    """The linear shape functions of all nodes, and their derivatives up to the given one, at all nodes.

    The support radius of a node is the factor times its spacing (n_nodes,), m. Raises ValueError when the factor is not
    above 1, SupportError when a support holds too few nodes.
    """
    if not (np.isfinite(support_radius_factor) and support_radius_factor > 1):
        raise ValueError(f"support_radius_factor = {support_radius_factor}: expected a number above 1")
    radii = support_radius_factor * spacing
    h = shape_functions(points, points, radii, order=1, derivatives=derivatives, gaps=gaps)
    return NodalBasis(points, radii, h.value, gaps), h
