"""Fill the inside of a closed triangle surface with nodes, at a spacing that may vary from place to place."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from palpate.geometry.cloud import NodeCloud, TriangleSurface
from palpate.geometry.measures import enclosed_volume, triangle_normals
from palpate.geometry.sampling import (
    InnerSamples,
    Samples,
    closest_point,
    depth_inside,
    sample_elements,
    sample_inside,
)
from palpate.geometry.sharp_edges import sharp_edges
from palpate.geometry.spacing import RefinedArea, Refinement, SpacingField
from palpate.geometry.tributary import nearest_node, tributary_cells, tributary_measures
from palpate.geometry.visibility import Gaps, find_gaps
from palpate.memory import machine_memory

Array = NDArray[np.float64]

_PLACING, _MEASURING = 1 / 4, 1 / 8
"""Distance of samples over that of nodes, where nodes are placed and where their shares are measured."""

_DISC = {1: 0.75, 2: 0.81, 3: 0.86}
"""Distance over spacing at which points dropped at random until none fits have 1 node per spacing^dimension."""

_RELAXATIONS = 12

_BYTES_A_NODE = 50_000
"""Memory of the samples, 8³ a node, while the shares are measured."""


def fill_surface(
    surface: TriangleSurface,
    spacing_m: float,
    refinements: Sequence[Refinement] = (),
    refined_areas: Sequence[RefinedArea] = (),
    seed: int = 0,
) -> NodeCloud:
    """Fill the inside of a surface that `check_surface` accepts; the boundary nodes lie on it and come first.

    spacing_m    distance between nodes away from the refinements, m
    refinements  round patches with nodes closer together
    refined_areas  parts of the surface with nodes closer together
    seed         of the random order in which nodes are placed; the same seed gives the same cloud

    Nodes are placed on round patches, corners, sharp edges, faces and inside, in this order. Each time they are
    dropped at random on a fine sampling, none closer to another than allowed (Poisson discs), then moved to the
    centroids of the samples nearest to them, weighted so that the local spacing comes out as asked (Lloyd's
    iteration for a centroidal Voronoi tessellation with density h^-(dimension + 2), Du et al. 1999).

    Volumes and areas are what is nearest to the node, in samples 1/8 spacing apart, and sum to the body's; normals
    are the mean over that area.

    Raises ValueError when the spacing doesn't suit the body or a round patch finds no place on it.
    """
    refinements = tuple(_fitted(r, surface) for r in refinements)
    field = SpacingField(spacing_m, refinements, tuple(refined_areas))
    _check_spacing(surface, field)
    rng = np.random.default_rng(seed)
    gaps = find_gaps(surface, field)
    boundary = _boundary_nodes(surface, field, gaps, rng)

    samples = sample_inside(surface, field, _PLACING)
    room = _deeper_than(0.5 * samples.spacing, samples, surface)
    points = _place(boundary, samples, room, 3, lambda p: p, field, gaps, rng)
    n_boundary = len(boundary)
    if len(points) == n_boundary:
        raise ValueError(
            f"spacing_m = {spacing_m}: no node found room inside the body, expected a smaller spacing"
        )

    areas, normals = np.zeros(len(points)), np.zeros_like(points)
    areas[:n_boundary], normals[:n_boundary] = _areas_and_normals(boundary, surface, field, gaps)
    samples = sample_inside(surface, field, _MEASURING)
    sight = gaps.sight(samples.points)
    cells = tributary_cells(points, samples.points, samples.measures, enclosed_volume(surface), sight)
    return NodeCloud(
        points=points,
        normals=normals,
        volumes=cells.volumes,
        centroids=cells.centroids,
        moments=cells.moments,
        areas=areas,
        boundary=np.arange(len(points)) < n_boundary,
        spacing=field(points),
        surface=surface,
        gaps=gaps,
    )


def _deeper_than(depth_m: Array, samples: InnerSamples, surface: TriangleSurface) -> NDArray[np.bool_]:
    """(n_samples,): whether each sample is deeper inside than its depth (n_samples,)."""
    deeper = samples.least_depth > depth_m
    unsure = np.flatnonzero(~deeper)
    deeper[unsure] = depth_inside(samples.points[unsure], surface) > depth_m[unsure]
    return deeper


def _check_spacing(surface: TriangleSurface, field: SpacingField) -> None:
    spacing_m = field.spacing_m
    extent = np.ptp(surface.vertices, axis=0)
    if spacing_m > extent.max() / 4:
        raise ValueError(
            f"spacing_m = {spacing_m}: expected at most a quarter of the body's largest extent, "
            f"{' x '.join(f'{e:.3g}' for e in extent)} m"
        )
    volume = enclosed_volume(surface)
    fine = sum(min(volume, 4 / 3 * np.pi * r.radius_m**3) / r.spacing_m**3 for r in field.refinements)
    fine += sum(a.area_m2 / a.spacing_m**2 * (1 + 1 / a.growth) / 2 for a in field.areas)
    estimate = volume / spacing_m**3 + fine
    needed, present = _BYTES_A_NODE * estimate, machine_memory()
    if needed > present:
        raise ValueError(
            f"spacing_m = {spacing_m} would give some {estimate:.2g} nodes in a body of "
            f"{' x '.join(f'{e:.3g}' for e in extent)} m, whose samples alone need {needed / 2**30:.2g} GiB: this machine has "
            f"{present / 2**30:.2g}; expected a larger spacing"
        )


def _boundary_nodes(
    surface: TriangleSurface, field: SpacingField, gaps: Gaps, rng: np.random.Generator
) -> Array:
    """(n_boundary, 3): patch rings, then corners, sharp edges and faces of the surface, m."""
    vertices, triangles = surface.vertices, surface.triangles
    nodes = _patches(surface, field)
    edges, corners = sharp_edges(surface)
    nodes = np.vstack([nodes, _spread(vertices[corners], nodes, 1, field, gaps, rng)])
    if len(edges):
        samples, _ = sample_elements(vertices, edges, field, _PLACING / 2)
        nodes = _place(
            nodes, samples, None, 1, lambda p: closest_point(p, vertices, edges)[0], field, gaps, rng
        )
    samples, _ = sample_elements(vertices, triangles, field, _PLACING)
    return _place(
        nodes, samples, None, 2, lambda p: closest_point(p, vertices, triangles)[0], field, gaps, rng
    )


def _place(
    fixed: Array,
    samples: Samples,
    room: NDArray[np.bool_] | None,
    dimension: int,
    project: Callable[[Array], Array],
    field: SpacingField,
    gaps: Gaps,
    rng: np.random.Generator,
) -> Array:
    """The fixed nodes and, after them, new ones spread among the samples (those with room, if given) and relaxed."""
    candidates = samples.points if room is None else samples.points[room]
    free = _spread(candidates, fixed, dimension, field, gaps, rng)
    sight = gaps.sight(samples.points)
    weights = samples.measures / samples.spacing ** (dimension + 2)
    for _ in range(_RELAXATIONS):
        nodes = np.vstack([fixed, free])
        owner = nearest_node(nodes, samples.points, sight)
        mass = np.bincount(owner, weights, minlength=len(nodes))[len(fixed) :]
        moment = np.column_stack(
            [np.bincount(owner, weights * x, minlength=len(nodes))[len(fixed) :] for x in samples.points.T]
        )
        free = project(np.where(mass[:, None] > 0, moment / np.where(mass > 0, mass, 1.0)[:, None], free))
    return np.vstack([fixed, free])


def _spread(
    candidates: Array,
    fixed: Array,
    dimension: int,
    field: SpacingField,
    gaps: Gaps,
    rng: np.random.Generator,
) -> Array:
    """The candidates in random order, less those within the disc of a fixed node or of one taken before, (n, 3).

    A disc ends at a gap.
    """
    if not len(candidates):
        return candidates
    tree = cKDTree(candidates)
    points = np.vstack([candidates, fixed])
    beside, eyes = gaps.beside(points), gaps.eyes(points)
    radii = _DISC[dimension] * field(points)
    alive = np.ones(len(candidates), dtype=bool)

    def clear_disc(i: int) -> None:
        near = np.array(tree.query_ball_point(points[i], radii[i]), dtype=np.intp)
        if beside[i]:
            near = near[~gaps.hidden(np.tile(eyes[i], (len(near), 1)), eyes[near])]
        alive[near] = False

    for i in range(len(candidates), len(points)):
        clear_disc(i)
    taken = []
    for i in rng.permutation(len(candidates)):
        if alive[i]:
            taken.append(i)
            clear_disc(i)
            alive[i] = False
    return candidates[taken]


def _fitted(patch: Refinement, surface: TriangleSurface) -> Refinement:
    """The patch moved to the surface point nearest to its center, its spacing (reduced) such that its rings fit."""
    closest, _ = closest_point(np.array([patch.center_m]), surface.vertices, surface.triangles)
    x, y, z = closest[0].tolist()
    spacing = patch.radius_m / (_n_rings(patch) + 0.5)
    return replace(patch, center_m=(x, y, z), spacing_m=spacing)


def _n_rings(patch: Refinement) -> int:
    """The fewest rings within a patch, at spacing s, 2 s, ..., with radius = (n_rings + 1/2) s and s <= spacing."""
    return max(1, math.ceil(patch.radius_m / patch.spacing_m - 0.5 - 1e-9))


def _patches(surface: TriangleSurface, field: SpacingField) -> Array:
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


def _areas_and_normals(
    nodes: Array, surface: TriangleSurface, field: SpacingField, gaps: Gaps
) -> tuple[Array, Array]:
    """Areas (n,), m², and unit normals (n, 3) of boundary nodes, over the part of the surface nearest to each."""
    vertices, triangles = surface.vertices, surface.triangles
    face_normals, face_areas = triangle_normals(surface)
    samples, triangle = sample_elements(vertices, triangles, field, _MEASURING)
    sight = gaps.sight(samples.points)
    owner = nearest_node(nodes, samples.points, sight)
    areas = tributary_measures(nodes, samples.points, samples.measures, float(face_areas.sum()), sight)
    # Where the body is thin a node may be nearest to a part of the far side as well; its normal is that of its own.
    _, own = closest_point(nodes, vertices, triangles)
    vectors = face_normals[triangle] * samples.measures[:, None]
    same_side = np.einsum("si,si->s", face_normals[triangle], face_normals[own[owner]]) > -0.5
    normals = np.column_stack(
        [np.bincount(owner[same_side], v[same_side], minlength=len(nodes)) for v in vectors.T]
    )
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    return areas, np.where(length > 0, normals / np.where(length > 0, length, 1.0), face_normals[own])
