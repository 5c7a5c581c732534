"""Colors of tissue and of a value on it, and the levels at which the color changes."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Rgb = tuple[int, int, int]

TISSUE: Rgb = (186, 92, 84)
STEEL: Rgb = (196, 204, 212)
GHOST: Rgb = (120, 190, 255)
FORCE: Rgb = (70, 200, 255)
CONTACT: Rgb = (255, 255, 255)

N_BANDS = 9
_SMALLEST = 0.06  # of the largest value: less than this keeps the tissue's color
_STOPS = (
    (0.0, TISSUE),
    (0.3, (222, 120, 60)),
    (0.6, (246, 178, 60)),
    (0.85, (255, 226, 110)),
    (1.0, (255, 250, 215)),
)


@dataclass(frozen=True)
class Coloring:
    """What the colors show: its name, its values (n,) at the vertices, and the value of the last color."""

    name: str
    values: NDArray[np.floating]
    largest: float


def color_at(share: float) -> Rgb:
    """The color of a value between 0 and its largest, as its share of the largest; 0 is the tissue's own color."""
    places = [place for place, _ in _STOPS]
    channels = zip(*(color for _, color in _STOPS), strict=True)
    r, g, b = (round(float(np.interp(share, places, channel))) for channel in channels)
    return r, g, b


def band_colors() -> list[Rgb]:
    """The color in the middle of each band of `band_levels`."""
    edges = np.linspace(_SMALLEST, 1.0, N_BANDS + 1)
    return [color_at(float(share)) for share in (edges[:-1] + edges[1:]) / 2]


def band_levels(largest: float) -> NDArray[np.float64]:
    """(N_BANDS,) where each band begins, for values up to `largest`."""
    return largest * np.linspace(_SMALLEST, 1.0, N_BANDS + 1)[:-1]


def nice_ceiling(value: float) -> float:
    """The smallest of 1, 2, 5 times a power of ten that is not below a positive value."""
    if not 0 < value < math.inf:
        raise ValueError(f"value is {value}: expected a positive, finite number")
    power = 10.0 ** math.floor(math.log10(value))
    return next(step * power for step in (1.0, 2.0, 5.0, 10.0) if step * power >= value * (1 - 1e-9))
