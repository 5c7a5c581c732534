"""The nodes of round patches: a center and, where the surface is nearly flat, rings around it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from palpate.geometry.cloud import TriangleSurface
from palpate.geometry.measures import triangle_normals
from palpate.geometry.sampling import closest_point
from palpate.geometry.spacing import Refinement

Array = NDArray[np.float64]

MIDWAY = 0.5
"""Where the circle of a patch's radius runs between the nodes within and those beyond it, in spacings."""


def fitted(patch: Refinement, surface: TriangleSurface) -> Refinement:
    """The patch moved to the surface point nearest to its center, its spacing (reduced) such that its rings fit."""
    closest, _ = closest_point(np.array([patch.center_m]), surface.vertices, surface.triangles)
    x, y, z = closest[0].tolist()
    spacing = patch.radius_m / (_n_rings(patch) + 0.5)
    return replace(patch, center_m=(x, y, z), spacing_m=spacing)


def _n_rings(patch: Refinement) -> int:
    """The fewest rings within a patch, at spacing s, 2 s, ..., with radius = (n_rings + 1/2) s and s <= spacing."""
    return max(1, math.ceil(patch.radius_m / patch.spacing_m - 0.5 - 1e-9))


@dataclass(frozen=True)
class PatchNodes:
    """The nodes with which a cloud's round patches begin.

    nodes   (n, 3), m: of a patch on a place that is nearly flat its center and rings, of any other its center
    folded  the others, such as patches on a rim or a tip: the circle at their radius is an edge that nodes lie along
    """

    nodes: Array
    folded: tuple[Refinement, ...]


def patch_nodes(surface: TriangleSurface, patches: Sequence[Refinement]) -> PatchNodes:
    """Raises ValueError where two of the fitted patches overlap, or one is larger than the body."""
    if not patches:
        return PatchNodes(np.empty((0, 3)), ())
    placed, folded = [], []
    for patch in patches:
        nodes = _rings(surface, patch)
        if nodes is None or len(cKDTree(nodes).query_pairs(0.5 * patch.spacing_m)):
            _refuse_too_large(surface, patch)
            folded.append(patch)
            nodes = np.array([patch.center_m])
        placed.append(nodes)
    _refuse_overlap(patches, placed)
    return PatchNodes(np.vstack(placed), tuple(folded))


def _refuse_overlap(patches: Sequence[Refinement], nodes: Sequence[Array]) -> None:
    owner = np.repeat(np.arange(len(patches)), [len(p) for p in nodes])
    points = np.vstack(nodes)
    for a, b in sorted(cKDTree(points).query_pairs(0.5 * min(p.spacing_m for p in patches))):
        if owner[a] != owner[b]:
            raise ValueError(
                f"two round patches overlap near {points[a].tolist()} m: expected them at least two spacings apart"
            )


def _refuse_too_large(surface: TriangleSurface, patch: Refinement) -> None:
    farthest = float(np.linalg.norm(surface.vertices - np.asarray(patch.center_m), axis=1).max())
    if farthest < patch.radius_m + patch.spacing_m:
        raise ValueError(
            f"a round patch of radius {patch.radius_m} m finds no place around {list(patch.center_m)} m: the body ends "
            f"{farthest:.3g} m from there, expected a smaller radius"
        )


def _rings(surface: TriangleSurface, patch: Refinement) -> Array | None:
    """(n, 3): a fitted patch's center, its rings, and one ring beyond its radius, with 6 k nodes on ring k, m.

    A ring's nodes are the points of the surface at its distance from the center, found by going back and forth
    between sphere and surface; None where that does not find them.
    """
    vertices, triangles = surface.vertices, surface.triangles
    center = np.array([patch.center_m])
    _, triangle = closest_point(center, vertices, triangles)
    normal = triangle_normals(surface)[0][triangle[0]]
    first = np.cross(normal, np.eye(3)[np.argmin(np.abs(normal))])
    first /= np.linalg.norm(first)
    second = np.cross(normal, first)
    nodes = [center]
    for k in range(1, _n_rings(patch) + 2):
        radius = k * patch.spacing_m
        angle = 2 * np.pi * (np.arange(6 * k) + 0.5 * (k % 2)) / (6 * k)
        ring = center + radius * (np.cos(angle)[:, None] * first + np.sin(angle)[:, None] * second)
        for _ in range(100):
            ring, _ = closest_point(ring, vertices, triangles)
            arm = ring - center
            distance = np.linalg.norm(arm, axis=1, keepdims=True)
            if np.all(np.abs(distance - radius) <= 1e-9 * radius):
                break
            ring = center + arm * (radius / np.where(distance > 0, distance, 1.0))
        else:
            return None
        nodes.append(ring)
    return np.vstack(nodes)
