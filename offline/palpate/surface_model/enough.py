"""How many Ritz vectors a surface model has beside its modes: as many as its tolerance needs."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from palpate.modes.held_body import HeldBody
from palpate.modes.lanczos import LowestModes
from palpate.progress import Progress
from palpate.scene.material import Material
from palpate.surface_model.ritz_vectors import Added, added

Array = NDArray[np.float64]

_STEP = 24
"""Vectors from one number that is tried to the next."""

_GROWTH = 1.6
_MOST = 3000


def guessed_vectors(material: Material, area_m2: float, band_end_hz: float) -> int:
    """For a working area: as many waves along it, of three directions, as are not much shorter than those of the band."""
    speed = np.sqrt(material.shear_modulus_pa / material.density_kg_per_m3)
    k = 1.7 * 2 * np.pi * band_end_hz / speed
    return int(64 + 6 * area_m2 * k**2 / (4 * np.pi))


def enough_vectors(
    held: HeldBody,
    modes: LowestModes,
    fields: Callable[[int], Array],
    error: Callable[[Added, int], float],
    tolerance: float,
    guess: int,
    progress: Progress,
) -> LowestModes:
    """The modes, and the Ritz modes of the fewest fields with which the error keeps to the tolerance.

    fields  gives so many fields (c n_nodes, n), the most important first
    error   of a model with so many vectors behind its modes
    guess   about how many there will be

    Raises ValueError where 3,000 or all that there are do not suffice.
    """
    count = guess
    while True:
        space = added(held, modes, fields(count), block=_STEP)
        for end in (0, *space.ends):
            largest = error(space, end)
            progress.note(f"{end} vectors, {100 * largest:.2g} %")
            if largest <= tolerance:
                return space.ritz_modes(end)
        if space.ends[-1] < count or count >= _MOST:
            raise ValueError(
                f"surface.tolerance: {space.ends[-1]:,} vectors reach {largest:.2g} at a sample of the points, "
                f"{tolerance:.2g} is needed; expected a larger tolerance or a narrower band"
            )
        count = min(_MOST, int(_GROWTH * count))
