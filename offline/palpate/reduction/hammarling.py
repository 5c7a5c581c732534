"""Gramian factors of a dense stable system without forming the Gramian (Hammarling 1982)."""

from __future__ import annotations

import numpy as np
import scipy.linalg
from numba import njit
from numpy.typing import NDArray

from palpate.reduction.linear_system import LinearSystem

Array = NDArray[np.float64]


def gramian_factors(system: LinearSystem) -> tuple[Array, Array]:
    """(control, observe), real, control control^T = P and observe observe^T = Q of a stable system, each (n, rank).

    A P + P A^T + B B^T = 0 and A^T Q + Q A + C^T C = 0, E = I, from the Schur form of A. The factors come from A
    itself, not from rounded Gramians, so small Hankel singular values keep their digits. Columns below round-off of
    the largest are left out.

    Raises ValueError unless every pole has Re < 0.
    """
    if not system.spectral_abscissa < 0:
        raise ValueError(
            f"the spectral abscissa is {system.spectral_abscissa:.3g} 1/s: Gramians need it below 0"
        )
    triangle, basis = system.schur_form
    b, c = basis.conj().T @ system.explicit.b, basis.conj().T @ system.explicit.c.T
    control = _eliminate(np.asfortranarray(triangle), np.ascontiguousarray(b))
    # The adjoint of an upper triangular matrix is upper triangular in reversed order.
    reversed_adjoint = np.asfortranarray(triangle.conj().T[::-1, ::-1])
    observe = _eliminate(reversed_adjoint, np.ascontiguousarray(c[::-1]))[::-1]
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
