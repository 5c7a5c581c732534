"""Non-negative branches of a record: found on log-spaced time constants, then refined, then as few as the record needs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares, nnls

from palpate.fitting.equations import Equations

Array = NDArray[np.float64]

_TIMES_PER_DECADE = 10
SMALLEST_ERROR = 3e-3
"""An error of this fraction of the record is as good as none: no branch is added for less. No hand feels it."""


@dataclass(frozen=True)
class Branches:
    """amplitudes (1 + n,), the one without a time constant first, and times (n,), s, rising."""

    amplitudes: Array
    times: Array

    @property
    def logarithms(self) -> Array:
        """(1 + 2 n,): the parameters in which the fit is done."""
        return np.log(np.concatenate([self.amplitudes, self.times]))


@dataclass(frozen=True)
class Fit:
    """Branches and how they fit.

    residuals  (n_rows,), relative to the record's size
    jacobian   (n_rows, 1 + 2 n), of the modelled values by the logarithms
    bic        Bayesian information criterion, the lower the better
    """

    branches: Branches
    residuals: Array
    jacobian: Array
    bic: float

    @property
    def rms(self) -> float:
        """Root mean square of the residuals, with the parameters taken off the number of rows."""
        n, p = self.jacobian.shape
        return float(np.sqrt(np.sum(self.residuals**2) / max(n - p, 1)))


def fit_branches(equations: Equations) -> Fit:
    """The branches with the lowest BIC.

    Non-negative least squares on a grid of time constants gives too many branches, since noise makes some. From these,
    that branch is removed, or those two neighbors are merged, that the record misses least; amplitudes and
    time constants are refined; and so on, until none is left or three in a row were no better.
    BIC = n ln(mean square + SMALLEST_ERROR²) + p ln n (G. Schwarz, Ann. Stat. 6, 1978) of n rows and p parameters
    chooses among them.
    """
    best = fit = _refined(equations, _on_grid(equations))
    no_better = 0
    while len(fit.branches.times) and no_better < 3:
        fit = _refined(equations, _one_less(equations, fit.branches))
        no_better = 0 if fit.bic <= best.bic else no_better + 1
        best = fit if fit.bic <= best.bic else best
    return best


def _triangle(columns: Array, values: Array) -> Array:
    """A triangular factor of columns and values: it gives the same least squares as the rows, which are many more."""
    return np.asarray(np.linalg.qr(np.column_stack([columns, values]), mode="r"))


def _non_negative(columns: Array, values: Array) -> tuple[Array, float]:
    """Amplitudes >= 0 and the norm of the residual."""
    scale = np.linalg.norm(columns, axis=0)
    scale[scale == 0] = 1.0
    amplitudes, residual = nnls(columns / scale, values)
    return amplitudes / scale, float(residual)


def _on_grid(equations: Equations) -> Branches:
    low, high = np.log10(equations.extent_s)
    grid = np.logspace(low, high, int(np.ceil((high - low) * _TIMES_PER_DECADE)) + 1)
    triangle = _triangle(equations.columns(grid), equations.values)
    amplitudes, _ = _non_negative(triangle[:, :-1], triangle[:, -1])
    found = np.flatnonzero(amplitudes[1:] > 0)
    # A time constant between two of the grid is found as both; a continuous spectrum as a long run of neighbors.
    runs = np.split(found, np.flatnonzero(np.diff(found) > 1) + 1) if len(found) else []
    clusters = [run[i : i + 2] for run in runs for i in range(0, len(run), 2)]
    sums = [float(np.sum(amplitudes[1 + c])) for c in clusters]
    times = [np.exp(np.average(np.log(grid[c]), weights=amplitudes[1 + c])) for c in clusters]
    return Branches(np.array([amplitudes[0], *sums]), np.array(times))


def _one_less(equations: Equations, branches: Branches) -> Branches:
    """Of all ways to have one branch less, the one with the smallest residual."""
    times, weights = np.log(branches.times), branches.amplitudes[1:]
    n = len(times)
    merged = (weights[:-1] * times[:-1] + weights[1:] * times[1:]) / (weights[:-1] + weights[1:])
    triangle = _triangle(equations.columns(np.exp(np.concatenate([times, merged]))), equations.values)
    keep = [[i for i in range(n) if i != j] for j in range(n)]
    keep += [[i for i in range(n) if i not in (j, j + 1)] + [n + j] for j in range(n - 1)]
    best, least = branches, np.inf
    for chosen in keep:
        columns = triangle[:, [0, *(1 + i for i in chosen)]]
        amplitudes, residual = _non_negative(columns, triangle[:, -1])
        if residual < least:
            least = residual
            best = Branches(amplitudes, np.exp(np.concatenate([times, merged])[chosen]))
    return best


def _refined(equations: Equations, start: Branches) -> Fit:
    """Amplitudes and time constants by nonlinear least squares in their logarithms, within the extent of times."""
    n = len(start.times)
    size = float(np.max(start.amplitudes))
    smallest = 1e-8 * size
    low = np.concatenate([np.full(1 + n, np.log(smallest)), np.full(n, np.log(equations.extent_s[0]))])
    high = np.concatenate([np.full(1 + n, np.log(1e8 * size)), np.full(n, np.log(equations.extent_s[1]))])
    amplitudes = np.maximum(start.amplitudes, 1e-4 * size)  # at zero a logarithm has no slope
    first = np.concatenate([np.log(amplitudes), np.log(start.times)])

    def residuals(x: Array) -> Array:
        modelled = equations.columns(np.exp(x[1 + n :])) @ np.exp(x[: 1 + n])
        return np.asarray(modelled - equations.values)

    def jacobian(x: Array) -> Array:
        return _jacobian(equations, x)

    found = least_squares(
        residuals,
        np.clip(first, low + 1e-9, high - 1e-9),
        jac=jacobian,
        bounds=(low, high),
        xtol=1e-10,
        ftol=1e-10,
        gtol=1e-12,
        max_nfev=60,
    )
    order = np.argsort(found.x[1 + n :])
    x = found.x[np.concatenate([[0], 1 + order, 1 + n + order])]
    rows, missed = len(equations.values), residuals(x)
    square = float(np.mean(missed**2))
    bic = rows * np.log(square + SMALLEST_ERROR**2) + len(x) * np.log(rows)
    return Fit(Branches(np.exp(x[: 1 + n]), np.exp(x[1 + n :])), missed, jacobian(x), float(bic))


def _jacobian(equations: Equations, x: Array) -> Array:
    n, h = len(x) // 2, 1e-4
    amplitudes, times = np.exp(x[: 1 + n]), np.exp(x[1 + n :])
    shifted = np.concatenate([times, times * np.exp(h), times * np.exp(-h)])
    columns = equations.columns(shifted)
    by_time = (columns[:, 1 + n : 1 + 2 * n] - columns[:, 1 + 2 * n :]) / (2 * h)
    return np.column_stack([amplitudes * columns[:, : 1 + n], amplitudes[1:] * by_time])
