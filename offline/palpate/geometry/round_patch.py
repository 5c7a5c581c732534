"""The nodes of round patches: a center and rings around it."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from palpate.geometry.cloud import TriangleSurface
from palpate.geometry.measures import triangle_normals
from palpate.geometry.sampling import closest_point
from palpate.geometry.spacing import Refinement, SpacingField

Array = NDArray[np.float64]


def fitted(patch: Refinement, surface: TriangleSurface) -> Refinement:
    """The patch moved to the surface point nearest to its center, its spacing (reduced) such that its rings fit."""
    closest, _ = closest_point(np.array([patch.center_m]), surface.vertices, surface.triangles)
    x, y, z = closest[0].tolist()
    spacing = patch.radius_m / (_n_rings(patch) + 0.5)
    return replace(patch, center_m=(x, y, z), spacing_m=spacing)


def _n_rings(patch: Refinement) -> int:
    """The fewest rings within a patch, at spacing s, 2 s, ..., with radius = (n_rings + 1/2) s and s <= spacing."""
    return max(1, math.ceil(patch.radius_m / patch.spacing_m - 0.5 - 1e-9))


def patch_nodes(surface: TriangleSurface, field: SpacingField) -> Array:
    """(n, 3), nodes of the round patches, m."""
    if not field.refinements:
        return np.empty((0, 3))
    patches = [_rings(surface, r) for r in field.refinements]
    for patch, nodes in zip(field.refinements, patches, strict=True):
        _refuse_folded(patch, nodes)
    nodes = np.vstack(patches)
    owner = np.repeat(np.arange(len(patches)), [len(p) for p in patches])
    nearest = 0.5 * min(r.spacing_m for r in field.refinements)
    for a, b in sorted(cKDTree(nodes).query_pairs(nearest)):
        if owner[a] != owner[b]:
            raise ValueError(
                f"two round patches overlap near {nodes[a].tolist()} m: expected them at least two spacings apart"
            )
    return nodes


def _refuse_folded(patch: Refinement, nodes: Array) -> None:
    """Raise ValueError where the surface folds so sharply that the patch's own nodes (n, 3) come too close."""
    pairs = cKDTree(nodes).query_pairs(0.5 * patch.spacing_m, output_type="ndarray")
    if len(pairs):
        a, b = nodes[pairs[0]]
        raise ValueError(
            f"the surface around {list(patch.center_m)} m is too sharp or too thin for a round patch of radius "
            f"{patch.radius_m:g} m: its nodes, {patch.spacing_m:.3g} m apart along the surface, come within "
            f"{np.linalg.norm(a - b):.2g} m of each other near {a.round(6).tolist()} m. Expected a place that is nearly flat "
            "over the patch, a smaller radius, or no finer spacing there (leave out the contact's spacing_m)"
        )


def _rings(surface: TriangleSurface, patch: Refinement) -> Array:
    """(n, 3): a fitted patch's center, its rings, and one ring beyond its radius, with 6 k nodes on ring k, m.

    A ring's nodes are the points of the surface at its distance from the center, found by going back and forth
    between sphere and surface.
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
            raise ValueError(
                f"a round patch of radius {patch.radius_m} m finds no place around {center[0].tolist()} m: "
                "expected a smaller radius, or a place where the surface is larger and smoother"
            )
        nodes.append(ring)
    return np.vstack(nodes)
