"""The body held at some of its nodes, by one sparse factorization in the parameters of the shape functions.

Shape functions do not interpolate, so nodes are held by constraints C U = 0 on the parameters, C being their rows of H.
Two matrices serve them, both symmetric and sparse: K with a penalty, K + Cᵀ W C, which has the sparsity of K, and C Cᵀ.
With P = I - Cᵀ (C Cᵀ)⁻¹ C, the projection onto C U = 0, P (K + Cᵀ W C)⁻¹ P is the inverse of P K P up to the compliance of
the penalty, a few parts in a million. A solution that is corrected once more by its residual P (f - K U) is exact to
round-off, and so are the constraints always.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array, diags_array, eye_array, kron

from palpate.discretization.assembled_body import AssembledBody
from palpate.discretization.supports import Indices
from palpate.factorization import SymmetricFactor, factorize

Array = NDArray[np.float64]

PENALTY = 1e6
"""Stiffness of the penalty over that of a node: the supports give way by its inverse, the round-off grows with it."""

_ACCEPTED_RESIDUAL = 1e-6
_EXACT = 1e-12
_MOST_CORRECTIONS = 6


@dataclass(frozen=True)
class Constraints:
    """Some nodes are held: C U = 0.

    nodes   (n_held,), the held nodes
    matrix  (c n_held, c n_nodes), C: their values from the parameters
    gram    the factor of C Cᵀ of one component
    """

    nodes: Indices
    matrix: csr_array
    gram: SymmetricFactor

    @classmethod
    def of(cls, body: AssembledBody, nodes: Indices) -> Constraints:
        """Raises LinAlgError where the shape functions of two of the nodes are the same."""
        rows = body.basis.value[nodes]
        matrix = csr_array(kron(rows, eye_array(body.n_components), format="csr"))
        return cls(nodes, matrix, factorize(csr_array(rows @ rows.T), points=body.basis.points[nodes]))

    def project(self, parameters: Array) -> Array:
        """P U: the parameters (c n_nodes, k) nearest to the given ones that hold the nodes; also P f of loads."""
        held = self.matrix @ parameters
        multipliers = self.gram.solve(held.reshape(len(self.nodes), -1)).reshape(held.shape)
        return parameters - self.matrix.T @ multipliers


@dataclass(frozen=True)
class HeldBody:
    """A symmetric body with the values of some nodes held at zero.

    body         the nodes that are held here need not be those of body.supports
    constraints  of the held nodes
    factor       of K + Cᵀ W C
    """

    body: AssembledBody
    constraints: Constraints
    factor: SymmetricFactor

    @property
    def nodes(self) -> Indices:
        """(n_held,)"""
        return self.constraints.nodes

    def project(self, parameters: Array) -> Array:
        """As `Constraints.project`."""
        return self.constraints.project(parameters)

    def approximate(self, load: Array) -> Array:
        """P (K + Cᵀ W C)⁻¹ P load: symmetric, the constraints exact, the rest up to the compliance of the penalty."""
        return self.project(self.factor.solve(self.project(load)))

    def solve(self, load: Array) -> Array:
        """(c n_nodes, k): the parameters under loads (c n_nodes, k), N, which are conjugate to parameters.

        Corrected until the residual is 1e-12 of the load or no longer decreases. Raises LinAlgError where that leaves more than 1e-6 of the load.
        """
        load = self.project(load)
        solution = self.approximate(load)
        residual = self.project(load - self.body.stiffness @ solution)
        for _ in range(_MOST_CORRECTIONS):
            if np.linalg.norm(residual) <= _EXACT * np.linalg.norm(load):
                break
            corrected = solution + self.approximate(residual)
            left = self.project(load - self.body.stiffness @ corrected)
            if not np.linalg.norm(left) < 0.5 * np.linalg.norm(residual):
                break
            solution, residual = corrected, left
        error = float(np.linalg.norm(residual) / max(np.linalg.norm(load), np.finfo(float).tiny))
        if not error <= _ACCEPTED_RESIDUAL:
            raise np.linalg.LinAlgError(
                f"static solution: the residual is {error:.1e} of the load, expected at most {_ACCEPTED_RESIDUAL:.0e}: the "
                "held nodes do not keep the body from moving"
            )
        return solution


def hold(body: AssembledBody, nodes: Indices) -> HeldBody:
    """Factorize K with the nodes held.

    Raises ValueError for a body that is not symmetric; LinAlgError where the nodes do not hold the body or the shape
    functions of two held nodes are the same; MemoryError where the factor does not fit.
    """
    if not body.symmetric:
        raise ValueError("the body is not symmetric: expected one of the conservative discretization")
    factor = factorize(body.stiffness, penalty(body, nodes), points=body.basis.points)
    return HeldBody(body, Constraints.of(body, nodes), factor)


def penalty(body: AssembledBody, nodes: Indices) -> csr_array:
    """(c n_nodes, c n_nodes): Cᵀ W C, which is added to K; its entries are among those of K."""
    c, rows = body.n_components, body.basis.value[nodes]
    strongest = body.stiffness.diagonal().reshape(-1, c).max(axis=1)
    weights = diags_array(PENALTY * strongest[nodes])
    return csr_array(kron(rows.T @ (weights @ rows), eye_array(c), format="csr"))
