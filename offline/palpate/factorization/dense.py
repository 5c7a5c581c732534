"""Cholesky's factorization of the dense matrix by LAPACK: for some thousands of right-hand sides faster than SuperLU."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cholesky
from scipy.linalg.lapack import dpotrs
from scipy.sparse import csr_array

Array = NDArray[np.float64]


class DenseCholesky:
    """The factor of a symmetric positive definite matrix. Raises LinAlgError where it is not definite.

    nnz         entries of the factor
    n_negative  negative eigenvalues of the matrix: none
    """

    n_negative = 0

    def __init__(self, matrix: csr_array) -> None:
        n = matrix.shape[0]
        self.nnz = n * (n + 1) // 2
        self._factor = cholesky(matrix.toarray(order="F"), overwrite_a=True, check_finite=False)

    def solve(self, right: Array) -> Array:
        """(n, k) for right-hand sides (n, k)."""
        solution, info = dpotrs(self._factor, right)
        if info != 0:
            raise np.linalg.LinAlgError(f"LAPACK's dpotrs refuses its argument {-info}")
        return solution


def dense_memory(n_rows: int) -> float:
    """Bytes of the factor."""
    return 8.0 * n_rows**2
