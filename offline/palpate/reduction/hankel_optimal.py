"""Hankel-optimal reduction: no system of the same order is nearer in the Hankel norm (Glover 1984).

Glover's all-pass embedding of the balanced realization with Sigma = diag(Sigma_1, sigma I), sigma = sigma_{r+1},
Gamma = Sigma_1² - sigma² I and U with B_2 = -C_2^T U orthogonal:

    A^ = Gamma^-1 (sigma² A_11^T + Sigma_1 A_11 Sigma_1 - sigma C_1^T U B_1^T)
    B^ = Gamma^-1 (Sigma_1 B_1 + sigma C_1^T U),  C^ = C_1 Sigma_1 + sigma U B_1^T,  D^ = D - sigma U,

of which the stable part is the answer. The H-infinity error with this D is at most sigma_{r+1} + 2 sum of the later ones.

The Hankel norm of the error is sigma_{r+1} in exact arithmetic. In double precision the difference
grows as the ratio sigma_{r+1} / sigma_1 falls. Measured relative difference: at most 1e-6 down to a ratio of 1e-5; at 1e-7
mostly 1e-5, at worst 4e-3. Orders with a ratio below 1e-9 are not offered.
"""

from __future__ import annotations

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from palpate.lti.errors import ReductionError
from palpate.reduction.balancing import Balancing, Matrices

Array = NDArray[np.float64]

_LOSSLESS = 1e-12
"""Hankel singular values below it, over the largest, are left out first: they are round-off and would spoil the others."""

_LEAST = 1e-9
"""Smallest sigma_{r+1} / sigma_1 that is approximated: below it the all-pass embedding is round-off."""

_EQUAL = 1e-8
"""Relative distance up to which Hankel singular values count as one: the embedding divides by their distance."""


def hankel_optimal_orders(balancing: Balancing) -> NDArray[np.intp]:
    """(k,), ascending: the orders r with sigma_r > sigma_{r+1}, the latter above round-off; only 0 where there is none."""
    orders = balancing.separated_orders(max(balancing.count_above(_LEAST) - 1, 0), _EQUAL)
    return orders[1:] if len(orders) > 1 else orders


def hankel_optimal(balancing: Balancing, order: int) -> Matrices:
    """The Hankel-optimal system of an order in `hankel_optimal_orders`.

    Raises ReductionError where round-off leaves the embedding with another number of stable poles.
    """
    lossless = balancing.count_above(_LOSSLESS)
    full = balancing.truncated(lossless)
    if lossless == 0:
        return full
    sigmas = balancing.sigma[:lossless]
    middle = np.arange(order, order + _multiplicity(balancing, order))
    stable = _stable_part(_embedding(full, sigmas, middle))
    if len(stable.a) != order:
        raise ReductionError(
            f"order {order} is too near to round-off for Hankel-optimal reduction: {len(stable.a)} stable poles of the "
            f"embedding, expected {order}; choose a smaller order"
        )
    return stable


def hankel_optimal_bound(balancing: Balancing, order: int) -> float:
    """Upper bound on the H-infinity error: sigma_{r+1} and twice the distinct later ones."""
    sigma = float(balancing.sigma[order]) if balancing.rank else 0.0
    return sigma + 2 * balancing.tail(order + _multiplicity(balancing, order))


def _multiplicity(balancing: Balancing, order: int) -> int:
    """How many Hankel singular values equal sigma_{order + 1}, itself included."""
    if not balancing.rank:
        return 0
    sigmas = balancing.sigma[: balancing.count_above(_LOSSLESS)]
    return int(np.count_nonzero(np.abs(sigmas - sigmas[order]) <= _EQUAL * sigmas[order]))


def _embedding(balanced: Matrices, sigmas: Array, middle: NDArray[np.intp]) -> Matrices:
    """The all-pass embedding for the Hankel singular values at `middle`, which are equal."""
    sigma = float(sigmas[middle[0]])
    kept = np.setdiff1d(np.arange(len(sigmas)), middle)
    n_outputs, n_inputs = balanced.d.shape
    square = max(n_inputs, n_outputs)
    b = np.pad(balanced.b, ((0, 0), (0, square - n_inputs)))
    c = np.pad(balanced.c, ((0, square - n_outputs), (0, 0)))
    a1, b1, c1, sigma_1 = balanced.a[np.ix_(kept, kept)], b[kept], c[:, kept], sigmas[kept]
    u = _orthogonal_solution(c[:, middle], b[middle])

    # Gamma = root sign root: the change of basis by root keeps the embedding well scaled.
    gamma = sigma_1**2 - sigma**2
    root, sign = np.sqrt(np.abs(gamma)), np.sign(gamma)
    inner = sigma**2 * a1.T + sigma_1[:, None] * a1 * sigma_1 - sigma * c1.T @ u @ b1.T
    a_hat = (sign / root)[:, None] * inner / root
    b_hat = (sign / root)[:, None] * (sigma_1[:, None] * b1 + sigma * c1.T @ u)
    c_hat = (c1 * sigma_1 + sigma * u @ b1.T) / root
    d_hat = balanced.d - sigma * u[:n_outputs, :n_inputs]
    return Matrices(a_hat, b_hat[:, :n_inputs], c_hat[:n_outputs], d_hat)


def _orthogonal_solution(c2: Array, b2: Array) -> Array:
    """U (m, m) orthogonal with C_2^T U = -B_2, for C_2^T C_2 = B_2 B_2^T, (k, k).

    The condition determines U on k directions. On the others any orthogonal map would do: the one nearest to the identity
    makes the result independent of the basis of the states.
    """
    m, k = c2.shape
    left, _, right = np.linalg.svd(-c2 @ b2)
    fixed = min(k, m)
    u = left[:, :fixed] @ right[:fixed]
    others = (np.eye(m) - left[:, :fixed] @ left[:, :fixed].T) @ (np.eye(m) - right[:fixed].T @ right[:fixed])
    left, _, right = np.linalg.svd(others)
    return u + left[:, : m - fixed] @ right[: m - fixed]


def _stable_part(system: Matrices) -> Matrices:
    """The poles with Re < 0, by ordered real Schur form and a Sylvester equation; D goes with them."""
    limit = -1e-13 * float(np.max(np.abs(np.linalg.eigvals(system.a)), initial=0.0))
    triangle, basis, k = scipy.linalg.schur(system.a, sort=lambda re, im: re < limit)
    # T11 X - X T22 = -T12 makes [[I, X], [0, I]] the change of basis that decouples.
    x = scipy.linalg.solve_sylvester(triangle[:k, :k], -triangle[k:, k:], -triangle[:k, k:])
    b, c = basis.T @ system.b, system.c @ basis
    return Matrices(triangle[:k, :k], b[:k] - x @ b[k:], c[:, :k], system.d)
