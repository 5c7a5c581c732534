"""One interface to the sparse direct solvers for symmetric matrices; every solution is checked."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from palpate.factorization import pardiso
from palpate.factorization.dense import DenseCholesky
from palpate.factorization.superlu import SuperLU

Array = NDArray[np.float64]

ACCEPTED_ERROR = 1e-10
"""Largest backward error |b - A x| / (|A| |x| + |b|) of a solution, in 1-norms: above it the solver has failed."""

DENSE_UP_TO = 15_000
"""Rows of a matrix, 1.8 GB when dense, up to which LAPACK replaces SuperLU for many right-hand sides."""

MANY = 1000
"""Right-hand sides from which it does: one costs SuperLU 0.05 s at 11,600 rows, LAPACK 0.01 s and the factor 15 s more."""

_REFINED_ABOVE = 1e-14
_MOST_REFINEMENTS = 3


class _Backend(Protocol):
    @property
    def nnz(self) -> int: ...

    @property
    def n_negative(self) -> int | None: ...

    def solve(self, right: Array, /) -> Array: ...


class SymmetricFactor:
    """A factorized symmetric matrix A.

    solver  name of the direct solver
    nnz     entries of the factor
    """

    def __init__(self, upper: csr_array, backend: _Backend, solver: str) -> None:
        self.solver = solver
        self.nnz = backend.nnz
        self._backend = backend
        self._upper = upper
        self._norm = float(np.max(_times(abs(upper), np.ones(upper.shape[0]))))

    @property
    def n_negative(self) -> int | None:
        """Number of negative eigenvalues of A, or None where the solver can't tell."""
        return self._backend.n_negative

    def solve(self, right: Array) -> Array:
        """A⁻¹ right, for (n,) or (n, k).

        A random combination of the columns is checked: an error in any column shows in it. Where its backward error is
        above round-off all columns are refined. Raises LinAlgError with the error where that does not help.
        """
        columns = right.reshape(len(right), -1)
        weights = np.random.default_rng(0).standard_normal(columns.shape[1])
        solution = self._backend.solve(columns)
        error = self._backward_error(columns @ weights, solution @ weights)
        for _ in range(_MOST_REFINEMENTS):
            if error <= _REFINED_ABOVE:
                break
            refined = solution + self._backend.solve(columns - _times(self._upper, solution))
            refined_error = self._backward_error(columns @ weights, refined @ weights)
            if not refined_error < error:
                break
            solution, error = refined, refined_error
        if not error <= ACCEPTED_ERROR:
            raise np.linalg.LinAlgError(
                f"{self.solver}: the backward error of a solution is {error:.1e} after refinement, expected at most "
                f"{ACCEPTED_ERROR:.0e}: the matrix is singular or nearly so"
            )
        return solution.reshape(right.shape)

    def _backward_error(self, right: Array, solution: Array) -> float:
        residual = np.abs(right - _times(self._upper, solution)).sum()
        scale = self._norm * np.abs(solution).sum() + np.abs(right).sum()
        return float(residual / scale) if scale > 0 else 0.0


def solver_name(n_rows: int = 0, n_solves: int = 0) -> str:
    """The direct solver that `factorize` uses on this machine for a definite matrix."""
    if pardiso.library() is not None:
        return "MKL PARDISO"
    return "LAPACK" if n_solves >= MANY and n_rows <= DENSE_UP_TO else "SuperLU"


def factorize(matrix: csr_array, *, definite: bool = True, n_solves: int = 0) -> SymmetricFactor:
    """The factor of a symmetric matrix (n, n), whose upper triangle is read: by MKL PARDISO where the package `mkl` is
    installed, else by SuperLU, or by LAPACK as a dense one where that is definite and not large, and many solutions follow.

    definite  whether all eigenvalues are expected to be positive
    n_solves  about how many right-hand sides will come

    Raises LinAlgError where a matrix that is said to be definite is not, by MKL PARDISO and LAPACK (SuperLU factorizes it,
    and n_negative tells), or where one is singular; MemoryError where the factor does not fit.
    """
    upper = _upper_triangle(matrix)
    name = solver_name(matrix.shape[0], n_solves if definite else 0)
    backend: _Backend
    match name:
        case "MKL PARDISO":
            backend = pardiso.Pardiso(upper, definite)
        case "LAPACK":
            backend = DenseCholesky(upper)
        case _:
            backend = SuperLU(upper)
    return SymmetricFactor(upper, backend, name)


def _upper_triangle(matrix: csr_array) -> csr_array:
    """The upper triangle with sorted indices; scipy's `triu` makes three copies of the matrix on the way."""
    rows = np.repeat(np.arange(matrix.shape[0], dtype=np.int32), np.diff(matrix.indptr))
    kept = matrix.indices >= rows
    counts = np.bincount(rows[kept], minlength=matrix.shape[0])
    starts = np.concatenate([[0], np.cumsum(counts)]).astype(np.int32)
    upper = csr_array((matrix.data[kept], matrix.indices[kept], starts), shape=matrix.shape)
    upper.sort_indices()
    return upper


def _times(upper: csr_array, x: Array) -> Array:
    """A x for a symmetric A given by its upper triangle; x (n,) or (n, k)."""
    return upper @ x + upper.T @ x - (upper.diagonal() * x.T).T
