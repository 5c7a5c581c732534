"""Low-rank Gramian factors of a large sparse stable system by the alternating-direction implicit iteration."""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy.linalg
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.linalg import splu

Array = NDArray[np.float64]


class NotConvergedError(ArithmeticError):
    """The iteration stopped at a residual that would falsify the reduced model and its bound."""


def low_rank_factor(a: Any, e: Any, b: Array, tolerance: float = 1e-12, max_columns: int = 3000) -> Array:
    """(n, k), real: L with A L L^T E^T + E L L^T A^T + B B^T = W W^T, |W W^T| <= tolerance |B B^T|.

    a, e  (n, n) scipy sparse, all eigenvalues of E^-1 A with Re < 0; e = None is the identity
    b     (n, m)

    Li & White 2002 in residual form, pairs of complex shifts in real arithmetic (Benner, Kuerschner & Saak 2013),
    shifts from projections on the newest columns (Benner, Kuerschner & Saak 2014).

    Raises NotConvergedError beyond max_columns, and where A + shift E is singular or the residual grows beyond
    recovery, which a system that is not stable makes it do: the factors of its iteration have moduli above 1.
    """
    if not np.any(b):
        return np.zeros((len(b), 0))
    e = sparse.eye_array(len(b)) if e is None else e
    w = np.array(b, dtype=np.float64)
    goal = tolerance * float(np.linalg.norm(w.T @ w, 2))
    blocks: list[Array] = []
    n_columns = 0
    shifts = list(_projection_shifts(a, e, w))
    while (residual := float(np.linalg.norm(w.T @ w, 2))) > goal:
        if residual * np.finfo(float).eps ** 2 > goal:  # the residual's round-off alone exceeds what is asked
            raise NotConvergedError(
                f"the low-rank iteration grew to {residual / goal * tolerance:.1e} of its start, expected to fall to "
                f"{tolerance:.1e}: the system is not stable or far from normal, use a dense matrix"
            )
        if n_columns > max_columns:
            raise NotConvergedError(
                f"the low-rank iteration stands at {residual / goal * tolerance:.1e} of its start after {n_columns} "
                f"columns, expected {tolerance:.1e}: the system is too lightly damped for it, use a dense matrix"
            )
        if not shifts:
            newest = np.hstack(blocks[-8:])
            shifts = list(_projection_shifts(a, e, newest)) or list(_projection_shifts(a, e, w))
        shift = shifts.pop(0)
        try:
            v = splu(sparse.csc_array(a + shift * e)).solve(w.astype(type(shift)))
        except RuntimeError as error:
            raise NotConvergedError(
                f"A + shift E is singular for the shift {shift:.6g} 1/s: the system is not stable, it has a pole at the "
                "shift's negative"
            ) from error
        if isinstance(shift, complex):
            gamma, delta = 2 * np.sqrt(-shift.real), shift.real / shift.imag
            combined = v.real + delta * v.imag
            blocks += [gamma * combined, gamma * np.sqrt(delta**2 + 1) * v.imag]
            w = w + gamma**2 * (e @ combined)
        else:
            blocks.append(np.sqrt(-2 * shift) * v)
            w = w - 2 * shift * (e @ v)
        n_columns = sum(block.shape[1] for block in blocks)
    return np.hstack(blocks)


def _projection_shifts(a: Any, e: Any, columns: Array) -> list[float | complex]:
    """Eigenvalues with Re < 0 of the pencil projected on the columns, one of each complex pair, fast ones first."""
    basis, r, _ = scipy.linalg.qr(columns, mode="economic", pivoting=True)
    diagonal = np.abs(np.diag(r))
    basis = basis[:, : int(np.count_nonzero(diagonal > 1e-12 * diagonal[0]))]
    values: NDArray[Any] = scipy.linalg.eigvals(basis.T @ (a @ basis), basis.T @ (e @ basis))
    values = np.where(
        values.real > 0, -values.conj(), values
    )  # mirrored: a shift only has to lie in the left half plane
    values = values[np.isfinite(values) & (values.real < 0) & (values.imag >= 0)]
    values = values[np.argsort(-np.abs(values))]
    return [float(v.real) if abs(v.imag) < 1e-8 * abs(v) else complex(v) for v in values]
