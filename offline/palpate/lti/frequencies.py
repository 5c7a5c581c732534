"""Where to sample frequency responses, and relative errors between them."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from palpate.lti.pole_residue import PoleResidueSystem

Array = NDArray[np.float64]

_SMOOTHING = 0.1
"""Half width of the mean over frequencies, over the frequency."""


def band_frequencies(systems: tuple[PoleResidueSystem, ...], band_hz: tuple[float, float]) -> Array:
    """`frequencies_near` the poles of all the systems."""
    return frequencies_near(np.concatenate([s.poles for s in systems]), band_hz)


def frequencies_near(poles: NDArray[np.complex128], band_hz: tuple[float, float]) -> Array:
    """(n,), rad/s, ascending: both ends of the band, 400 points even in log frequency, and the resonances inside."""
    low, high = 2 * np.pi * band_hz[0], 2 * np.pi * band_hz[1]
    slowest = float(np.min(np.abs(poles), initial=high))
    start = max(low, min(slowest / 100, high / 1000))
    omega = np.concatenate([[low, high], np.geomspace(start, high, 400), poles.imag[poles.imag > 0]])
    return np.unique(omega[(omega >= low) & (omega <= high)])


def all_frequencies(systems: tuple[PoleResidueSystem, ...]) -> Array:
    """(n,), rad/s, ascending: 0, 600 points even in log frequency across all poles, and every resonance."""
    magnitudes = np.concatenate([np.abs(s.poles) for s in systems])
    resonances = np.concatenate([s.poles.imag[s.is_pair] for s in systems])
    slowest, fastest = (
        float(np.min(magnitudes, initial=np.inf)),
        float(np.max(magnitudes, initial=0.0)),
    )
    if fastest == 0:
        return np.zeros(1)
    grid = np.geomspace(slowest / 100, fastest * 100, 600)
    return np.unique(np.concatenate([[0.0], grid, resonances]))


def spectral_norms(matrices: NDArray[np.complex128] | Array) -> Array:
    """(n,): largest singular value of each of the matrices (n, p, m)."""
    if not matrices.size:  # no inputs or no outputs: nothing is amplified
        return np.zeros(len(matrices))
    return np.linalg.norm(matrices, ord=2, axis=(1, 2))


def maximum(function: Callable[[Array], Array], omega: Array, n_peaks: int = 12) -> tuple[float, float]:
    """(omega, value) of the largest value of function, sampled at omega and refined around its highest local maxima.

    function  maps frequencies (n,) to values (n,)
    """
    values = function(omega)
    padded = np.concatenate([[-np.inf], values, [-np.inf]])
    local = np.flatnonzero((values >= padded[:-2]) & (values >= padded[2:]))
    highest = local[np.argsort(values[local])[::-1][:n_peaks]]
    best = int(highest[0])
    best_omega, best_value = float(omega[best]), float(values[best])
    left = omega[np.maximum(highest - 1, 0)]
    right = omega[np.minimum(highest + 1, len(omega) - 1)]
    for _ in range(3):
        points = np.linspace(left, right, 17, axis=1)
        values = function(points.ravel()).reshape(points.shape)
        top = np.argmax(values, axis=1)
        rows = np.arange(len(points))
        leader = int(np.argmax(values[rows, top]))
        if values[leader, top[leader]] > best_value:
            best_omega, best_value = float(points[leader, top[leader]]), float(values[leader, top[leader]])
        left, right = points[rows, np.maximum(top - 1, 0)], points[rows, np.minimum(top + 1, 16)]
    return best_omega, best_value


def relative_errors(full: NDArray[np.complex128] | Array, other: NDArray[np.complex128] | Array) -> Array:
    """(n,): |full - other| / |full|, 2-norms, of responses (n, n_outputs, n_inputs) at the same frequencies.

    Where full is zero: 0 if other is zero as well, else infinite.
    """
    error, gain = spectral_norms(full - other), spectral_norms(full)
    return np.divide(error, gain, out=np.where(error > 0, np.inf, 0.0), where=gain > 0)


def smoothed_response(system: PoleResidueSystem, omega: Array, band_end: float) -> NDArray[np.complex128]:
    """(n, n_outputs, n_inputs): F at s = omega (j + gamma), omega (n,) and band_end in rad/s.

    gamma is 0 in the band and grows to 0.1 at twice its end and beyond: the mean of F over about a tenth of the frequency,
    by a Lorentzian, since F has no poles in the right half plane. Far above the band the narrow peaks and dips of a full
    model are those of its nodes and vectors: two sets of vectors of one body differ there by up to several times
    the force, and by some per cent once it is smoothed (docs/validation.md).
    """
    octaves = np.log2(np.maximum(omega, band_end) / band_end)
    gamma = _SMOOTHING * np.minimum(octaves, 1.0)
    return system.transfer(omega * (1j + gamma))
