"""Up to which frequency a node cloud carries waves."""

from __future__ import annotations

import numpy as np

from palpate.geometry.cloud import NodeCloud
from palpate.scene.material import Material

NODES_A_WAVELENGTH = 6


def resolved_frequency_hz(cloud: NodeCloud, material: Material) -> float:
    """Frequency, Hz, at which a shear wave is 6 node spacings long where the cloud is coarsest for it.

    The largest spacing counts, because a wave that starts at a fine contact patch has to cross the coarse rest of the
    body. Solves f = sqrt(G |h(2 pi j f)| / rho) / (6 spacing) by fixed-point iteration from the wave speed at rest:
    |h| grows with f and is bounded by the instant factor, so it climbs to the lowest solution.
    """
    relative = cloud.relative_stiffness
    spacing = cloud.spacing if relative is None else cloud.spacing / np.sqrt(relative)
    wavelength = NODES_A_WAVELENGTH * float(spacing.max())
    frequency = 0.0
    while True:
        factor = material.prony.transfer_factor(np.array([2j * np.pi * frequency]))[0]
        speed = np.sqrt(material.shear_modulus_pa * abs(factor) / material.density_kg_per_m3)
        following = float(speed) / wavelength
        if following - frequency <= 1e-12 * following:
            return following
        frequency = following
