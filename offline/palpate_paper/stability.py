"""Whether the modes of a discretization decay, and how much damping would make all of them decay."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from palpate.lti.viscoelastic import mode_poles
from palpate.modes.elastic_modes import ElasticModes
from palpate.scene.material import PronySeries


@dataclass(frozen=True)
class Stability:
    """Stability of the modes of a discretization.

    growing_modes           number of modes with a pole right of the imaginary axis, beyond round-off
    spectral_abscissa_per_s largest real part of all poles, 1/s
    largest_imaginary_part  largest |Im mu| / |mu| of the squared frequencies mu; 0 for a symmetric discretization
    curing_damping_per_s    smallest c, 1/s, with which rho (u'' + c u') lets every elastic mode decay,
                            infinite when one diverges statically (Re mu <= 0)
    """

    growing_modes: int
    spectral_abscissa_per_s: float
    largest_imaginary_part: float
    curing_damping_per_s: float


def stability(modes: ElasticModes, prony: PronySeries) -> Stability:
    """The stability of the modes with the material's memory. s² + c s + mu has both roots on the left when c² Re mu > (Im mu)²."""
    mu = np.asarray(modes.squared_frequencies, dtype=np.complex128)
    size = np.abs(mu)
    round_off = np.finfo(np.float64).eps * size.max()
    real = mode_poles(mu, prony).real.max(axis=1)
    moving = size > 1e3 * round_off  # rigid modes are zero to round-off: neither growing nor curable
    ratio = np.abs(mu.imag[moving]) / size[moving]
    complex_pairs = np.abs(mu.imag) > 1e3 * round_off
    damping = np.where(
        mu.real > 0, np.abs(mu.imag) / np.sqrt(np.maximum(mu.real, np.finfo(np.float64).tiny)), np.inf
    )
    return Stability(
        growing_modes=int(np.sum(real[moving] > 1e-9 * np.sqrt(size[moving]))),
        spectral_abscissa_per_s=float(real.max()),
        largest_imaginary_part=float(ratio.max(initial=0.0)),
        curing_damping_per_s=float(damping[complex_pairs | (moving & (mu.real <= 0))].max(initial=0.0)),
    )
