"""How many modes a surface model keeps: all whose resonances lie in the band, and some beyond it."""

from __future__ import annotations

import numpy as np

from palpate.modes.held_body import HeldBody
from palpate.modes.lanczos import LowestModes, lowest_modes
from palpate.progress import Progress
from palpate.scene.material import Material

REACH = 1.1
"""Frequency of the highest mode over the end of the band. What lies above follows by Ritz vectors."""

_SPARE = 1.1
_MOST_ROUNDS = 6


def guessed_modes(material: Material, volume_m3: float, area_m2: float, frequency_hz: float) -> int:
    """By Weyl's law with its term for the free surface: V k³ / (3 pi²) + 3 A k² / (16 pi), k of shear waves."""
    speed = np.sqrt(material.shear_modulus_pa / material.density_kg_per_m3)
    k = 2 * np.pi * frequency_hz / speed
    return max(1, int(volume_m3 * k**3 / (3 * np.pi**2) + 3 * area_m2 * k**2 / (16 * np.pi)))


def modes_up_to(held: HeldBody, frequency_hz: float, guess: int, progress: Progress) -> LowestModes:
    """All modes up to a frequency, and the first above it where the body has one.

    guess  about how many that are
    """
    n_parameters = held.body.stiffness.shape[0]
    most = n_parameters - held.body.n_components * len(held.nodes)
    count = min(int(_SPARE * guess) + 1, most)
    for _ in range(_MOST_ROUNDS):
        progress.note(f"{count:,} modes")
        modes = lowest_modes(held, count)
        beyond = int(np.searchsorted(modes.squared_frequencies, (2 * np.pi * frequency_hz) ** 2))
        if beyond < count or count == most:
            kept = min(beyond + 1, count)
            return LowestModes(modes.squared_frequencies[:kept], modes.parameters[:, :kept])
        # The number of modes below a frequency grows with its cube.
        highest = np.sqrt(modes.squared_frequencies[-1]) / (2 * np.pi)
        count = min(most, int(_SPARE * count * (frequency_hz / highest) ** 3) + 1)
    raise ValueError(
        f"the {count:,} lowest modes do not reach {frequency_hz:g} Hz: expected a narrower surface.band_hz"
    )
