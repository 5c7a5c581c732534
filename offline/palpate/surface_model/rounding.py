"""The residual flexibility in single precision, made definite again."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cholesky

Array = NDArray[np.float64]

_POWER_STEPS = 30
_MARGIN = 1.5
"""A norm by the power method is a little too small."""


def rounded(compliance: Array, free: NDArray[np.intp]) -> tuple[NDArray[np.float32], float]:
    """A residual (3 n_points, 3 n_points), m/N, in single precision, and the shift of its diagonal, m/N.

    free  (n_free,): the points that are not held

    Rounding moves eigenvalues by at most the norm of the rounding error (Weyl), which is measured; so much, and half as
    much again, is added to the diagonal of the free points. Cholesky's factorization of the stored numbers shows that
    it was enough: raises LinAlgError where it was not, as the compliance itself was not semidefinite.
    """
    single = compliance.astype(np.float32)
    diagonal = np.arange(len(single))[(3 * free[:, None] + np.arange(3)).ravel()]
    shift = _MARGIN * _norm(compliance, single)
    raised = (compliance[diagonal, diagonal] + shift).astype(np.float32)
    single[diagonal, diagonal] = np.nextafter(raised, np.float32(np.inf))
    stored = single[np.ix_(diagonal, diagonal)].astype(np.float64)
    try:
        cholesky(stored, overwrite_a=True, check_finite=False)
    except np.linalg.LinAlgError as error:
        raise np.linalg.LinAlgError(
            f"the residual flexibility is not positive semidefinite, and a shift of {shift:.2g} m/N, the effect of single "
            f"precision, does not make it so ({error}): the shape functions of two points may be nearly the same"
        ) from error
    return single, shift


def _norm(compliance: Array, single: NDArray[np.float32]) -> float:
    """The 2-norm of the rounding error, by the power method; rows at a time, so that no third matrix is held."""
    vector = np.random.default_rng(0).standard_normal(len(single))
    norm = 0.0
    for _ in range(_POWER_STEPS):
        vector /= np.linalg.norm(vector)
        image = compliance @ vector - _times(single, vector)
        norm, vector = float(np.linalg.norm(image)), image
        if norm == 0:
            break
    return norm


def _times(single: NDArray[np.float32], vector: Array) -> Array:
    """A x in double precision."""
    rows = range(0, len(single), 512)
    return np.concatenate([single[r : r + 512].astype(np.float64) @ vector for r in rows])
