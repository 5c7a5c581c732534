"""Hankel-optimal reduction: no system of the same order is nearer in the Hankel norm (Glover 1984)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from palpate.lti.errors import ReductionError
from palpate.reduction.balancing import balance
from palpate.reduction.linear_system import LinearSystem, split
from palpate.reduction.truncation import ReducedSystem, System, Unstable, prepare

Array = NDArray[np.float64]

_LOSSLESS = 1e-12
"""Hankel singular values below it, over the largest, are left out before: they are round-off and spoil the rest."""

_LEAST = 1e-9
"""Smallest sigma_{r+1} / sigma_1 that is approximated: nearer to round-off the all-pass embedding is noise.

The Hankel norm of the error is sigma_{r+1} to a relative 3e-8 down to a ratio of 1e-5, 4e-6 at 1e-7, 5e-4 near 2e-9.
"""

_EQUAL = 1e-8
"""Hankel singular values this near to each other, relatively, count as one: the embedding divides by their distance."""


def hankel_optimal(
    system: System,
    order: int | None = None,
    tolerance: float | None = None,
    *,
    unstable: Unstable = "refuse",
) -> ReducedSystem:
    """Optimal Hankel-norm approximation: the Hankel norm of the error is sigma_{r+1}, the least that is possible.

    order      where sigma_r = sigma_{r+1}, or sigma_{r+1} is round-off, the next smaller order that is not so
    tolerance  sigma_{r+1} over sigma_1

    Glover's all-pass embedding of the balanced realization with Sigma = diag(Sigma_1, sigma I), Gamma = Sigma_1² - sigma² I
    and U with B_2 = -C_2^T U orthogonal:
        A^ = Gamma^-1 (sigma² A_11^T + Sigma_1 A_11 Sigma_1 - sigma C_1^T U B_1^T)
        B^ = Gamma^-1 (Sigma_1 B_1 + sigma C_1^T U),  C^ = C_1 Sigma_1 + sigma U B_1^T,  D^ = D - sigma U,
    of which the stable part is the answer. The H-infinity error with this D is at most sigma_{r+1} + 2 sum of the later ones.

    Raises ReductionError where the embedding does not have exactly r stable poles (round-off).
    """
    part = prepare(system, order, tolerance, unstable)
    balancing = balance(part.realization, part.gramians())
    sigma = balancing.sigma
    if balancing.rank == 0:
        return part.result(
            "Hankel-optimal", balancing.truncated(part.realization, 0), sigma, 2 * balancing.tail(0)
        )
    lossless = int(np.count_nonzero(sigma > _LOSSLESS * sigma[0]))
    largest_order = int(np.count_nonzero(sigma > _LEAST * sigma[0])) - 1
    orders = balancing.separated_orders(largest_order, _EQUAL)
    r = part.chosen_order(orders, lambda k: float(sigma[k] / sigma[0]))
    full = balancing.truncated(part.realization, lossless)
    equal = int(np.count_nonzero(np.abs(sigma[:lossless] - sigma[r]) <= _EQUAL * sigma[r]))
    reduced = _embedded(full, sigma[:lossless], r, equal)
    bound = float(sigma[r]) + 2 * balancing.tail(r + equal)
    return part.result("Hankel-optimal", reduced, sigma, bound)


def _embedded(balanced: LinearSystem, sigmas: Array, r: int, equal: int) -> LinearSystem:
    """The stable part, r states, of the embedding for sigma = sigmas[r], which `equal` of them share."""
    sigma = float(sigmas[r])
    kept = np.r_[0:r, r + equal : len(sigmas)]
    middle = np.arange(r, r + equal)
    n_inputs, n_outputs = balanced.n_inputs, balanced.n_outputs
    square = max(n_inputs, n_outputs)
    b = np.hstack([balanced.b, np.zeros((balanced.n_states, square - n_inputs))])
    c = np.vstack([balanced.c, np.zeros((square - n_outputs, balanced.n_states))])
    a1, b1, c1, sigma_1 = balanced.a[np.ix_(kept, kept)], b[kept], c[:, kept], sigmas[kept]
    u = _orthogonal_solution(c[:, middle], b[middle])

    # Gamma = root sign root: the change of basis by root keeps the embedding well scaled.
    gamma = sigma_1**2 - sigma**2
    root, sign = np.sqrt(np.abs(gamma)), np.sign(gamma)
    inner = sigma**2 * a1.T + sigma_1[:, None] * a1 * sigma_1 - sigma * c1.T @ u @ b1.T
    a_hat = (sign / root)[:, None] * inner / root
    b_hat = (sign / root)[:, None] * (sigma_1[:, None] * b1 + sigma * c1.T @ u)
    c_hat = (c1 * sigma_1 + sigma * u @ b1.T) / root
    d_hat = -sigma * u
    whole = LinearSystem(
        a_hat, b_hat[:, :n_inputs], c_hat[:n_outputs], balanced.d + d_hat[:n_outputs, :n_inputs]
    )
    stable, _ = split(whole)
    if stable.n_states != r:
        raise ReductionError(
            f"order {r} is too near to round-off for Hankel-optimal reduction: {stable.n_states} stable poles of the "
            f"embedding, expected {r}; choose a smaller order"
        )
    return stable


def _orthogonal_solution(c2: Array, b2: Array) -> Array:
    """U (m, m) orthogonal with C_2^T U = -B_2, for C_2^T C_2 = B_2 B_2^T, (k, k).

    Fixed by that on k directions; on the others, where any would do, the nearest to the identity, so that the result
    does not depend on the states' basis.
    """
    m, k = c2.shape
    left, _, right = np.linalg.svd(-c2 @ b2)
    fixed = min(k, m)
    u = left[:, :fixed] @ right[:fixed]
    others = (np.eye(m) - left[:, :fixed] @ left[:, :fixed].T) @ (np.eye(m) - right[:fixed].T @ right[:fixed])
    left, _, right = np.linalg.svd(others)
    return u + left[:, : m - fixed] @ right[: m - fixed]
