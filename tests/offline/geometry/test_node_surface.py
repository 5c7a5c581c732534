"""The surface through the boundary nodes: closed, of every node once, near the body's own, with good triangles."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from palpate.geometry.cloud import NodeCloud, TriangleSurface
from palpate.geometry.fill import fill_surface
from palpate.geometry.measures import enclosed_volume, triangle_normals
from palpate.geometry.node_surface import NodeSurfaceError, node_surface
from palpate.geometry.shapes import ball, box_lattice
from palpate.geometry.spacing import RefinedArea


def _angles(surface: TriangleSurface) -> np.ndarray:
    """(n, 3), degrees."""
    corners = surface.vertices[surface.triangles]
    one, other = np.roll(corners, -1, axis=1) - corners, np.roll(corners, 1, axis=1) - corners
    cosine = np.sum(one * other, axis=2) / np.linalg.norm(one, axis=2) / np.linalg.norm(other, axis=2)
    return np.degrees(np.arccos(np.clip(cosine, -1, 1)))


def _check(cloud: NodeCloud, volume_within: float) -> TriangleSurface:
    surface = node_surface(cloud)
    n = int(cloud.boundary.sum())
    np.testing.assert_array_equal(surface.vertices, cloud.points[cloud.boundary])
    assert set(surface.triangles.ravel().tolist()) == set(range(n))
    edges = np.stack([surface.triangles, np.roll(surface.triangles, -1, axis=1)], axis=2).reshape(-1, 2)
    directed = {tuple(edge) for edge in edges.tolist()}
    assert len(directed) == len(edges)
    assert {(b, a) for a, b in directed} == directed
    assert len(surface.triangles) == 2 * n - 4  # Euler: one body without handles
    assert abs(enclosed_volume(surface) / enclosed_volume(cloud.surface) - 1) < volume_within
    return surface


def test_scattered_nodes_of_a_ball_give_triangles_without_needles() -> None:
    cloud = ball(0.05, 0.01)
    # A polyhedron with n corners on a sphere has 1 - 4 pi^2 / (3 sqrt 3 n) of its volume at best.
    n = int(cloud.boundary.sum())
    surface = _check(cloud, 2 * 4 * np.pi**2 / (3 * np.sqrt(3) * n))
    assert _angles(surface).min() > 20
    outward = np.einsum(
        "ti,ti->t", triangle_normals(surface)[0], surface.vertices[surface.triangles].mean(axis=1)
    )
    assert np.all(outward > 0)


def test_a_lattice_with_its_ties_gives_a_closed_box() -> None:
    _check(box_lattice((0, 0, 0), (0.04, 0.03, 0.02), (5, 4, 3)), 1e-12)


def test_the_two_sides_of_a_slit_and_of_a_thin_part_stay_apart(prongs: NodeCloud) -> None:
    _check(prongs, 0.05)


def test_a_refined_area_has_small_triangles_and_the_rest_large_ones() -> None:
    body = ball(0.05, 0.006).surface
    rng = np.random.default_rng(0)
    cap = rng.standard_normal((20_000, 3))
    cap = 0.05 * cap / np.linalg.norm(cap, axis=1, keepdims=True)
    cap = cap[cap[:, 2] > 0.035]
    area = 2 * np.pi * 0.05 * 0.015
    cloud = fill_surface(body, 0.016, refined_areas=[RefinedArea(cap, area, 0.005)])
    on_cap = cloud.boundary & (cloud.points[:, 2] > 0.036)
    assert abs(on_cap.sum() / (area * 14 / 15 / 0.005**2) - 1) < 0.15
    surface = _check(cloud, 0.1)
    corners = surface.vertices[surface.triangles]
    edges = np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=2).max(axis=1)
    height = corners.mean(axis=1)[:, 2]
    assert edges[height > 0.036].max() < 0.009
    assert np.median(edges[height < -0.03]) > 0.014


def test_nodes_that_are_too_few_for_the_shape_are_refused() -> None:
    cloud = ball(0.05, 0.01)
    few = np.flatnonzero(cloud.boundary)[:3]
    boundary = np.zeros(cloud.n_nodes, bool)
    boundary[few] = True
    with pytest.raises(NodeSurfaceError, match="too far apart for the shape of the body"):
        node_surface(replace(cloud, boundary=boundary))
