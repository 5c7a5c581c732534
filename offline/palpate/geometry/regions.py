"""Choosing boundary nodes of a cloud by where they are."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from palpate.geometry.cloud import NodeCloud
from palpate.geometry.sampling import closest_point

Array = NDArray[np.float64]
Indices = NDArray[np.intp]
Vector = tuple[float, float, float]

_EDGE = 1e-6
"""Nodes on the edge of a region belong to it: slack as a fraction of the node's spacing."""


@dataclass(frozen=True)
class BoxRegion:
    """Boundary nodes within an axis-aligned box, m."""

    lower_m: Vector
    upper_m: Vector


@dataclass(frozen=True)
class PlaneRegion:
    """Boundary nodes on the side of a plane that its normal points to, no further from it than `within_m` if given.

    point_m    a point of the plane, m
    normal     any length but 0
    within_m   > 0, m
    """

    point_m: Vector
    normal: Vector
    within_m: float | None = None


@dataclass(frozen=True)
class SphereRegion:
    """Boundary nodes within a sphere, m."""

    center_m: Vector
    radius_m: float


@dataclass(frozen=True)
class NearestRegion:
    """The one boundary node nearest to a point, m; of several as near, the first in the cloud."""

    point_m: Vector


Region = BoxRegion | PlaneRegion | SphereRegion | NearestRegion


class RegionError(ValueError):
    """A region holds no boundary node; the message names it and says how far the nearest one is."""


@dataclass(frozen=True)
class ContactPatch:
    """A round piece of the boundary that a tool tip holds.

    nodes     (n_patch_nodes,), indices into the cloud
    center_m  (3,), the surface point it is around, m
    normal    (3,), unit outward normal, the mean over the patch's nodes weighted with their areas
    radius_m  m
    """

    nodes: Indices
    center_m: Array
    normal: Array
    radius_m: float


def nodes_in(region: Region, cloud: NodeCloud) -> Indices:
    """Indices of the boundary nodes in the region, ascending, (k,) with k >= 1.

    Raises RegionError when there are none, ValueError when the region itself makes no sense.
    """
    boundary = np.flatnonzero(cloud.boundary)
    if isinstance(region, NearestRegion):
        distance = np.linalg.norm(cloud.points[boundary] - np.asarray(region.point_m), axis=1)
        return boundary[[np.argmin(distance)]]
    outside = _distance_outside(region, cloud.points[boundary])
    chosen = boundary[outside <= _EDGE * cloud.spacing[boundary]]
    if len(chosen) == 0:
        nearest = boundary[np.argmin(outside)]
        raise RegionError(
            f"{region} holds none of the {len(boundary)} boundary nodes: the nearest is node {nearest} at "
            f"{cloud.points[nearest].tolist()} m, {outside.min():.4g} m outside it"
        )
    return chosen


def contact_patch(point_m: Vector, radius_m: float, cloud: NodeCloud) -> ContactPatch:
    """Boundary nodes no further than `radius_m` from the surface point nearest to `point_m`.

    Nodes whose outward normal is at 90 degrees or more to the surface's there are left out: they belong to the
    far side of a thin part. Raises RegionError when no node is left, ValueError when radius_m is not above 0.
    """
    if not (np.isfinite(radius_m) and radius_m > 0):
        raise ValueError(f"radius_m = {radius_m}: expected a length above 0")
    vertices, triangles = cloud.surface.vertices, cloud.surface.triangles
    closest, triangle = closest_point(np.array([point_m], dtype=float), vertices, triangles)
    center = closest[0]
    a, b, c = vertices[triangles[triangle[0]]]
    facing = cloud.normals @ np.cross(b - a, c - a) > 0  # false inside, where normals are zero
    candidates = np.flatnonzero(facing)
    distance = np.linalg.norm(cloud.points[candidates] - center, axis=1)
    nodes = candidates[distance <= radius_m + _EDGE * cloud.spacing[candidates]]
    if len(nodes) == 0:
        nearest = f"{distance.min():.4g} m from its center" if len(candidates) else "nowhere"
        raise RegionError(
            f"the contact patch of radius_m = {radius_m} around {center.tolist()} m holds no boundary node: the "
            f"nearest is {nearest}, expected a larger radius or a smaller node spacing there"
        )
    normal = cloud.areas[nodes] @ cloud.normals[nodes]
    return ContactPatch(nodes, center, normal / np.linalg.norm(normal), radius_m)


def _distance_outside(region: BoxRegion | PlaneRegion | SphereRegion, points: Array) -> Array:
    """How far points (n, 3) lie outside the region, m, (n,); 0 or less within it."""
    if isinstance(region, BoxRegion):
        low, high = np.asarray(region.lower_m), np.asarray(region.upper_m)
        if np.any(low > high):
            raise ValueError(f"{region}: expected lower_m <= upper_m")
        return np.linalg.norm(np.maximum(0.0, np.maximum(low - points, points - high)), axis=1)
    if isinstance(region, SphereRegion):
        if not region.radius_m > 0:
            raise ValueError(f"{region}: expected radius_m above 0")
        return np.linalg.norm(points - np.asarray(region.center_m), axis=1) - region.radius_m
    length = np.linalg.norm(region.normal)
    if not (np.isfinite(length) and length > 0):
        raise ValueError(f"{region}: expected a normal that is not zero")
    height = (points - np.asarray(region.point_m)) @ (np.asarray(region.normal) / length)
    if region.within_m is None:
        return -height
    if not region.within_m > 0:
        raise ValueError(f"{region}: expected within_m above 0")
    return np.maximum(-height, height - region.within_m)
