"""How many points of a surface a small sphere touches: with too few its force is wrong, with few it ripples while the sphere slides."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

DEPTH = 0.5
"""Depth over radius of the contact. The radius of the contact is sqrt(radius * depth) (Hertz 1882)."""

FEWEST_POINTS = 3.0
"""Points in contact that a tool needs."""

_BLUNT = 0.02
"""A sphere that is blunter by this meets 1 % more force: no more than an error of the model."""

SMOOTH_FROM = 1.7
"""Contact's radius over the spacing from which the force of a sliding tool ripples by less than 2 % r.m.s. (docs/contact.md)."""


def contact_radius_m(tool_radius_m: float) -> float:
    """Radius of the contact of a sphere that is pressed in by half its radius, m."""
    return tool_radius_m * math.sqrt(DEPTH)


def points_in_contact(tool_radius_m: float, spacing_m: float) -> float:
    """About how many points such a contact has, where a point stands for spacing²."""
    return math.pi * contact_radius_m(tool_radius_m) ** 2 / spacing_m**2


def smallest_radius_m(spacing_m: Floats) -> Floats:
    """Radius of the smallest sphere that touches FEWEST_POINTS of points this far apart, m."""
    return spacing_m * math.sqrt(FEWEST_POINTS / points_in_contact(1.0, 1.0))


def point_areas(points: Floats, triangles: NDArray[np.int32]) -> Floats:
    """(n_points,), m²: a third of the triangles around each point, (n_points, 3), m; triangles (n_triangles, 3)."""
    corners = points[triangles]
    doubled = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    return np.asarray(np.bincount(triangles.ravel(), np.repeat(doubled / 6, 3), len(points)), np.float64)


def point_spacing(points: Floats, triangles: NDArray[np.int32]) -> Floats:
    """(n_points,), m: root of the area that each point stands for. Arguments as of `point_areas`."""
    return np.sqrt(point_areas(points, triangles))


def blunted_radius_m(points: Floats, triangles: NDArray[np.int32], radius_m: float) -> Floats:
    """(n_points,), m: of the sphere as which a tool acts at each point, blunter where points are too far apart for its own."""
    return np.maximum(smallest_radius_m(point_spacing(points, triangles)), radius_m)


def blunted_error(points: Floats, triangles: NDArray[np.int32], radius_m: float) -> Floats:
    """(n_points,): by how much more force, relative, the blunter sphere meets at a depth: sqrt of the radii (Hertz 1882)."""
    return np.sqrt(blunted_radius_m(points, triangles, radius_m) / radius_m) - 1


def carried_share(points: Floats, triangles: NDArray[np.int32], radius_m: float) -> float:
    """The share of the surface's area whose points are near enough for a tool. Arguments as of `point_areas`."""
    areas = point_areas(points, triangles)
    carried = blunted_radius_m(points, triangles, radius_m) <= radius_m * (1 + _BLUNT)
    return 1.0 if np.all(carried) else float(areas[carried].sum() / areas.sum())


def coarse_advice(points: Floats, triangles: NDArray[np.int32], radius_m: float) -> str | None:
    """A sentence for a tool that acts as a blunter one on a part of the surface; else None. Arguments as of `point_areas`."""
    share = carried_share(points, triangles, radius_m)
    if share == 1:
        return None
    largest = float(blunted_radius_m(points, triangles, radius_m).max())
    return (
        f"where points are far apart, as outside the working areas, a tip of radius_m = {radius_m:g} acts as a blunter one, of up "
        f"to {largest:.2g} m; they are near enough on {100 * share:.2g} % of the surface"
    )


def small_tool_advice(name: str, radius_m: float, spacing_m: float) -> str | None:
    """A sentence for a tool that touches too few of the points, spacing_m apart; else None."""
    count = points_in_contact(radius_m, spacing_m)
    if count >= FEWEST_POINTS:
        return None
    fit = radius_m * math.sqrt(points_in_contact(1.0, 1.0) / FEWEST_POINTS)
    return (
        f"tool {name!r}: radius_m = {radius_m:g} touches about {count:.2g} points {spacing_m:.2g} m apart when pressed in by "
        f"half of it, its force ripples by 6 % or more while it slides over them; expected {FEWEST_POINTS:g} or more, as with "
        f"a spacing_m of {fit:.2g} or a radius_m of {radius_m * math.sqrt(FEWEST_POINTS / count):.2g}"
    )


def ripple_note(radius_m: float, spacing_m: float) -> str | None:
    """A sentence for a tool that touches enough points, spacing_m apart, but feels them while it slides; else None."""
    radius = contact_radius_m(radius_m)
    if radius >= SMOOTH_FROM * spacing_m or points_in_contact(radius_m, spacing_m) < FEWEST_POINTS:
        return None
    return (
        f"force of a sliding tip with radius_m = {radius_m:g} ripples by up to 6 %, by less than 2 % with a spacing_m of "
        f"{radius / SMOOTH_FROM:.2g}"
    )
