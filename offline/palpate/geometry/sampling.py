"""Fine samplings of a closed surface, its edges and its inside, finer where the nodes are to be closer."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import igl
import numpy as np
from numpy.typing import NDArray

from palpate.geometry.cloud import TriangleSurface
from palpate.geometry.spacing import SpacingField

Array = NDArray[np.float64]
Indices = NDArray[np.int32] | NDArray[np.int64]


@dataclass(frozen=True)
class Samples:
    """Points of a curve, a surface or a body, and the part of it that each stands for.

    points    (n_samples, 3), m
    measures  (n_samples,), length in m, area in m² or volume in m³
    spacing   (n_samples,), spacing of the nodes there, m
    """

    points: Array
    measures: Array
    spacing: Array


@dataclass(frozen=True)
class InnerSamples(Samples):
    """Samples of the inside of a body.

    least_depth  (n_samples,), m: each is at least so deep inside; near the surface this is its depth
    """

    least_depth: Array


def closest_point(points: Array, vertices: Array, elements: Indices) -> tuple[Array, Indices]:
    """Closest point of a set of segments (n, 2) or triangles (n, 3) to each of the points, and the element it is in.

    points (n_points, 3) and vertices (n_vertices, 3) in m; returns (n_points, 3), m, and (n_points,).
    """
    _, element, closest = igl.point_mesh_squared_distance(
        np.ascontiguousarray(points), vertices, elements.astype(np.int64)
    )
    return closest, element


def depth_inside(points: Array, surface: TriangleSurface) -> Array:
    """Distance to the surface, m, (n,) for points (n, 3): positive inside, negative outside.

    The side is that of the closest triangles' angle-weighted normal, which is exact for a closed surface that does not
    intersect itself (Baerentzen & Aanaes 2005).
    """
    distance, *_ = igl.signed_distance(
        np.ascontiguousarray(points),
        surface.vertices,
        surface.triangles.astype(np.int64),
        igl.SignedDistanceType.SIGNED_DISTANCE_TYPE_PSEUDONORMAL,
    )
    return -distance


def place_on(surface: TriangleSurface, point: tuple[float, float, float]) -> tuple[Array, Array]:
    """The surface point (3,), m, nearest to a point, m, and the outward normal (3,) there: on an edge or a vertex the mean over
    the triangles that meet there, weighted with their angles (Baerentzen & Aanaes 2005)."""
    *_, closest, normals = igl.signed_distance(
        np.array([point], dtype=float),
        surface.vertices,
        surface.triangles.astype(np.int64),
        igl.SignedDistanceType.SIGNED_DISTANCE_TYPE_PSEUDONORMAL,
    )
    return closest[0], normals[0]


def sample_elements(
    vertices: Array, elements: Indices, field: Callable[[Array], Array], fineness: float
) -> tuple[Samples, Indices]:
    """Centroids of segments (n, 2) or triangles (n, 3), halved across their longest edge down to fineness * h there.

    field  the spacing h of the nodes, m, (n,) at points (n, 3)

    Returns the samples and the element that each lies in, (n_samples,).
    """
    corners = vertices[elements]
    k = corners.shape[1]
    parent = np.arange(len(corners))
    done: list[tuple[Array, Indices, Array]] = []
    while len(corners):
        edges = np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=2)
        h = field(corners.mean(axis=1))
        small = edges.max(axis=1) <= fineness * h
        done.append((corners[small], parent[small], h[small]))
        # Turn each element so that its longest edge runs from its first corner to its second.
        turn = (np.arange(k) + np.argmax(edges, axis=1)[~small, None]) % k
        first = np.take_along_axis(corners[~small], turn[:, :, None], axis=1)
        second = first.copy()
        first[:, 1] = second[:, 0] = (first[:, 0] + first[:, 1]) / 2
        corners = np.concatenate([first, second])
        parent = np.tile(parent[~small], 2)
    corners, parent, h = (np.concatenate(column) for column in zip(*done, strict=True))
    sides = corners[:, 1:] - corners[:, :1]
    if k == 2:
        measures = np.linalg.norm(sides[:, 0], axis=1)
    else:
        measures = np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1) / 2
    return Samples(corners.mean(axis=1), measures, h), parent


def sample_inside(surface: TriangleSurface, field: SpacingField, fineness: float) -> InnerSamples:
    """Midpoints of octree cells of size fineness * h at most, there.

    A cell that the surface crosses counts with the part of it below the plane at its midpoint's distance from the
    surface; its midpoint may lie outside.
    """
    low, high = surface.vertices.min(axis=0), surface.vertices.max(axis=0)
    size = 8 * fineness * field.spacing_m
    counts = np.ceil((high - low) / size).astype(int)
    index = np.indices(tuple(int(n) for n in counts)).reshape(3, -1).T
    centers = (low + high) / 2 + (index - (counts - 1) / 2) * size
    octants = (np.indices((2, 2, 2)).reshape(3, -1).T - 0.5) / 2
    depth = np.full(len(centers), -np.inf)
    done: list[tuple[Array, Array, Array, Array]] = []
    while len(centers):
        # From its parent a cell knows a depth that it has at least: only those near the surface need their own.
        reach = size * np.sqrt(3) / 2
        unsure = depth < reach
        depth[unsure] = depth_inside(centers[unsure], surface)
        near = depth > -reach
        centers, depth, h = centers[near], depth[near], field(centers[near])
        small = size <= fineness * h * (1 + 1e-9)
        share = np.clip(0.5 + depth / size, 0.0, 1.0)
        leaf = small & (share > 0)
        done.append((centers[leaf], share[leaf] * size**3, h[leaf], depth[leaf]))
        centers = (centers[~small, None, :] + size * octants).reshape(-1, 3)
        depth = np.repeat(depth[~small] - reach / 2, 8)
        size /= 2
    return InnerSamples(*(np.concatenate(column) for column in zip(*done, strict=True)))
