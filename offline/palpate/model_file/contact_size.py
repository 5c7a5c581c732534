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


def vertex_areas(points: Floats, triangles: NDArray[np.int32]) -> Floats:
    """(n_points,), m²: a third of the triangles at each point, (n_points, 3), m; triangles (n_triangles, 3)."""
    a, b, c = points[triangles.T]
    areas = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
    return np.asarray(np.bincount(triangles.ravel(), np.repeat(areas / 3, 3), len(points)), np.float64)


def point_spacings(points: Floats, triangles: NDArray[np.int32]) -> Floats:
    """(n_points,), m: a point and its neighbors stand for spacing² each on average. Arguments as of `vertex_areas`."""
    areas, n = vertex_areas(points, triangles), len(points)
    first, second = triangles[:, [0, 1, 2]].ravel(), triangles[:, [1, 2, 0]].ravel()
    total = areas.copy()
    count = np.ones(n)
    for here, there in ((first, second), (second, first)):
        total += np.bincount(here, areas[there], n)
        count += np.bincount(here, minlength=n)
    spacings: Floats = np.sqrt(total / count)
    return spacings


def carries(spacings_m: Floats, tool_radius_m: float) -> NDArray[np.bool_]:
    """(n_points,): whether points so far apart carry a tool. Where they don't, its force is not that of the tissue."""
    return smallest_radius_m(spacings_m) <= tool_radius_m


def carried_share(points: Floats, triangles: NDArray[np.int32], tool_radius_m: float) -> float:
    """The share of the surface's area with points that carry a tool. Arguments as of `vertex_areas`."""
    areas = vertex_areas(points, triangles)
    carried = carries(point_spacings(points, triangles), tool_radius_m)
    return 1.0 if np.all(carried) else float(areas[carried].sum() / areas.sum())


def coarse_advice(radius_m: float, share: float, spacing_m: float) -> str:
    """A sentence for a tool that a share of the surface carries; elsewhere points are up to spacing_m apart."""
    return (
        f"{100 * share:.2g} % of the surface has points that carry a tool with radius_m = {radius_m:g}; elsewhere they are up "
        f"to {spacing_m:.2g} m apart, and its force is not that of the tissue"
    )


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
