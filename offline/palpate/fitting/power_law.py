"""A power law of the frequency as a few branches."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

from palpate.scene.material import PronySeries

_BEYOND = np.geomspace(1.0, 5.0, 21)
"""Factors by which the branches may reach beyond the band at both ends, for the relaxation outside of it; the best is taken."""
_POINTS_PER_DECADE = 50


@dataclass(frozen=True)
class PowerLaw:
    """The modulus (i f)^exponent, f in Hz, whose magnitude is 1 at 1 Hz, as branches.

    rest   modulus at rest: what relaxes slower than the band counts as at rest
    prony  the branches, relative to `rest`
    error  largest relative error of the complex modulus in the band
    """

    rest: float
    prony: PronySeries
    error: float


def power_law(exponent: float, band_hz: tuple[float, float], n_branches: int = 5) -> PowerLaw:
    """Fit branches with log-spaced time constants by non-negative least squares of the relative error.

    The loss tangent of the law is tan(exponent pi / 2) at every frequency. Raises ValueError for an exponent outside of 0 to 1,
    for a band that does not rise, and where the branches can't be those of a solid.
    """
    low, high = band_hz
    if not 0 < exponent < 1:
        raise ValueError(f"exponent = {exponent}: expected between 0 and 1")
    if not 0 < low < high:
        raise ValueError(f"band_hz = [{low}, {high}]: expected 0 < low < high")
    f = np.geomspace(low, high, 2 + round(_POINTS_PER_DECADE * np.log10(high / low)))
    fits = (
        _fitted(
            f, exponent, np.geomspace(1 / (2 * np.pi * high * reach), reach / (2 * np.pi * low), n_branches)
        )
        for reach in _BEYOND
    )
    solids = [fit for fit in fits if fit is not None]
    if not solids:
        raise ValueError(
            f"{n_branches} branches leave no modulus at rest: expected more of them, or a narrower band"
        )
    return min(solids, key=lambda fit: fit.error)


def _fitted(f: NDArray[np.float64], exponent: float, tau: NDArray[np.float64]) -> PowerLaw | None:
    """None where nothing is left at rest."""
    z = 2j * np.pi * f[:, None] * tau
    columns = np.column_stack([np.ones(len(f)), z / (1 + z)]) / ((1j * f) ** exponent)[:, None]
    amplitudes, _ = nnls(_real(columns), _real(np.ones(len(f), complex)))
    if amplitudes[0] == 0:
        return None
    error = np.max(np.abs(columns @ amplitudes - 1))
    used = amplitudes[1:] > 0
    gamma = amplitudes[1:][used] / amplitudes[0]
    prony = PronySeries(tuple(map(float, gamma)), tuple(map(float, tau[used])))
    return PowerLaw(float(amplitudes[0]), prony, float(error))


def _real(values: NDArray[np.complex128]) -> NDArray[np.float64]:
    return np.concatenate([values.real, values.imag])
