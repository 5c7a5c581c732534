"""A plain linear time-invariant system E dx/dt = A x + B u, y = C x + D u, dense or sparse."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

import numpy as np
import scipy.linalg
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.linalg import ArpackNoConvergence, LinearOperator, eigs, splu

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]
Matrix = Any  # (n, n) dense array or scipy sparse array: scipy's two have no common type


@dataclass(frozen=True)
class LinearSystem:
    """E dx/dt = A x + B u, y = C x + D u, real.

    a  (n, n), dense or scipy sparse
    b  (n, n_inputs), c (n_outputs, n), d (n_outputs, n_inputs), dense
    e  (n, n), regular, dense or scipy sparse; None for the identity

    Raises ValueError where a field is no such matrix, is not real, does not fit the others or has a value that is not
    finite.
    """

    a: Matrix
    b: Array
    c: Array
    d: Array
    e: Matrix | None = None

    def __post_init__(self) -> None:
        for name in ("a", "b", "c", "d", "e"):
            _check_matrix(name, getattr(self, name))
        n, m, p = self.a.shape[0], self.b.shape[1], self.c.shape[0]
        expected = {"a": (n, n), "b": (n, m), "c": (p, n), "d": (p, m), "e": (n, n)}
        for name, shape in expected.items():
            value: Any = getattr(self, name)
            if value is None:
                continue
            if value.shape != shape:
                raise ValueError(f"{name} has shape {value.shape}: expected {shape}")
            entries = value.tocoo().data if _is_sparse(value) else value
            if not np.all(np.isfinite(entries)):
                raise ValueError(f"{name} holds values that are not finite")

    @property
    def n_states(self) -> int:
        return int(self.a.shape[0])

    @property
    def n_inputs(self) -> int:
        return self.b.shape[1]

    @property
    def n_outputs(self) -> int:
        return self.c.shape[0]

    @property
    def is_sparse(self) -> bool:
        return _is_sparse(self.a)

    def apply(self, x: Array) -> Array:
        """A x for x (n, k)."""
        return np.asarray(self.a @ x)

    def mass(self, x: Array) -> Array:
        """E x for x (n, k)."""
        return x if self.e is None else np.asarray(self.e @ x)

    @cached_property
    def explicit(self) -> LinearSystem:
        """The same system dense and with E = I. Raises ValueError where E is singular to working precision."""
        if self.e is None and not self.is_sparse:
            return self
        a = _dense(self.a)
        if self.e is None:
            return LinearSystem(a, self.b, self.c, self.d)
        e = _dense(self.e)
        if not np.linalg.cond(e) < 1 / np.finfo(float).eps:
            raise ValueError("e is singular to working precision: expected a regular matrix")
        solved = np.asarray(np.linalg.solve(e, np.hstack([a, self.b])), dtype=np.float64)
        n = self.n_states
        return LinearSystem(solved[:, :n], solved[:, n:], self.c, self.d)

    @cached_property
    def schur_form(self) -> tuple[Complex, Complex]:
        """T upper triangular and U unitary, each (n, n), complex, with E^-1 A = U T U^H; dense computation."""
        triangle, basis = scipy.linalg.rsf2csf(*scipy.linalg.schur(self.explicit.a))
        return triangle.astype(np.complex128), basis.astype(np.complex128)

    @property
    def poles(self) -> Complex:
        """(n,): eigenvalues of E^-1 A, dense computation."""
        return np.diag(self.schur_form[0])

    @property
    def spectral_abscissa(self) -> float:
        """Largest real part of the poles; minus infinity without states."""
        return float(np.max(self.poles.real, initial=-np.inf))

    @property
    def pole_round_off(self) -> float:
        """What the real parts of the poles are uncertain by at least, 1/s: a pole nearer to the axis may lie on it."""
        return 1e-13 * float(np.max(np.abs(self.poles), initial=0.0))

    @cached_property
    def outlying_poles(self) -> Complex:
        """(k,): of a sparse system a few poles nearest to 0, and those of positive real part that stand out.

        Arnoldi iteration on A^-1 E, whose eigenvalues 1/p have their largest moduli and, where a pole p is not stable,
        their largest real parts there. What does not converge in a few hundred solutions is left out, so this finds
        unstable poles but does not prove that there are none. 0 alone where A is singular.
        """
        n = self.n_states
        try:
            factor = splu(sparse.csc_array(self.a))
        except RuntimeError:
            return np.zeros(1, dtype=np.complex128)
        operator = LinearOperator((n, n), lambda x: factor.solve(self.mass(x)), dtype=np.float64)
        start = np.random.default_rng(0).standard_normal(n)
        searches: tuple[tuple[Literal["LM", "LR"], int], ...] = (("LM", 10), ("LR", 2))
        found: list[NDArray[Any]] = []
        for which, k in searches:
            try:
                found.append(
                    eigs(operator, k, which=which, v0=start, ncv=40, maxiter=10, return_eigenvectors=False)
                )
            except ArpackNoConvergence as partial:
                found.append(partial.eigenvalues)
        inverse = np.concatenate(found).astype(np.complex128)
        known = np.abs(inverse) > 1e-10 * np.max(
            np.abs(inverse), initial=0.0
        )  # smaller ones are round-off in part
        return 1 / inverse[known]

    def transfer(self, s: NDArray[np.complexfloating[Any, Any]]) -> Complex:
        """(n_points, n_outputs, n_inputs): C (s E - A)^-1 B + D at the points s (n_points,)."""
        return self.c @ self.solutions(s) + self.d

    def solutions(self, s: NDArray[np.complexfloating[Any, Any]]) -> Complex:
        """(n_points, n, n_inputs): (s E - A)^-1 B. One factorization for all points if dense, one a point if sparse."""
        out = np.empty((len(s), self.n_states, self.n_inputs), dtype=np.complex128)
        if self.n_states == 0:
            return out
        if self.is_sparse:
            e = sparse.eye_array(self.n_states) if self.e is None else self.e
            rhs = self.b.astype(np.complex128)
            for i, point in enumerate(s):
                out[i] = splu(sparse.csc_array(point * e - self.a)).solve(rhs)
            return out
        triangle, basis = self.schur_form
        rhs = basis.conj().T @ self.explicit.b
        identity = np.eye(self.n_states)
        for i, point in enumerate(s):
            out[i] = basis @ scipy.linalg.solve_triangular(point * identity - triangle, rhs)
        return out


def _check_matrix(name: str, value: Any) -> None:
    if name == "e" and value is None:
        return
    may_be_sparse = name in ("a", "e")
    if not (isinstance(value, np.ndarray) or (may_be_sparse and _is_sparse(value))):
        expected = "a NumPy array or a SciPy sparse array" if may_be_sparse else "a NumPy array"
        raise ValueError(f"{name} is a {type(value).__name__}: expected {expected}")
    if value.ndim != 2:
        raise ValueError(f"{name} has shape {value.shape}: expected a matrix")
    if value.dtype.kind not in "fiu":
        raise ValueError(f"{name} holds values of type {value.dtype}: expected real numbers")


def _is_sparse(matrix: Matrix) -> bool:
    return bool(sparse.issparse(matrix))


def _dense(matrix: Matrix) -> Array:
    return np.asarray(matrix.toarray() if _is_sparse(matrix) else matrix, dtype=np.float64)


def split(system: LinearSystem) -> tuple[LinearSystem, LinearSystem]:
    """(stable, rest): the poles with Re < 0 by more than round-off, and the others; they add up, D with the first.

    Ordered real Schur form and a Sylvester equation; E = I in the results. system must be dense.
    """
    explicit = system.explicit
    limit = -system.pole_round_off
    triangle, basis, n_stable = scipy.linalg.schur(explicit.a, sort=lambda re, im: re < limit)
    k = int(n_stable)
    # T11 X - X T22 = -T12 makes [[I, X], [0, I]] the change of basis that decouples.
    x = scipy.linalg.solve_sylvester(triangle[:k, :k], -triangle[k:, k:], -triangle[:k, k:])
    b, c = basis.T @ explicit.b, explicit.c @ basis
    stable = LinearSystem(triangle[:k, :k], b[:k] - x @ b[k:], c[:, :k], explicit.d)
    rest = LinearSystem(triangle[k:, k:], b[k:], c[:, k:] + c[:, :k] @ x, np.zeros_like(explicit.d))
    return stable, rest


def parallel(first: LinearSystem, second: LinearSystem) -> LinearSystem:
    """The sum of two dense systems with E = I."""
    a = scipy.linalg.block_diag(first.a, second.a)
    return LinearSystem(a, np.vstack([first.b, second.b]), np.hstack([first.c, second.c]), first.d + second.d)
