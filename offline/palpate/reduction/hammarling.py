"""Gramian factors of a dense stable system without forming the Gramian (Hammarling 1982)."""

from __future__ import annotations

import numpy as np
import scipy.linalg
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]


def gramian_factors(a: Array, b: Array, c: Array) -> tuple[Array, Array]:
    """(control, observe), real, control control^T = P and observe observe^T = Q of a stable system, each (n, rank).

    A P + P A^T + B B^T = 0 and A^T Q + Q A + C^T C = 0, from one complex Schur form of A. The factors come from A
    itself, not from rounded Gramians, so small Hankel singular values keep their digits. Columns below round-off of
    the largest are left out.

    Raises ValueError unless every eigenvalue of A has Re < 0.
    """
    triangle, basis = scipy.linalg.schur(a, output="complex")
    abscissa = float(np.max(np.diag(triangle).real, initial=-np.inf))
    if not abscissa < 0:
        raise ValueError(f"the spectral abscissa is {abscissa:.3g} 1/s: Gramians need it below 0")
    control = _triangular_factor(np.asfortranarray(triangle), basis.conj().T @ b)
    # The transpose of an upper triangular matrix is upper triangular in reversed order.
    reversed_adjoint = np.asfortranarray(triangle.conj().T[::-1, ::-1])
    observe = _triangular_factor(reversed_adjoint, (basis.conj().T @ c.conj().T)[::-1])[::-1]
    return _real(basis @ control), _real(basis @ observe)


def _real(factor: NDArray[np.complex128]) -> Array:
    """A real factor of the real matrix factor factor^H, compressed by a pivoted QR decomposition."""
    stacked = np.hstack([factor.real, factor.imag])
    r, pivots = scipy.linalg.qr(stacked.T, mode="r", pivoting=True)
    diagonal = np.abs(np.diag(r))
    rank = int(np.count_nonzero(diagonal > 1e-16 * diagonal[0])) if len(diagonal) else 0
    out = np.empty((factor.shape[0], rank))
    out[pivots] = r[:rank].T
    return out


def _triangular_factor(triangle: NDArray[np.complex128], b: NDArray[np.complex128]) -> NDArray[np.complex128]:
    return _eliminate(triangle, np.ascontiguousarray(b, dtype=np.complex128))


@njit(cache=True)
def _eliminate(t, b):  # type: ignore[no-untyped-def]
    """Upper triangular U with T U U^H + U U^H T^H + B B^H = 0, T upper triangular; b is overwritten.

    Last row first: tau = |b_n| / sqrt(-2 Re t_nn), (T_11 + conj(t_nn)) u = -(t_1n tau + B_1 b_n^H / tau), and what is left
    for the leading block has B_1 - u b_n / tau.
    """
    n, m = b.shape
    factor = np.zeros((n, n), dtype=np.complex128).T  # columns contiguous
    u = np.empty(n, dtype=np.complex128)
    negligible = 1e-60 * np.sum(np.abs(b) ** 2)  # what divisions by it would turn into overflow
    for j in range(n - 1, -1, -1):
        norm2 = 0.0
        for i in range(m):
            norm2 += b[j, i].real ** 2 + b[j, i].imag ** 2
        if norm2 <= negligible:
            continue
        tau = np.sqrt(norm2 / (-2 * t[j, j].real))
        for k in range(j):
            inner = 0j
            for i in range(m):
                inner += b[k, i] * np.conj(b[j, i])
            u[k] = -(t[k, j] * tau + inner / tau)
        shift = np.conj(t[j, j])
        for k in range(j - 1, -1, -1):
            value = u[k] / (t[k, k] + shift)
            u[k] = value
            for i in range(k):
                u[i] -= t[i, k] * value
        for k in range(j):
            factor[k, j] = u[k]
            for i in range(m):
                b[k, i] -= u[k] * b[j, i] / tau
        factor[j, j] = tau
    return factor
