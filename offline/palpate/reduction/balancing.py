"""Balancing by square roots of Gramians: Hankel singular values and the projections of every order."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from palpate.reduction.linear_system import LinearSystem

Array = NDArray[np.float64]

# Hankel singular values below it, relative to the largest, are round-off.
NOISE_FLOOR = 1e-13


class Realization(Protocol):
    """What balancing needs of a system E dx/dt = A x + B u, y = C x + D u."""

    @property
    def b(self) -> Array: ...
    @property
    def c(self) -> Array: ...
    @property
    def d(self) -> Array: ...
    def apply(self, x: Array) -> Array:
        """A x for x (n, k)."""

    def mass(self, x: Array) -> Array:
        """E x for x (n, k)."""


@dataclass(frozen=True)
class Gramians:
    """Factors of the two Gramians, control control^T and E^T observe observe^T E.

    control (n, k), observe (n, l)
    missing    what the Hankel singular values can differ by in sum from those of the whole Gramians; of low-rank
               factors of a sparse system an estimate
    symmetric  whether observe is control times signs, so that observe^T E control is symmetric
    """

    control: Array
    observe: Array
    missing: float = 0.0
    symmetric: bool = False


@dataclass(frozen=True)
class Balancing:
    """Projections W = observe left / sqrt(sigma), T = control right / sqrt(sigma), W^T E T = I.

    sigma  (k,), the Hankel singular values, largest first (of the Gramians that were balanced)
    """

    gramians: Gramians
    left: Array
    sigma: Array
    right: Array

    @property
    def rank(self) -> int:
        """Number of singular values above round-off."""
        largest = float(np.max(self.sigma, initial=0.0))
        return int(np.count_nonzero(self.sigma > NOISE_FLOOR * largest))

    def truncated(self, system: Realization, order: int) -> LinearSystem:
        """The balanced realization's first `order` states, 0 <= order <= rank."""
        scale = 1 / np.sqrt(self.sigma[:order])
        w = self.gramians.observe @ (self.left[:, :order] * scale)
        t = self.gramians.control @ (self.right[:, :order] * scale)
        return LinearSystem(w.T @ system.apply(t), w.T @ system.b, system.c @ t, system.d)

    def tail(self, order: int) -> float:
        """The sum of all Hankel singular values beyond the first `order`, as sure as `Gramians.missing`."""
        return float(np.sum(self.sigma[order:])) + self.gramians.missing

    def separated_orders(self, largest: int, gap: float) -> NDArray[np.intp]:
        """0 and the orders r up to largest, at most the rank, with sigma_r - sigma_{r+1} > gap sigma_{r+1}, ascending."""
        orders = np.arange(1, largest + 1)
        following = np.append(self.sigma, 0.0)[orders]
        apart = self.sigma[orders - 1] - following > gap * following
        return np.concatenate([[0], orders[apart]]).astype(np.intp)

    def relative_to_largest(self, value: float) -> float:
        """value / sigma_1; where no state is reached and seen, so that there is no sigma_1 above 0: 0."""
        return value / float(self.sigma[0]) if self.rank else 0.0


def balance(system: Realization, gramians: Gramians) -> Balancing:
    """Singular value decomposition of observe^T E control (Tombs & Postlethwaite 1987)."""
    hankel = gramians.observe.T @ system.mass(gramians.control)
    if gramians.symmetric:  # eigenvalues do for singular values
        values, vectors = np.linalg.eigh(hankel)
        descending = np.argsort(np.abs(values))[::-1]
        values, right = values[descending], vectors[:, descending]
        return Balancing(gramians, right * np.where(values < 0, -1.0, 1.0), np.abs(values), right)
    left, sigma, right_transposed = np.linalg.svd(hankel, full_matrices=False)
    return Balancing(gramians, left, sigma, right_transposed.T)


def missing_in_sum(control: tuple[float, float], observe: tuple[float, float]) -> float:
    """How far in sum the singular values of factors can be from the whole's, from (trace, trace left out) of each Gramian.

    With P = L L^T + R and Q likewise, the factors of the whole have more blocks, whose nuclear norms are at most the
    products of Frobenius norms, and singular values differ in sum by no more than that (Mirsky 1960).
    """
    (p, p_rest), (q, q_rest) = control, observe
    return math.sqrt(q * p_rest) + math.sqrt(p * q_rest) + math.sqrt(p_rest * q_rest)
