"""How many points of a surface a small sphere touches: too few, and its force depends on where between them it presses."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

DEPTH = 0.5
"""Depth over radius of the contact. The radius of the contact is sqrt(radius * depth) (Hertz 1882)."""

FEWEST_POINTS = 3.0
"""Points in contact that a tool needs."""


def contact_radius_m(tool_radius_m: float) -> float:
    """Radius of the contact of a sphere that is pressed in by half its radius, m."""
    return tool_radius_m * math.sqrt(DEPTH)


def points_in_contact(tool_radius_m: float, spacing_m: float) -> float:
    """About how many points such a contact has, where a point stands for spacing²."""
    return math.pi * contact_radius_m(tool_radius_m) ** 2 / spacing_m**2


def smallest_radius_m(spacing_m: Floats) -> Floats:
    """Radius of the smallest sphere that touches FEWEST_POINTS of points this far apart, m."""
    return spacing_m * math.sqrt(FEWEST_POINTS / points_in_contact(1.0, 1.0))


def small_tool_advice(name: str, radius_m: float, spacing_m: float) -> str | None:
    """A sentence for a tool that touches too few of the points, spacing_m apart; else None."""
    count = points_in_contact(radius_m, spacing_m)
    if count >= FEWEST_POINTS:
        return None
    fit = radius_m * math.sqrt(points_in_contact(1.0, 1.0) / FEWEST_POINTS)
    return (
        f"tool {name!r}: radius_m = {radius_m:g} touches about {count:.2g} points {spacing_m:.2g} m apart when pressed in by "
        f"half of it, its force depends on where between the points it presses; expected {FEWEST_POINTS:g} or more, as with "
        f"a spacing_m of {fit:.2g} or a radius_m of {radius_m * math.sqrt(FEWEST_POINTS / count):.2g}"
    )
