"""Geometry of a triangulated surface: normals, the point under a ray, points at a sphere, bands of a value on it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Triangles = NDArray[np.int32]

_PARALLEL = 1e-12
_TOUCHING = 0.06  # of the radius: the server's rows of contact are within 5 %


@dataclass(frozen=True)
class Hit:
    """Where a ray meets a surface: point (3,), m, and outward normal (3,) of length 1."""

    point_m: Floats
    normal: Floats


def vertex_normals(vertices: Floats, triangles: Triangles) -> Floats:
    """(n, 3) outward unit normals of vertices (n, 3): those of the triangles (m, 3) around, weighted with their areas."""
    a, b, c = (vertices[triangles[:, i]] for i in range(3))
    area = np.cross(b - a, c - a)
    normals = np.zeros_like(vertices)
    for i in range(3):
        np.add.at(normals, triangles[:, i], area)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    return normals / np.where(length > 0, length, 1.0)


def ray_hit(
    origin_m: Floats, direction: Floats, vertices: Floats, normals: Floats, triangles: Triangles
) -> Hit | None:
    """The first point, seen from `origin_m` (3,), where a ray along `direction` (3,) enters the surface; None if it misses.

    Intersection as Möller & Trumbore 1997; triangles seen from behind don't count. The normal is interpolated from `normals`
    (n, 3) of the vertices.
    """
    a, b, c = (vertices[triangles[:, i]] for i in range(3))
    edge_b, edge_c = b - a, c - a
    across = np.cross(direction, edge_c)
    determinant = np.einsum("ij,ij->i", edge_b, across)
    front = determinant > _PARALLEL * float(np.abs(determinant).max(initial=0.0))
    inverse = 1.0 / np.where(front, determinant, 1.0)
    to_origin = origin_m - a
    u = np.einsum("ij,ij->i", to_origin, across) * inverse
    turned = np.cross(to_origin, edge_b)
    v = turned @ direction * inverse
    distance = np.einsum("ij,ij->i", edge_c, turned) * inverse
    hits = front & (u >= 0) & (v >= 0) & (u + v <= 1) & (distance > 0)
    if not hits.any():
        return None
    first = int(np.where(hits, distance, np.inf).argmin())
    weights = np.array([1 - u[first] - v[first], u[first], v[first]])
    normal = weights @ normals[triangles[first]]
    length = float(np.linalg.norm(normal))
    if length == 0:
        return None
    return Hit(origin_m + distance[first] * direction, normal / length)


def touched_points(vertices: Floats, center_m: Floats, radius_m: float) -> Floats:
    """(k, 3) those of the deformed points (n, 3), m, that a sphere touches."""
    gap = np.linalg.norm(vertices - center_m, axis=1) - radius_m
    return vertices[gap < _TOUCHING * radius_m]


def split(
    corners: Floats, values: Floats, level: float
) -> tuple[tuple[Floats, Floats], tuple[Floats, Floats]]:
    """Cut triangles along the line where a linear value crosses a level: (corners, values) below it, and above it.

    corners (n, 3, 3), m; values (n, 3) at the corners.
    """
    above = values > level
    n_above = above.sum(axis=1)
    parts: dict[bool, list[tuple[Floats, Floats]]] = {
        False: [(corners[n_above == 0], values[n_above == 0])],
        True: [(corners[n_above == 3], values[n_above == 3])],
    }
    for n_up, lone_is_above in ((1, True), (2, False)):
        cut = n_above == n_up
        lone = (above[cut] == lone_is_above).argmax(axis=1)
        order = (lone[:, None] + np.arange(3)) % 3  # keeps the orientation
        x = np.take_along_axis(corners[cut], order[:, :, None], axis=1)
        f = np.take_along_axis(values[cut], order, axis=1)
        share = (level - f[:, :1]) / (f[:, 1:] - f[:, :1])  # (k, 2), along the two cut edges
        cuts = x[:, :1] + share[:, :, None] * (x[:, 1:] - x[:, :1])
        at_level = np.full(len(x), level)
        parts[lone_is_above].append(
            (
                np.stack([x[:, 0], cuts[:, 0], cuts[:, 1]], axis=1),
                np.stack([f[:, 0], at_level, at_level], axis=1),
            )
        )
        parts[not lone_is_above] += [
            (np.stack([cuts[:, 0], x[:, 1], x[:, 2]], axis=1), np.stack([at_level, f[:, 1], f[:, 2]], axis=1)),
            (np.stack([cuts[:, 0], x[:, 2], cuts[:, 1]], axis=1), np.stack([at_level, f[:, 2], at_level], axis=1)),
        ]  # fmt: skip
    (below_x, below_f), (above_x, above_f) = (tuple(map(np.concatenate, zip(*parts[side], strict=True))) for side in (False, True))  # fmt: skip
    return (below_x, below_f), (above_x, above_f)


def bands(
    vertices: Floats, triangles: Triangles, values: NDArray[np.floating], levels: Floats
) -> list[tuple[NDArray[np.float32], NDArray[np.uint32]]]:
    """The parts of a surface between one level and the next, as (vertices (k, 3), triangles (j, 3)); the last one has no end.

    values (n,) at the vertices (n, 3); levels ascending. What is below the first level is left out.
    """
    used = triangles[(values[triangles] > levels[0]).any(axis=1)]
    rest = split(vertices[used], values[used].astype(float), float(levels[0]))[1]
    found = []
    for level in levels[1:]:
        band, rest = split(*rest, float(level))
        found.append(_welded(band[0]))
    return [*found, _welded(rest[0])]


def _welded(corners: Floats) -> tuple[NDArray[np.float32], NDArray[np.uint32]]:
    """Triangles (n, 3, 3) that share their corners, so that they are shaded smoothly."""
    points, index = np.unique(corners.reshape(-1, 3).astype(np.float32), axis=0, return_inverse=True)
    faces = index.reshape(-1, 3).astype(np.uint32)
    a, b, c = faces.T
    return points, faces[(a != b) & (b != c) & (c != a)]
