"""How well the record determines each number: intervals that hold for all of them together."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import t as student

from palpate.fitting.branches import SMALLEST_ERROR, Fit

Array = NDArray[np.float64]

CONFIDENCE = 0.95


@dataclass(frozen=True)
class Interval:
    """A number and the interval around it, which the number's unit applies to."""

    value: float
    low: float
    high: float

    @property
    def factor(self) -> float:
        """How far the ends are from the value, as a factor."""
        return self.high / self.value


@dataclass(frozen=True)
class Estimate:
    """logarithms (p,) of the fitted parameters, their covariance (p, p), and the number of rows they were fitted to."""

    logarithms: Array
    covariance: Array
    n_rows: int


def estimate_of(fit: Fit, correlation_time: float = 1.0) -> Estimate:
    """The covariance follows from the Jacobian and the mean square of the residuals.

    correlation_time  in samples: so many neighboring residuals count as one

    A direction that the record says nothing about gets a variance that makes any interval useless, not an error.
    """
    _, values, vectors = np.linalg.svd(fit.jacobian, full_matrices=False)
    values = np.maximum(values, 1e-9 * values[0])
    covariance = fit.rms**2 * correlation_time * (vectors.T / values**2) @ vectors
    return Estimate(fit.branches.logarithms, covariance, len(fit.residuals))


def correlation_time_of(residuals: Array) -> float:
    """(1 + r) / (1 - r), at least 1: r the correlation of neighboring residuals, unless it is that of chance.

    The mean of n values of a first-order autoregressive process varies as that of n (1 - r) / (1 + r) independent ones.
    """
    if float(np.sqrt(np.mean(residuals**2))) < SMALLEST_ERROR:
        return 1.0  # what the fit leaves there is by intention
    r = float(np.sum(residuals[1:] * residuals[:-1]) / np.sum(residuals**2))
    if r < 3 / np.sqrt(len(residuals)):
        return 1.0
    return (1 + r) / (1 - min(r, 0.999))


def further_branch(fit: Fit, column: Array, correlation_time: float = 1.0) -> float:
    """By how many of its standard deviations the amplitude of one more branch would be positive (a score test).

    column  (n_rows,), what the branch adds to the rows
    """
    new = column - fit.jacobian @ np.linalg.lstsq(fit.jacobian, column, rcond=None)[0]
    size = float(np.linalg.norm(new))
    if size < 1e-6 * float(np.linalg.norm(column)):
        return 0.0  # the fitted branches can do the same
    error = max(fit.rms, SMALLEST_ERROR) * correlation_time**0.5
    return float(-fit.residuals @ new) / (size * error)


def intervals(quantities: Callable[[Array], Array], estimate: Estimate) -> tuple[Interval, ...]:
    """An interval for each quantity, such that all hold together with a probability of at least CONFIDENCE.

    quantities  from the fit's logarithms (p,) to the logarithms of k positive quantities (k,)

    Errors are carried on to first order, as if normal in the logarithm. With the inequality of Bonferroni each of
    k intervals has the confidence 1 - (1 - CONFIDENCE) / k.
    """
    x, h = estimate.logarithms, 1e-5
    center = quantities(x)
    slopes = np.array([quantities(x + step) - quantities(x - step) for step in h * np.eye(len(x))]) / (2 * h)
    deviations = np.sqrt(np.einsum("ik,ij,jk->k", slopes, estimate.covariance, slopes))
    freedom = max(estimate.n_rows - len(x), 1)
    reach = float(student.isf((1 - CONFIDENCE) / (2 * len(center)), freedom)) * deviations
    reach = np.minimum(reach, 50.0)  # e^50: no information
    return tuple(
        Interval(float(np.exp(c)), float(np.exp(c - r)), float(np.exp(c + r)))
        for c, r in zip(center, reach, strict=True)
    )
