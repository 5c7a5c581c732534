"""The modes that a body's model is made of: all of a small one, Ritz modes of a large one."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from palpate.discretization.assembled_body import AssembledBody
from palpate.factorization import solver_name
from palpate.modes.elastic_modes import ElasticModes
from palpate.modes.ritz import StaticSpace, ritz_modes
from palpate.scene.material import Material

ALL_MODES_UP_TO = 2000
"""Nodes up to which all modes of a symmetric body are computed; a collocated body has no other way."""

TOLERANCE = 1e-3
"""Change of the force over the last 60 Ritz vectors of a patch, where no more are added. The error in the band is then much
smaller; above it, the vectors decide how far the smoothed force is right (docs/validation.md)."""

STEPS_EXPECTED = 80
"""Steps at 0 Hz that are usual: 240 vectors of one patch."""

_FREQUENCIES = 60


@dataclass(frozen=True)
class BodyModes:
    """Ritz modes, and what the build says about them.

    change  largest change of the force in the band over the last 60 Ritz vectors of a patch, relative
    space   the Krylov vectors at 0 Hz, which serve other bands and materials too
    """

    modes: ElasticModes
    change: float
    space: StaticSpace


def ritz_body_modes(
    body: AssembledBody, material: Material, band_end_hz: float, known: StaticSpace | None = None
) -> BodyModes:
    """Ritz modes: static responses until the force changes by at most 0.1 % up to the band's end.

    body   symmetric, assembled with `material.unit`
    known  the space of another band or material

    Raises MemoryError where the machine has too little; LinAlgError where nothing holds the body.
    """
    even, slow = np.linspace(0, band_end_hz, _FREQUENCIES), np.geomspace(1e-2, 1, _FREQUENCIES)
    s = 2j * np.pi * np.concatenate([even, slow * band_end_hz])
    unit = material.density_kg_per_m3 / material.youngs_modulus_pa  # frequencies count in sqrt(E / rho)
    found = ritz_modes(body, s**2 / material.prony.transfer_factor(s) * unit, TOLERANCE, known)
    scaled = found.modes.scaled(material.youngs_modulus_pa, material.density_kg_per_m3)
    return BodyModes(scaled, found.change, found.space)


def by_ritz(n_nodes: int, symmetric: bool) -> bool:
    """Whether a body gets Ritz modes."""
    return symmetric and n_nodes > ALL_MODES_UP_TO


def stiffness_memory(n_nodes: int, support_radius_factor: float) -> float:
    """Bytes of the stiffness matrix of a solid, as measured with 1,753 to 31,666 nodes."""
    return 12 * 9 * 228 * n_nodes * (support_radius_factor / 2.2) ** 4


def factor_memory(n_nodes: int, support_radius_factor: float) -> float:
    """Bytes of its sparse factor while it is made, as measured with 1,753 to 31,666 nodes.

    Nested dissection by planes fills more than METIS, and beside the fronts there is what they add to each other.
    """
    entries = 37 * n_nodes**1.6 * (support_radius_factor / 2.2) ** 2.5
    return 8 * entries * (1 if solver_name() == "MKL PARDISO" else 3)
