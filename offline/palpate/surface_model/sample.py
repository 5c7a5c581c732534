"""The exact compliance of the smallest tool's footprint at a sample of the points, to judge a model by."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from palpate.model_file.surface_model import SAMPLE_SIZE
from palpate.modes.held_body import HeldBody
from palpate.modes.lanczos import LowestModes
from palpate.scene.material import PronySeries
from palpate.surface_model.footprint import on_components
from palpate.surface_model.residual import BLOCK, residual_responses
from palpate.surface_model.ritz_vectors import added

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

_WORKING = 0.75
"""Share of them in working areas."""


@dataclass(frozen=True)
class Sample:
    """Footprints around some points.

    points   (n,), ascending
    working  (n,), whether in a working area
    loads    (c n_nodes, 3 n), unit forces on the footprints
    """

    points: NDArray[np.intp]
    working: NDArray[np.bool_]
    loads: Array


@dataclass(frozen=True)
class Exact:
    """The compliance of the assembled body: static (n, 3, 3), m/N, and at frequencies (n_frequencies, n, 3, 3)."""

    static: Array
    compliance: Complex


def sample_footprints(
    rows: csr_array, footprints: csr_array, free: NDArray[np.intp], working: NDArray[np.intp]
) -> Sample:
    """At random, but the same each time.

    rows           (n_points, n_nodes) as of `residual`, footprints (n_points, n_points)
    free, working  points that are not held, and those of them in working areas
    """
    rng = np.random.default_rng(0)
    others = np.setdiff1d(free, working)
    n_others = min(len(others), SAMPLE_SIZE - min(len(working), int(_WORKING * SAMPLE_SIZE)))
    inside = rng.choice(working, min(len(working), SAMPLE_SIZE - n_others), replace=False)
    points = np.sort(np.concatenate([inside, rng.choice(others, n_others, replace=False)]))
    loads = on_components(csr_array(footprints[points] @ rows)).T.toarray()
    return Sample(points, np.isin(points, working), loads)


def exact_compliance(
    held: HeldBody, modes: LowestModes, sample: Sample, prony: PronySeries, frequencies_hz: Array
) -> Exact:
    """From the equations of the whole body, projected onto all that the loads excite at first.

    That is onto the modes, K⁻¹ p and K⁻¹ M K⁻¹ p of the loads p. The error falls with the fourth power of the frequency over
    that of the highest mode: two terms more are right than with a residual flexibility (moment matching of a block Krylov
    space, Freund 2000).
    """
    parts = [sample.loads[:, i : i + BLOCK] for i in range(0, sample.loads.shape[1], BLOCK)]
    fields = np.hstack([residual_responses(held, modes, part) for part in parts])
    space = added(held, modes, fields, n_powers=1)
    squared_frequencies, rotation = space.ritz(space.ends[-1])
    shapes = (sample.loads.T @ space.vectors @ rotation).reshape(len(sample.points), 3, -1)
    compliance = np.empty((len(frequencies_hz), len(shapes), 3, 3), complex)
    for i, frequency in enumerate(frequencies_hz):
        s = 2j * np.pi * frequency
        h = prony.transfer_factor(np.array([s]))[0]
        compliance[i] = (shapes / (s**2 + h * squared_frequencies)) @ shapes.transpose(0, 2, 1)
    static = np.concatenate([_blocks(part, held.solve(part)) for part in parts])
    return Exact(static, compliance)


def _blocks(a: Array, b: Array) -> Array:
    """(n, 3, 3): aᵀ b of each three columns, symmetric."""
    shape = (len(a), -1, 3)
    blocks = np.einsum("npi,npj->pij", a.reshape(shape), b.reshape(shape))
    return np.asarray((blocks + blocks.transpose(0, 2, 1)) / 2)
