"""How much energy a discrete force response can give out over closed pokes.

A poke u_k = Re(a e^{j theta k}), theta = omega T, is back at its start after 2 pi / theta samples. A device that
renders the force samples does the work of the trapezoidal sum of (F_k + F_{k+1})/2 . (u_{k+1} - u_k) on the tissue. With
F_k = Re(G a e^{j theta k}) the mean of one summand is 1/4 Re[(G a)^H a (1 + e^{-j theta})(e^{j theta} - 1)], and as the
product of the brackets is 2j sin(theta), the work of one closed poke is

    W = pi sin(theta)/theta  a^H (G - G^H)/(2j) a.

So the tissue dissipates at theta where the Hermitian matrix (G - G^H)/2j is positive semidefinite; the weight
sin(theta)/theta is positive below the Nyquist frequency.
"""

from __future__ import annotations

import numpy as np
import scipy.optimize
from numpy.typing import NDArray

from palpate.lti.frequencies import maximum, spectral_norms
from palpate.lti.pole_residue import PoleResidueSystem

Array = NDArray[np.float64]

_NEGLIGIBLE = 1e-3
"""Dissipation below zero that does not count, over the static stiffness."""


def passivity_margin(discrete: PoleResidueSystem) -> float:
    """Smallest eigenvalue of (G - G^H)/2j over all frequencies, over |G(1)|, the static stiffness.

    discrete  the discrete response G(z), z = e^{j omega T}. Zero or above (but for round-off): no closed sinusoidal
              poke gets energy out.
    """
    _, worst = maximum(lambda theta: -_least_dissipation(discrete, theta), _angles(discrete))
    return -worst / float(spectral_norms(discrete.transfer(np.ones(1, dtype=np.complex128)))[0])


def passive_up_to(discrete: PoleResidueSystem) -> float:
    """Angle per sample, 0..pi, below which no sinusoidal poke gets energy out; pi where none does at any angle.

    Less than a thousandth of the static stiffness does not count: a reduction that is not exactly symmetric gives that
    much to a slow circular poke.
    """
    theta = _angles(discrete)
    static = float(spectral_norms(discrete.transfer(np.ones(1, dtype=np.complex128)))[0])
    active = np.flatnonzero(_least_dissipation(discrete, theta) < -_NEGLIGIBLE * static)
    if not len(active):
        return float(np.pi)
    if active[0] == 0:
        return 0.0

    def excess(angle: float) -> float:
        return float(_least_dissipation(discrete, np.array([angle]))[0]) + _NEGLIGIBLE * static

    return float(scipy.optimize.brentq(excess, theta[active[0] - 1], theta[active[0]]))


def largest_energy_out(discrete: PoleResidueSystem, amplitude_m: float) -> float:
    """Largest work, J, that one closed sinusoidal poke of |a| = amplitude_m gets out; 0 where no poke gets any."""

    def energy(theta: Array) -> Array:
        return -np.pi * np.sinc(theta / np.pi) * _least_dissipation(discrete, theta)

    return max(0.0, maximum(energy, _angles(discrete))[1]) * amplitude_m**2


def _least_dissipation(discrete: PoleResidueSystem, theta: Array) -> Array:
    """(n,): smallest eigenvalue of (G - G^H)/2j at the angles theta (n,); 0 without inputs."""
    g = discrete.transfer(np.exp(1j * theta))
    eigenvalues = np.linalg.eigvalsh((g - np.conj(np.swapaxes(g, 1, 2))) / 2j)
    return np.asarray(np.min(eigenvalues, axis=1, initial=np.inf if g.shape[1] else 0.0))


def _angles(discrete: PoleResidueSystem) -> Array:
    """(n,), ascending in 0..pi: statics, 1,000 points even in the logarithm, 200 even ones, and all resonances."""
    slowest = float(np.min(np.abs(1 - discrete.poles), initial=1.0))
    resonances = np.angle(discrete.poles[discrete.is_pair])
    grid = np.geomspace(min(slowest / 100, 1e-3), np.pi, 1000)
    return np.unique(np.concatenate([[0.0], grid, np.linspace(0, np.pi, 200), resonances]))
