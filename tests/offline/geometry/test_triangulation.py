"""Polygons become triangles of the same outline, and vertices at one place become one."""

from __future__ import annotations

import numpy as np
import pytest

from palpate.geometry.readers import Polygons, ReadError
from palpate.geometry.triangulation import triangulate, weld


def one_polygon(outline: np.ndarray) -> Polygons:
    n = len(outline)
    return Polygons(np.asarray(outline, float), np.arange(n), np.array([n]), first=1, indexed=True)


def star(n: int, inner: float, seed: int) -> np.ndarray:
    """A star in a plane of random direction, (2 n, 3)."""
    angle = np.pi * np.arange(2 * n) / n
    radius = np.where(np.arange(2 * n) % 2, inner, 1.0)
    flat = np.column_stack([radius * np.cos(angle), radius * np.sin(angle), np.zeros(2 * n)])
    turn, _ = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    return flat @ turn.T * np.linalg.det(turn) + [5.0, -3.0, 2.0]


def area_vectors(vertices: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    a, b, c = np.moveaxis(vertices[triangles], 1, 0)
    return np.cross(b - a, c - a) / 2


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize("n", [2, 3, 7])
def test_a_concave_polygon_keeps_its_area_and_its_side(n: int, seed: int) -> None:
    outline = star(n, 0.3, seed)
    triangles, owner = triangulate(one_polygon(outline))
    assert len(triangles) == 2 * n - 2
    assert not owner.any()
    parts = area_vectors(outline, triangles)
    whole = np.cross(outline, np.roll(outline, -1, axis=0)).sum(axis=0) / 2
    # Triangles that overlapped, or lay outside, would have more area than the outline encloses.
    assert np.linalg.norm(parts, axis=1).sum() == pytest.approx(np.linalg.norm(whole), rel=1e-12)
    assert np.all(parts @ whole > 0)


@pytest.mark.parametrize("turn", range(4))
def test_a_concave_quadrilateral_is_cut_inside(turn: int) -> None:
    dart = np.roll([[0, 0, 0], [2, 2, 0], [0, 1, 0], [-2, 2, 0]], turn, axis=0)
    triangles, _ = triangulate(one_polygon(dart))
    np.testing.assert_allclose(area_vectors(dart.astype(float), triangles)[:, 2], [1, 1])


@pytest.mark.parametrize("turn", range(4))
def test_a_quadrilateral_with_three_corners_in_a_line_gets_triangles_with_an_area(turn: int) -> None:
    outline = np.roll([[0, 0, 0], [1, 0, 0], [2, 0, 0], [0, 2, 0]], turn, axis=0)
    triangles, _ = triangulate(one_polygon(outline))
    np.testing.assert_allclose(area_vectors(outline.astype(float), triangles)[:, 2], [1, 1])


def test_vertices_on_a_straight_edge_stay_vertices() -> None:
    x = [0, 1, 2, 3, 3, 3, 2, 1, 0, 0]
    y = [0, 0, 0, 0, 1, 2, 2, 2, 2, 1]
    triangles, _ = triangulate(one_polygon(np.column_stack([x, y, np.zeros(10)])))
    assert set(triangles.ravel()) == set(range(10))
    assert len(triangles) == 8


@pytest.mark.parametrize("outline", [[0, 2, 1, 3], [0, 2, 4, 1, 3]])
def test_a_polygon_that_crosses_itself_is_refused(outline: list[int]) -> None:
    angle = 2 * np.pi * np.arange(max(outline) + 1) / (max(outline) + 1)
    ring = np.column_stack([np.cos(angle), np.sin(angle), 0 * angle])
    with pytest.raises(ReadError, match=r"1 faces cross themselves.* the first is face 1"):
        triangulate(one_polygon(ring[outline]))


def test_triangles_keep_the_order_of_the_file() -> None:
    vertices = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [2, 0, 0]], float)
    polygons = Polygons(
        vertices, np.array([0, 1, 2, 0, 1, 2, 3, 1, 4, 2]), np.array([3, 4, 3]), first=0, indexed=True
    )
    triangles, owner = triangulate(polygons)
    np.testing.assert_array_equal(owner, [0, 1, 1, 2])
    np.testing.assert_array_equal(triangles[[0, 3]], [[0, 1, 2], [1, 4, 2]])


def test_welding_joins_what_is_near_and_drops_what_collapses() -> None:
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1e-9, 0, 0], [1, 1, 0], [9, 9, 9]], float)
    triangles = np.array([[0, 1, 2], [3, 4, 2], [0, 3, 2]])
    welded = weld(vertices, triangles, np.array([5, 6, 7]), 1e-8)
    assert (welded.n_merged, welded.n_dropped) == (1, 1)
    np.testing.assert_array_equal(welded.owner, [5, 6])
    np.testing.assert_allclose(welded.vertices[welded.triangles], vertices[triangles[:2]], atol=1e-8, rtol=0)
    np.testing.assert_array_equal(vertices[welded.original], welded.vertices)
    assert len(welded.vertices) == 4, "unused vertices are dropped"
