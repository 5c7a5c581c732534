"""The lowest modes of a body held at some nodes, by block Lanczos with shift-and-invert at 0 Hz.

K⁻¹ M is projected onto the Krylov space of a random block, orthogonalized in full, until the wanted modes have converged
(Grimes, Lewis & Simon 1994). That none is missed is shown by Sylvester's law of inertia: K - mu M has as many negative
pivots as there are modes below mu.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import eigh
from scipy.sparse import diags_array, eye_array, kron

from palpate.factorization import factorize
from palpate.modes.held_body import HeldBody, penalty
from palpate.modes.krylov import KrylovSpace

Array = NDArray[np.float64]

BLOCK = 24
"""Vectors of a block: more make better use of the factor, fewer need a smaller space."""

RESIDUAL = 1e-7
"""Largest |K⁻¹ M v - v / mu| mu of a converged mode v, in the norm of M: mu is then accurate to about its square."""

_GUARD = 8
"""Modes beyond the wanted ones among which the widest gap is looked for, to count the modes below it."""


@dataclass(frozen=True)
class LowestModes:
    """squared_frequencies (n_modes,), (rad/s)², ascending; parameters (c n_nodes, n_modes), mass-normalized."""

    squared_frequencies: Array
    parameters: Array


def lowest_modes(held: HeldBody, n_modes: int, seed: int = 0) -> LowestModes:
    """The n_modes lowest modes of a body held without a shift.

    Raises ValueError where the body has too few modes; LinAlgError where the inertia contradicts the modes that were
    found; MemoryError where the space, some six times as many vectors as modes, does not fit.
    """
    n = held.body.stiffness.shape[0]
    most = n - held.body.n_components * len(held.nodes)
    if not 0 < n_modes <= most:
        raise ValueError(
            f"n_modes = {n_modes}: expected from 1 to {most}, the number of free displacement components"
        )
    wanted = min(n_modes + _GUARD, most)
    space = KrylovSpace(held.body, held.constraints, min(most, 6 * wanted + 20 * BLOCK))
    random = np.random.default_rng(seed)
    inverse, judged = np.zeros((0, 0)), 0
    space.append(held.project(random.standard_normal((n, min(BLOCK, most)))))
    while True:
        known = space.size
        growing = space.append(held.approximate(held.body.inertia(space.last_block)))
        inverse = _bordered(inverse, space.coefficients, known)
        if growing and known < max(2 * wanted, 1.2 * judged):
            continue
        judged = known
        first = max(0, known - wanted)
        eigenvalues, vectors = eigh(inverse[:known, :known], subset_by_index=[first, known - 1])
        residuals = np.linalg.norm(inverse[known:, :known] @ vectors, axis=0) / eigenvalues
        if known >= wanted and np.all(residuals <= RESIDUAL):
            break
        if not growing:
            raise np.linalg.LinAlgError(
                f"{np.count_nonzero(residuals > RESIDUAL)} of {wanted} modes have not converged in {known} vectors"
            )
    ritz = space.vectors[:, :known] @ vectors
    # The space was made with the penalty's small compliance; the modes are those of K itself in the span.
    mu, rotation = eigh(ritz.T @ (held.body.stiffness @ ritz), ritz.T @ held.body.inertia(ritz))
    if wanted > n_modes:
        _require_none_missed(held, mu, n_modes)
    return LowestModes(mu[:n_modes], (ritz @ rotation)[:, :n_modes])


def _bordered(inverse: Array, coefficients: Array, known: int) -> Array:
    """Vᵀ M K⁻¹ M V with the columns of the newest responses, (known + new, known); symmetric where it is square."""
    size, count = coefficients.shape
    result = np.zeros((size, known))
    result[: len(inverse), : inverse.shape[1]] = inverse
    result[:, known - count :] = coefficients
    result[known - count : known, : known - count] = coefficients[: known - count].T
    return result


def _require_none_missed(held: HeldBody, mu: Array, n_modes: int) -> None:
    """Raises LinAlgError unless K - s M, s in the widest gap above the wanted modes, has the right inertia."""
    gap = n_modes - 1 + int(np.argmax(np.diff(mu[n_modes - 1 :]) / mu[n_modes - 1 : -1]))
    shift = float((mu[gap] + mu[gap + 1]) / 2)
    body, value = held.body, held.body.basis.value
    mass = kron(value.T @ (diags_array(body.mass) @ value), eye_array(body.n_components), format="csr")
    factor = factorize(body.stiffness, penalty(body, held.nodes), -shift * mass, definite=False)
    if factor.n_negative is None:
        raise np.linalg.LinAlgError(
            f"{factor.solver} can't tell how many modes lie below {shift:.6g} (rad/s)²"
        )
    if factor.n_negative != gap + 1:
        raise np.linalg.LinAlgError(
            f"{factor.n_negative} modes lie below {shift:.6g} (rad/s)², of which {gap + 1} were found"
        )
