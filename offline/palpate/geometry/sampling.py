"""Fine samplings of a closed surface and of its inside, finer where the nodes are to be closer."""

from __future__ import annotations

from dataclasses import dataclass

import igl
import numpy as np
from numpy.typing import NDArray

from palpate.geometry.cloud import TriangleSurface
from palpate.geometry.spacing import SpacingField

Array = NDArray[np.float64]

_INSIDE = igl.SignedDistanceType.SIGNED_DISTANCE_TYPE_FAST_WINDING_NUMBER


@dataclass(frozen=True)
class SurfaceSamples:
    """Points of a surface, m (n, 3); the area of each, m² (n,); the triangle it lies in (n,); the spacing there, m."""

    points: Array
    areas: Array
    triangles: NDArray[np.int64]
    spacing: Array


@dataclass(frozen=True)
class InsideSamples:
    """Points inside a surface, m (n, 3); the volume of each, m³ (n,); its distance to the surface and spacing, m."""

    points: Array
    volumes: Array
    depths: Array
    spacing: Array


def closest_on_surface(points: Array, surface: TriangleSurface) -> tuple[Array, NDArray[np.int64]]:
    """Closest point of the surface to each of the points (n, 3), m, and the triangle it lies in (n,)."""
    _, triangle, closest = igl.point_mesh_squared_distance(
        np.ascontiguousarray(points), surface.vertices, surface.triangles.astype(np.int64)
    )
    return closest, triangle


def depth_inside(points: Array, surface: TriangleSurface) -> Array:
    """Distance to the surface, m, (n,) for points (n, 3): positive inside, negative outside.

    The side comes from the generalised winding number (Barill et al. 2018), which needs no rays.
    """
    distance, *_ = igl.signed_distance(
        np.ascontiguousarray(points), surface.vertices, surface.triangles.astype(np.int64), _INSIDE
    )
    return -distance


def triangle_normals(surface: TriangleSurface) -> tuple[Array, Array]:
    """Unit outward normals (n_triangles, 3) and areas (n_triangles,), m²."""
    a, b, c = np.moveaxis(surface.vertices[surface.triangles], 1, 0)
    cross = np.cross(b - a, c - a)
    length = np.linalg.norm(cross, axis=1)
    return cross / length[:, None], length / 2


def enclosed_volume(surface: TriangleSurface) -> float:
    """Volume within a closed surface, m³, by the divergence theorem; negative if it is inside-out."""
    corners = surface.vertices[surface.triangles] - surface.vertices.mean(axis=0)
    return float(np.sum(np.cross(corners[:, 0], corners[:, 1]) * corners[:, 2]) / 6)


def sample_surface(surface: TriangleSurface, field: SpacingField, fineness: float) -> SurfaceSamples:
    """Centroids of the triangles, halved across their longest edge until it is below fineness * h there."""
    corners = surface.vertices[surface.triangles]
    parent = np.arange(len(corners))
    done: list[tuple[Array, NDArray[np.int64], Array]] = []
    while len(corners):
        edges = np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=2)
        longest = np.argmax(edges, axis=1)
        h = field(corners.mean(axis=1))
        small = edges.max(axis=1) <= fineness * h
        done.append((corners[small], parent[small], h[small]))
        turned = np.arange(3) + longest[~small, None]  # the longest edge from the first corner to the second
        a, b, c = np.moveaxis(np.take_along_axis(corners[~small], turned[:, :, None] % 3, axis=1), 1, 0)
        middle = (a + b) / 2
        corners = np.concatenate([np.stack([a, middle, c], axis=1), np.stack([middle, b, c], axis=1)])
        parent = np.tile(parent[~small], 2)
    corners = np.concatenate([d[0] for d in done])
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return SurfaceSamples(
        points=corners.mean(axis=1),
        areas=np.linalg.norm(cross, axis=1) / 2,
        triangles=np.concatenate([d[1] for d in done]),
        spacing=np.concatenate([d[2] for d in done]),
    )


def sample_inside(surface: TriangleSurface, field: SpacingField, fineness: float) -> InsideSamples:
    """Midpoints of the cells of an octree, of size fineness * h at most, half that across the surface."""
    low, high = surface.vertices.min(axis=0), surface.vertices.max(axis=0)
    size = fineness * field.spacing_m
    counts = np.ceil((high - low) / size).astype(int)
    index = np.indices(tuple(int(n) for n in counts)).reshape(3, -1).T
    centres = (low + high) / 2 + (index - (counts - 1) / 2) * size
    octants = (np.indices((2, 2, 2)).reshape(3, -1).T - 0.5) / 2
    done: list[tuple[Array, Array, Array, Array]] = []
    while len(centres):
        depth, h = depth_inside(centres, surface), field(centres)
        crossing = np.abs(depth) <= size * np.sqrt(3) / 2
        keep = (depth > 0) | crossing
        centres, depth, h, crossing = centres[keep], depth[keep], h[keep], crossing[keep]
        small = size <= fineness * h * np.where(crossing, 0.5, 1.0) * (1 + 1e-9)
        leaf = small & (depth > 0)
        done.append((centres[leaf], np.full(np.count_nonzero(leaf), size**3), depth[leaf], h[leaf]))
        centres = (centres[~small, None, :] + size * octants).reshape(-1, 3)
        size /= 2
    points, volumes, depths, spacing = (np.concatenate(column) for column in zip(*done, strict=True))
    return InsideSamples(points, volumes, depths, spacing)
