"""How many modes a surface model keeps, so that the residual flexibility is good enough in the band."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from palpate.modes.held_body import HeldBody
from palpate.modes.lanczos import LowestModes, lowest_modes
from palpate.progress import Progress
from palpate.scene.material import Material
from palpate.surface_model.evidence import Footprints, error_bound
from palpate.surface_model.footprint import on_components
from palpate.surface_model.residual import residual_responses

Array = NDArray[np.float64]

_SAMPLE = 48
"""Footprints of which the error decides."""

_SAFETY = 0.9
"""The sample's largest error over the tolerance: of all points some have a larger one."""

_FIRST_GUESS = 2.4
"""Frequency of the highest mode over the end of the band where the tolerance is 5 %; the error falls with its square. On the
liver with a tip of 5 mm the worst bound was 13 % at 1.46."""

_MOST_ROUNDS = 4
_SPARE = 1.1
_JUDGED = 24


def guessed_modes(
    material: Material, volume_m3: float, area_m2: float, band_end_hz: float, tolerance: float
) -> int:
    """By Weyl's law with its term for the free surface: V k³ / (3 pi²) + 3 A k² / (16 pi), k of shear waves."""
    frequency = _FIRST_GUESS * band_end_hz * np.sqrt(0.05 / tolerance)
    speed = np.sqrt(material.shear_modulus_pa / material.density_kg_per_m3)
    k = 2 * np.pi * frequency / speed
    return max(1, int(volume_m3 * k**3 / (3 * np.pi**2) + 3 * area_m2 * k**2 / (16 * np.pi)))


@dataclass(frozen=True)
class Sample:
    """The exact static compliance of some footprints.

    points      (n_sample,), their indices
    loads       (c n_nodes, 3 n_sample), unit forces on the footprints
    """

    points: NDArray[np.intp]
    loads: Array


def sample_footprints(rows: csr_array, footprints: csr_array, free: NDArray[np.intp]) -> Sample:
    """Of footprints around free points, at random but the same each time. rows (n_points, n_nodes) as of `residual`."""
    rng = np.random.default_rng(0)
    points = np.sort(rng.choice(free, min(_SAMPLE, len(free)), replace=False))
    return Sample(points, on_components(csr_array(footprints[points] @ rows)).T.toarray())


def enough_modes(
    held: HeldBody,
    sample: Sample,
    material: Material,
    frequencies_hz: Array,
    tolerance: float,
    guess: int,
    progress: Progress,
) -> LowestModes:
    """The fewest modes with which the error bound at the sample stays below 0.9 of the tolerance in the band.

    Raises ValueError where the body has too few.
    """
    n_parameters = held.body.stiffness.shape[0]
    most = n_parameters - held.body.n_components * len(held.nodes)
    count = min(guess, most)
    for _ in range(_MOST_ROUNDS):
        progress.note(f"{count:,} modes")
        modes = lowest_modes(held, count)
        counts, errors = _errors_of_fewer(held, modes, sample, material, frequencies_hz)
        good = np.flatnonzero(errors <= _SAFETY * tolerance)
        if len(good):
            kept = int(counts[good[0]])
            return LowestModes(modes.squared_frequencies[:kept], modes.parameters[:, :kept])
        if count == most:
            break
        # The error falls with the square of the highest frequency, the number of modes grows with its cube.
        grown = min(4.0, float(errors[-1]) / (_SAFETY * tolerance)) ** 1.5
        count = min(most, int(count * max(1.2, _SPARE * grown)))
    raise ValueError(
        f"surface.tolerance = {tolerance:g}: {len(modes.squared_frequencies):,} modes reach {errors[-1]:.2g}; expected a larger "
        "tolerance or a narrower band"
    )


def _errors_of_fewer(
    held: HeldBody, modes: LowestModes, sample: Sample, material: Material, frequencies_hz: Array
) -> tuple[NDArray[np.intp], Array]:
    """Numbers of modes that reach beyond the band, ascending, and the largest error bound at the sample with each."""
    mu = modes.squared_frequencies
    beyond = int(np.searchsorted(np.sqrt(mu), 1.01 * 2 * np.pi * frequencies_hz[-1])) + 1
    if beyond > len(mu):
        return np.array([len(mu)]), np.array([np.inf])
    counts = np.unique(np.linspace(beyond, len(mu), _JUDGED).astype(np.intp))
    left = residual_responses(held, modes, sample.loads)
    moved = held.body.inertia(left)
    shapes = (sample.loads.T @ modes.parameters).reshape(-1, 3, len(mu))
    residual, inertia = _blocks(sample.loads, left), _blocks(left, moved)
    errors = np.empty(len(counts))
    for i, count in enumerate(counts):
        kept, dropped = shapes[:, :, :count], shapes[:, :, count:]
        more = dropped / mu[count:] @ dropped.transpose(0, 2, 1)
        more_inertia = dropped / mu[count:] ** 2 @ dropped.transpose(0, 2, 1)
        fewer = Footprints(kept, residual + more, inertia + more_inertia, mu[:count])
        errors[i] = error_bound(fewer, material.prony, frequencies_hz).max()
    return counts, errors


def _blocks(a: Array, b: Array) -> Array:
    """(n, 3, 3): aᵀ b of each three columns, symmetric."""
    shape = (len(a), -1, 3)
    blocks = np.einsum("npi,npj->pij", a.reshape(shape), b.reshape(shape))
    return (blocks + blocks.transpose(0, 2, 1)) / 2
