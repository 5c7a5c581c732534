"""The modes that a body's model is made of: all of a small one, Ritz modes of a large one."""

from __future__ import annotations

import os
from dataclasses import dataclass

import numpy as np

from palpate.discretization.assembled_body import AssembledBody
from palpate.factorization import solver_name
from palpate.modes.dense import dense_memory, elastic_modes
from palpate.modes.elastic_modes import ElasticModes
from palpate.modes.ritz import ritz_modes
from palpate.scene.material import PronySeries

ALL_MODES_UP_TO = 2000
"""Nodes up to which all modes of a symmetric body are computed; a collocated body has no other way."""

TOLERANCE = 1e-3
"""Change of the force over the last 60 Ritz vectors of a patch, where no more are added."""

_ABOVE_THE_BAND = 5.0
STEPS_ABOVE_THE_BAND = 40
STEPS_EXPECTED = 80
"""Steps at 0 Hz that are usual: 240 vectors of one patch."""

_FREQUENCIES = 60


@dataclass(frozen=True)
class BodyModes:
    """Modes, and what the build says about them.

    change  largest change of the force in the band over the last 60 Ritz vectors of a patch, relative; 0 for all modes
    solver  the direct solver, "LAPACK" for all modes
    """

    modes: ElasticModes
    change: float
    solver: str


def body_modes(body: AssembledBody, prony: PronySeries, band_end_hz: float) -> BodyModes:
    """All modes up to 2,000 nodes and of a body that is not symmetric, else Ritz modes.

    The Ritz modes are made of static responses until the force changes by at most 0.1 % up to the band's end, and of
    responses at a real shift of 5 times that frequency, by which the force above the band is right too.

    Raises MemoryError where the machine has too little; LinAlgError where nothing holds the body.
    """
    if not by_ritz(body.n_nodes, body.symmetric):
        return BodyModes(elastic_modes(body), 0.0, "LAPACK")
    even, slow = np.linspace(0, band_end_hz, _FREQUENCIES), np.geomspace(1e-2, 1, _FREQUENCIES)
    s = 2j * np.pi * np.concatenate([even, slow * band_end_hz])
    sigma = (2 * np.pi * _ABOVE_THE_BAND * band_end_hz) ** 2
    found = ritz_modes(
        body, s**2 / prony.transfer_factor(s), TOLERANCE, shifts=[(sigma, STEPS_ABOVE_THE_BAND)]
    )
    return BodyModes(found.modes, found.change, found.solver)


def by_ritz(n_nodes: int, symmetric: bool) -> bool:
    """Whether a body gets Ritz modes."""
    return symmetric and n_nodes > ALL_MODES_UP_TO


def require_memory(
    n_nodes: int, n_free: int, n_contacts: int, symmetric: bool, support_radius_factor: float
) -> None:
    """Raise MemoryError where the modes of a solid need more memory than the machine has: to be asked before assembly.

    n_free  nodes that are neither held nor in a patch
    """
    ritz = by_ritz(n_nodes, symmetric)
    if ritz:
        needed = ritz_memory(n_nodes, n_contacts, support_radius_factor)
    else:
        needed = dense_memory(n_nodes, n_free, 3, symmetric)
    present = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    if needed > present:
        raise MemoryError(
            f"{'Ritz' if ritz else 'all'} modes of {n_nodes:,} nodes need about {needed / 2**30:.1f} GiB, this machine has "
            f"{present / 2**30:.1f}: use a coarser cloud, graded towards the contact patches"
        )


def ritz_memory(n_nodes: int, n_contacts: int, support_radius_factor: float) -> float:
    """Bytes at the peak of the Ritz modes of a solid, the process included.

    By runs with 1,753 to 31,666 nodes: the stiffness matrix has up to 9 * 228 n entries and the factor 37 n^1.6 at a
    support radius of 2.2 spacings; 0.45 and 0.6 times as many at 1.8. Before the factor is made there are five copies of
    the matrix, beside it three. SuperLU keeps both triangles, and needs as much again while it works.
    """
    stiffness = stiffness_memory(n_nodes, support_radius_factor)
    factor = factor_memory(n_nodes, support_radius_factor)
    vectors = 2 * 8 * 3 * n_nodes * (STEPS_EXPECTED + STEPS_ABOVE_THE_BAND) * 3 * n_contacts
    return 0.5 * 2**30 + max(5 * stiffness, 3 * stiffness + factor + vectors)


def stiffness_memory(n_nodes: int, support_radius_factor: float) -> float:
    """Bytes of the stiffness matrix of a solid, as measured for `ritz_memory`."""
    return 12 * 9 * 228 * n_nodes * (support_radius_factor / 2.2) ** 4


def factor_memory(n_nodes: int, support_radius_factor: float) -> float:
    """Bytes of its sparse factor while it is made, as measured for `ritz_memory`."""
    entries = 37 * n_nodes**1.6 * (support_radius_factor / 2.2) ** 2.5
    return 8 * entries * (1 if solver_name() == "MKL PARDISO" else 4)
