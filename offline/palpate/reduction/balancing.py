"""Balancing by square roots of Gramians: Hankel singular values and the balanced realization of every order."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from palpate.reduction.gramians import Gramians, RealForm

Array = NDArray[np.float64]

# Hankel singular values below it, relative to the largest, are round-off.
NOISE_FLOOR = 1e-13


class Matrices(NamedTuple):
    """dx/dt = A x + B u, y = C x + D u: a (n, n), b (n, n_inputs), c (n_outputs, n), d (n_outputs, n_inputs)."""

    a: Array
    b: Array
    c: Array
    d: Array


@dataclass(frozen=True)
class Balancing:
    """Projections W = observe left / sqrt(sigma), T = control right / sqrt(sigma), W^T T = I.

    sigma  (k,), the Hankel singular values, largest first (of the Gramians that were balanced)
    """

    form: RealForm
    gramians: Gramians
    left: Array
    sigma: Array
    right: Array

    @property
    def rank(self) -> int:
        """Number of singular values above round-off."""
        return self.count_above(NOISE_FLOOR)

    def count_above(self, ratio: float) -> int:
        """Number of singular values above `ratio` times the largest."""
        return int(np.count_nonzero(self.sigma > ratio * np.max(self.sigma, initial=0.0)))

    def truncated(self, order: int) -> Matrices:
        """The balanced realization's first `order` states, 0 <= order <= rank."""
        scale = 1 / np.sqrt(self.sigma[:order])
        w = self.gramians.observe @ (self.left[:, :order] * scale)
        t = self.gramians.control @ (self.right[:, :order] * scale)
        return Matrices(w.T @ self.form.apply(t), w.T @ self.form.b, self.form.c @ t, self.form.d)

    def tail(self, order: int) -> float:
        """The sum of all Hankel singular values beyond the first `order`, with `Gramians.missing` added."""
        return float(np.sum(self.sigma[order:])) + self.gramians.missing

    def separated_orders(self, largest: int, gap: float) -> NDArray[np.intp]:
        """0 and the orders r up to largest, at most the rank, with sigma_r - sigma_{r+1} > gap sigma_{r+1}, ascending."""
        orders = np.arange(1, largest + 1)
        following = np.append(self.sigma, 0.0)[orders]
        apart = self.sigma[orders - 1] - following > gap * following
        return np.concatenate([[0], orders[apart]]).astype(np.intp)


def balance(form: RealForm, gramians: Gramians) -> Balancing:
    """Singular value decomposition of observe^T control (Tombs & Postlethwaite 1987)."""
    hankel = gramians.observe.T @ gramians.control
    if gramians.symmetric:  # eigenvalues do for singular values
        values, vectors = np.linalg.eigh(hankel)
        descending = np.argsort(np.abs(values))[::-1]
        values, right = values[descending], vectors[:, descending]
        return Balancing(form, gramians, right * np.where(values < 0, -1.0, 1.0), np.abs(values), right)
    left, sigma, right_transposed = np.linalg.svd(hankel, full_matrices=False)
    return Balancing(form, gramians, left, sigma, right_transposed.T)
