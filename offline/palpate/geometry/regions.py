"""Choosing boundary nodes of a cloud by where they are."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from palpate.geometry.cloud import NodeCloud
from palpate.geometry.region_edge import ON_EDGE
from palpate.geometry.sampling import place_on
from palpate.scene.regions import AreaRegion, BoxRegion, NearestRegion, PlaneRegion, Region, SphereRegion

Array = NDArray[np.float64]
Indices = NDArray[np.intp]
Vector = tuple[float, float, float]


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

    Raises RegionError when there are none.
    """
    boundary = np.flatnonzero(cloud.boundary)
    points = cloud.points[boundary]
    if isinstance(region, NearestRegion):
        distance = np.linalg.norm(points - np.asarray(region.point_m), axis=1)
        return boundary[[np.argmin(distance)]]
    outside = distance_outside(region, points)
    chosen = boundary[outside <= ON_EDGE * cloud.spacing[boundary]]
    if len(chosen) == 0:
        where = points[np.argmin(outside)]
        low, high = cloud.surface.vertices.min(axis=0), cloud.surface.vertices.max(axis=0)
        raise RegionError(
            f"{_describe(region)} holds none of the {len(boundary)} nodes of the surface. The body reaches from "
            f"{_rounded(low)} to {_rounded(high)} m; its nearest node, at {_rounded(where)} m, "
            f"is {outside.min():.4g} m outside. Expected a region that holds part of the surface, in m"
        )
    return chosen


def contact_patch(point_m: Vector, radius_m: float, cloud: NodeCloud) -> ContactPatch:
    """Boundary nodes no further than `radius_m` from the surface point nearest to `point_m`.

    Nodes whose outward normal is at 90 degrees or more to the surface's there are left out: they belong to the
    far side of a thin part. On an edge or a vertex the surface's normal is the mean over what meets there, weighted with
    the angles, so a patch on a rim holds both of its sides. Raises RegionError when no node is left.
    """
    center, normal_there = place_on(cloud.surface, point_m)
    facing = cloud.normals @ normal_there > 0  # false inside, where normals are zero
    candidates = np.flatnonzero(facing)
    distance = np.linalg.norm(cloud.points[candidates] - center, axis=1)
    nodes = candidates[distance <= radius_m + ON_EDGE * cloud.spacing[candidates]]
    if len(nodes) == 0:
        nearest = f"{distance.min():.4g} m from its center" if len(candidates) else "nowhere"
        raise RegionError(
            f"the contact patch of radius_m = {radius_m} around {center.tolist()} m holds no boundary node: the "
            f"nearest is {nearest}, expected a larger radius or a smaller node spacing there"
        )
    normal = cloud.areas[nodes] @ cloud.normals[nodes]
    return ContactPatch(nodes, center, normal / np.linalg.norm(normal), radius_m)


def distance_outside(region: AreaRegion, points: Array) -> Array:
    """How far points (n, 3) lie outside the region, m, (n,); within it the distance to its edge, negative."""
    match region:
        case BoxRegion():
            beyond = np.maximum(np.asarray(region.lower_m) - points, points - np.asarray(region.upper_m))
            return np.linalg.norm(np.maximum(0.0, beyond), axis=1) + np.minimum(0.0, beyond.max(axis=1))
        case SphereRegion():
            return np.linalg.norm(points - np.asarray(region.center_m), axis=1) - region.radius_m
        case PlaneRegion():
            normal = np.asarray(region.normal) / np.linalg.norm(region.normal)
            return -(points - np.asarray(region.point_m)) @ normal


def _describe(region: AreaRegion) -> str:
    """The region in the keys and numbers of the scene."""
    match region:
        case BoxRegion():
            return f"the box from lower_m = {list(region.lower_m)} to upper_m = {list(region.upper_m)}"
        case SphereRegion():
            return f"the sphere of radius_m = {region.radius_m:g} around center_m = {list(region.center_m)}"
        case PlaneRegion():
            return f"the side of the plane through point_m = {list(region.point_m)} that normal = {list(region.normal)} points to"


def _rounded(point: Array) -> list[float]:
    return [float(f"{x:.4g}") for x in point]
