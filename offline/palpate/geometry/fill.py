"""Fill the inside of a closed triangle surface with nodes, at a spacing that may vary from place to place."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from palpate.geometry.cloud import INTERIOR, NodeCloud, TriangleSurface
from palpate.geometry.sampling import (
    InsideSamples,
    SurfaceSamples,
    closest_on_surface,
    enclosed_volume,
    sample_inside,
    sample_surface,
    triangle_normals,
)
from palpate.geometry.spacing import Refinement, SpacingField
from palpate.geometry.tributary import tributary_measures

Array = NDArray[np.float64]

_FINENESS = 0.25
_SURFACE_DISC, _INTERIOR_DISC = 0.81, 0.86
_RELAXATIONS = 12


def fill_surface(
    surface: TriangleSurface, spacing_m: float, refinements: tuple[Refinement, ...] = (), seed: int = 0
) -> NodeCloud:
    """Fill the inside of a closed, outward oriented surface; its boundary nodes lie on it and come first.

    spacing_m    distance between nodes far from the refinements, m
    refinements  balls with nodes closer together
    seed         of the random order in which nodes are placed; the same seed gives the same cloud
    """
    rng = np.random.default_rng(seed)
    field = SpacingField(spacing_m, refinements)
    skin = sample_surface(surface, field, _FINENESS)
    inside = sample_inside(surface, field, _FINENESS)
    fixed = np.vstack([np.empty((0, 3))] + [_rings(surface, r) for r in refinements if r.rings])
    free = _spread(skin.points, _SURFACE_DISC * skin.spacing, fixed, _SURFACE_DISC * field(fixed), rng)
    boundary = _relax_on_surface(fixed, free, skin, surface)
    deep = inside.depths > 0.5 * inside.spacing
    interior = _spread(
        inside.points[deep],
        _INTERIOR_DISC * inside.spacing[deep],
        boundary,
        _INTERIOR_DISC * field(boundary),
        rng,
    )
    interior = _relax_inside(boundary, interior, inside)

    points = np.vstack([boundary, interior])
    n_boundary = len(boundary)
    normals, _ = triangle_normals(surface)
    areas, node_normals = np.zeros(len(points)), np.zeros_like(points)
    _, owner = cKDTree(boundary).query(skin.points, workers=-1)
    areas[:n_boundary] = np.bincount(owner, skin.areas, minlength=n_boundary)
    vectors = normals[skin.triangles] * skin.areas[:, None]
    for axis in range(3):
        node_normals[:n_boundary, axis] = np.bincount(owner, vectors[:, axis], minlength=n_boundary)
    node_normals[:n_boundary] /= np.linalg.norm(node_normals[:n_boundary], axis=1, keepdims=True)
    volumes = tributary_measures(points, inside.points, inside.volumes, enclosed_volume(surface))
    return NodeCloud(
        points=points,
        normals=node_normals,
        volumes=volumes,
        areas=areas,
        tags=np.where(np.arange(len(points)) < n_boundary, 1, INTERIOR).astype(np.int32),
        spacing=field(points),
        surface=surface,
    )


def _spread(
    candidates: Array, radii: Array, fixed: Array, fixed_radii: Array, rng: np.random.Generator
) -> Array:
    """Candidates in random order, each taken unless one taken before (or a fixed node) lies within its radius."""
    tree = cKDTree(candidates)
    alive = np.ones(len(candidates), dtype=bool)
    for near in tree.query_ball_point(fixed, fixed_radii) if len(fixed) else []:
        alive[near] = False
    taken = []
    for i in rng.permutation(len(candidates)):
        if alive[i]:
            taken.append(i)
            alive[tree.query_ball_point(candidates[i], radii[i])] = False
    return candidates[taken]


def _relax_on_surface(fixed: Array, free: Array, skin: SurfaceSamples, surface: TriangleSurface) -> Array:
    weights = skin.areas / skin.spacing**4
    for _ in range(_RELAXATIONS):
        free = _centroids(np.vstack([fixed, free]), skin.points, weights)[len(fixed) :]
        free, _ = closest_on_surface(free, surface)
    return np.vstack([fixed, free])


def _relax_inside(boundary: Array, interior: Array, inside: InsideSamples) -> Array:
    weights = inside.volumes / inside.spacing**5
    for _ in range(_RELAXATIONS):
        interior = _centroids(np.vstack([boundary, interior]), inside.points, weights)[len(boundary) :]
    return interior


def _centroids(nodes: Array, samples: Array, weights: Array) -> Array:
    """Weighted centroid of the samples nearest to each node, (n_nodes, 3); the node itself where there are none."""
    _, owner = cKDTree(nodes).query(samples, workers=-1)
    mass = np.bincount(owner, weights, minlength=len(nodes))
    moment = np.column_stack(
        [np.bincount(owner, weights * samples[:, axis], minlength=len(nodes)) for axis in range(3)]
    )
    return np.where(mass[:, None] > 0, moment / np.where(mass > 0, mass, 1.0)[:, None], nodes)


def _rings(surface: TriangleSurface, patch: Refinement) -> Array:
    """Nodes of a round patch: its centre, rings, one of them at its radius, and one ring beyond."""
    centre, triangle = closest_on_surface(np.array([patch.center_m]), surface)
    normals, _ = triangle_normals(surface)
    normal = normals[triangle[0]]
    n_rings = max(1, round(patch.radius_m / patch.spacing_m))
    nodes = [centre]
    first = np.cross(normal, np.eye(3)[np.argmin(np.abs(normal))])
    first /= np.linalg.norm(first)
    second = np.cross(normal, first)
    for k in range(1, n_rings + 2):
        rho = k * patch.radius_m / n_rings
        angle = 2 * np.pi * (np.arange(6 * k) + 0.5 * (k % 2)) / (6 * k)
        ring = centre + rho * (np.cos(angle)[:, None] * first + np.sin(angle)[:, None] * second)
        for _ in range(20):
            ring, _ = closest_on_surface(ring, surface)
            arm = ring - centre
            ring = centre + arm * (rho / np.linalg.norm(arm, axis=1, keepdims=True))
        ring, _ = closest_on_surface(ring, surface)
        nodes.append(ring)
    return np.vstack(nodes)
