"""Fill the inside of a closed triangle surface with nodes, at a spacing that may vary from place to place."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from palpate.geometry.cloud import NodeCloud, TriangleSurface
from palpate.geometry.measures import enclosed_volume, triangle_normals
from palpate.geometry.placing import Placement
from palpate.geometry.region_edge import Distance, paired_nodes, region_edge, spread_along
from palpate.geometry.round_patch import MIDWAY, fitted, patch_nodes
from palpate.geometry.sampling import (
    InnerSamples,
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

_BYTES_A_NODE = 50_000
"""Memory of the samples, 8³ a node, while the shares are measured."""


def fill_surface(
    surface: TriangleSurface,
    spacing_m: float,
    refinements: Sequence[Refinement] = (),
    refined_areas: Sequence[RefinedArea] = (),
    held: Distance | None = None,
    seed: int = 0,
) -> NodeCloud:
    """Fill the inside of a surface that `check_surface` accepts; the boundary nodes lie on it and come first.

    spacing_m    distance between nodes away from the refinements, m
    refinements  round patches with nodes closer together
    refined_areas  parts of the surface with nodes closer together
    held         distance outside the part that is to be held: along its edge nodes lie in pairs (see `region_edge`)
    seed         of the random order in which nodes are placed; the same seed gives the same cloud

    Nodes are placed on round patches, corners, sharp edges, faces and inside, in this order. Each time they are
    dropped at random on a fine sampling, none closer to another than allowed (Poisson discs), then moved to the
    centroids of the samples nearest to them, weighted so that the local spacing comes out as asked (Lloyd's
    iteration for a centroidal Voronoi tessellation with density h^-(dimension + 2), Du et al. 1999).

    Volumes and areas are what is nearest to the node, in samples 1/8 spacing apart, and sum to the body's; normals
    are the mean over that area.

    Raises ValueError when the spacing doesn't suit the body or a round patch finds no place on it.
    """
    refinements = tuple(fitted(r, surface) for r in refinements)
    field = SpacingField(spacing_m, refinements, tuple(refined_areas))
    _check_spacing(surface, field)
    gaps = find_gaps(surface, field)
    placement = Placement(field, gaps, np.random.default_rng(seed))
    boundary = _boundary_nodes(surface, placement, held)

    samples = sample_inside(surface, field, _PLACING)
    room = _deeper_than(0.5 * samples.spacing, samples, surface)
    points = placement.place(boundary, samples, 3, lambda p: p, room)
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


def _boundary_nodes(surface: TriangleSurface, placement: Placement, held: Distance | None) -> Array:
    """(n_boundary, 3): round patches, then corners, sharp edges and faces of the surface, m.

    On sharp edges and on faces the pairs along the edges of the held part and of folded patches come first.
    """
    vertices, triangles, field = surface.vertices, surface.triangles, placement.field
    patches = patch_nodes(surface, field.refinements)
    borders = [] if held is None else [region_edge(surface, held, field)]
    borders += [region_edge(surface, p.distance_outside, field, MIDWAY) for p in patches.folded]
    edges, corners = sharp_edges(surface)
    nodes = np.vstack([patches.nodes, placement.spread(vertices[corners], patches.nodes, 1)])

    def on_edges(points: Array) -> Array:
        return closest_point(points, vertices, edges)[0]

    def on_faces(points: Array) -> Array:
        return closest_point(points, vertices, triangles)[0]

    if len(edges):
        for border in borders:
            pairs = paired_nodes(border, border.on_sharp_edges, on_edges, field, nodes)
            nodes = np.vstack([nodes, pairs])
        samples, _ = sample_elements(vertices, edges, field, _PLACING / 2)
        nodes = placement.place(nodes, samples, 1, on_edges)
    for border in borders:
        pairs = paired_nodes(border, spread_along(border, placement), on_faces, field, nodes)
        nodes = np.vstack([nodes, pairs])
    samples, _ = sample_elements(vertices, triangles, field, _PLACING)
    return placement.place(nodes, samples, 2, on_faces)


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
