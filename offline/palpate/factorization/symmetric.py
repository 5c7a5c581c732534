"""One interface to the sparse direct solvers for symmetric matrices; every solution is checked."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from palpate.factorization import pardiso
from palpate.factorization.multifrontal import MultifrontalCholesky
from palpate.factorization.superlu import SuperLU

Array = NDArray[np.float64]

ACCEPTED_ERROR = 1e-10
"""Largest backward error |b - A x| / (|A| |x| + |b|) of a solution, in 1-norms: above it the solver has failed."""

_REFINED_ABOVE = 1e-14
_MOST_REFINEMENTS = 3


class _Backend(Protocol):
    @property
    def nnz(self) -> int: ...

    @property
    def n_negative(self) -> int | None: ...

    def solve(self, right: Array, /) -> Array: ...


class SymmetricFactor:
    """A factorized symmetric matrix A, the sum of `terms`, which are kept to check solutions.

    solver  name of the direct solver
    nnz     entries of the factor
    """

    def __init__(self, terms: tuple[csr_array, ...], norm: float, backend: _Backend, solver: str) -> None:
        self.solver = solver
        self.nnz = backend.nnz
        self._backend = backend
        self._terms = terms
        self._norm = norm

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
            refined = solution + self._backend.solve(columns - self._times(solution))
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
        residual = np.abs(right - self._times(solution)).sum()
        scale = self._norm * np.abs(solution).sum() + np.abs(right).sum()
        return float(residual / scale) if scale > 0 else 0.0

    def _times(self, x: Array) -> Array:
        return sum((term @ x for term in self._terms[1:]), start=self._terms[0] @ x)


def solver_name() -> str:
    """The direct solver that `factorize` uses on this machine for a definite matrix of nodes with places."""
    return "multifrontal Cholesky" if pardiso.library() is None else "MKL PARDISO"


def factorize(*terms: csr_array, definite: bool = True, points: Array | None = None) -> SymmetricFactor:
    """The factor of a symmetric matrix (n, n), the sum of `terms`: by MKL PARDISO where the package `mkl` is installed. Else a
    definite one of nodes with places by `MultifrontalCholesky`, any other by SuperLU.

    terms     symmetric, with both triangles. Their sum does not outlive the factorization: a large matrix and a small change
              of it take the memory of one
    definite  whether all eigenvalues are expected to be positive
    points    (n_nodes, dim), m: places of the nodes, near ones of which are coupled, where the matrix consists of dense
              blocks for n / n_nodes unknowns of each node in sequence

    Raises LinAlgError where a matrix that is said to be definite is not (SuperLU factorizes it, and n_negative tells), or
    where one is singular; MemoryError where the factor does not fit.
    """
    name = solver_name()
    norm = sum(_norm(term) for term in terms)
    backend: _Backend
    if name == "MKL PARDISO":
        block = terms[0].shape[0] // len(points) if definite and points is not None else 1
        backend = pardiso.Pardiso(pardiso.upper_triangle(_sum(terms), block), definite)
    elif definite and points is not None:
        backend = MultifrontalCholesky(terms, points)
    else:
        name, backend = "SuperLU", SuperLU(_sum(terms))
    return SymmetricFactor(terms, norm, backend, name)


def _sum(terms: tuple[csr_array, ...]) -> csr_array:
    return sum(terms[1:], start=terms[0])


def _norm(matrix: csr_array) -> float:
    """The largest sum of absolute values in a row."""
    ones = np.ones(matrix.shape[0])
    absolute = csr_array((np.abs(matrix.data), matrix.indices, matrix.indptr), shape=matrix.shape)
    return float(np.max(absolute @ ones))
