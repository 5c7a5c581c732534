"""Vectors that are orthonormal in the mass: the basis which Ritz modes and the lowest modes are computed in."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import qr, solve_triangular

from palpate.discretization.assembled_body import AssembledBody
from palpate.modes.held_body import Constraints

Array = NDArray[np.float64]

_DEFLATED = 1e-8
"""A vector of which orthogonalization leaves less than this fraction holds nothing new."""


class KrylovSpace:
    """Vectors V, parameters of fields that are zero at the held nodes, with Vᵀ M V = 1.

    M = Hᵀ m H is never formed: with Y = m^{1/2} H V, Vᵀ M V is Yᵀ Y.

    size          number of vectors
    coefficients  (size, k): what was appended last, in the vectors
    """

    def __init__(self, body: AssembledBody, constraints: Constraints, most: int) -> None:
        """Room for `most` vectors. Raises MemoryError where they do not fit."""
        self._body, self._constraints = body, constraints
        n_parameters = body.stiffness.shape[0]
        self._vectors = np.empty((n_parameters, most), order="F")
        self._weighted = np.empty((n_parameters, most), order="F")
        self._last_block = slice(0, 0)
        self.size = 0
        self.coefficients = np.zeros((0, 0))

    @property
    def vectors(self) -> Array:
        """(c n_nodes, size), V."""
        return self._vectors[:, : self.size]

    @property
    def last_block(self) -> Array:
        """(c n_nodes, k), the vectors that were appended last."""
        return self._vectors[:, self._last_block]

    def resume(self, vectors: Array, last: int) -> None:
        """Begin with the vectors (c n_nodes, k) that another space had, the last block of which had `last`."""
        self.size = vectors.shape[1]
        self._vectors[:, : self.size] = vectors
        self._weighted[:, : self.size] = self._weigh(vectors)
        self._last_block = slice(self.size - last, self.size)

    def append(self, fields: Array) -> bool:
        """Append a block that spans parameters (c n_nodes, k) beside the vectors before.

        False where they hold nothing new, or do not fit any more.
        """
        before, weighted_before = self.vectors, self._weighted[:, : self.size]
        weighted = self._weigh(fields)
        largest = np.linalg.norm(weighted, axis=0).max()
        count, new = 0, np.eye(fields.shape[1])
        coefficients = np.zeros((self.size, fields.shape[1]))
        for first in (True, False):  # the second time for what cancellation has left of orthogonality
            along = weighted_before.T @ weighted
            _, triangle, order = qr(weighted - weighted_before @ along, mode="economic", pivoting=True)
            if first:
                count = int(np.count_nonzero(np.abs(np.diagonal(triangle)) > _DEFLATED * largest))
                self.coefficients = along
                if count == 0 or self.size + count > self._vectors.shape[1]:
                    return False
            coefficients += along @ new
            new = triangle[:count, np.argsort(order)] @ new
            fields = (fields - before @ along)[:, order[:count]]
            # It has also left less of the constraints and of the link between V and Y: both are made exact again.
            fields = self._constraints.project(
                solve_triangular(triangle[:count, :count], fields.T, trans="T").T
            )
            weighted = self._weigh(fields)
        self._last_block = slice(self.size, self.size + count)
        self._vectors[:, self._last_block] = fields
        self._weighted[:, self._last_block] = weighted
        self.size += count
        self.coefficients = np.vstack([coefficients, new])
        return True

    def _weigh(self, fields: Array) -> Array:
        """m^{1/2} H V of parameters V (c n_nodes, k)."""
        body = self._body
        return np.repeat(np.sqrt(body.mass), body.n_components)[:, None] * body.basis.values(fields)
