"""Geometry of the page: rays, normals, points that are touched, bands of a value."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from palpate_view.surface import bands, ray_hit, split, touched_points, vertex_normals


@pytest.fixture(scope="module")
def ball() -> trimesh.Trimesh:
    return trimesh.creation.icosphere(subdivisions=3, radius=0.05)


def area(corners: np.ndarray) -> float:
    return float(
        np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).sum()
        / 2
    )


def test_normals_of_a_ball_point_away_from_its_center(ball: trimesh.Trimesh) -> None:
    vertices = np.asarray(ball.vertices)
    normals = vertex_normals(vertices, np.asarray(ball.faces, np.int32))
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, rtol=1e-12)
    assert (np.einsum("ij,ij->i", normals, vertices) / 0.05).min() > 0.999


def test_rays_hit_a_box_where_its_planes_say() -> None:
    rng = np.random.default_rng(5)
    half = np.array([0.03, 0.02, 0.05])
    box = trimesh.creation.box(2 * half)
    vertices, faces = np.asarray(box.vertices), np.asarray(box.faces, np.int32)
    normals = vertex_normals(vertices, faces)
    missed = 0
    for _ in range(200):
        origin = rng.normal(size=3)
        origin *= 0.2 / np.linalg.norm(origin)
        direction = rng.uniform(-0.07, 0.07, 3) - origin
        found = ray_hit(origin, direction, vertices, normals, faces)
        # Inside the box is inside three slabs (Kay & Kajiya 1986).
        entry = ((-np.sign(direction) * half - origin) / direction).max()
        leave = ((np.sign(direction) * half - origin) / direction).min()
        if entry >= leave:
            assert found is None
            missed += 1
            continue
        assert found is not None
        np.testing.assert_allclose(found.point_m, origin + entry * direction, atol=1e-12)
        side = ((-np.sign(direction) * half - origin) / direction).argmax()
        assert found.normal[side] * direction[side] < 0  # outward of the face that the ray enters
    assert 20 < missed < 180


def test_a_ray_from_inside_hits_nothing(ball: trimesh.Trimesh) -> None:
    vertices, faces = np.asarray(ball.vertices), np.asarray(ball.faces, np.int32)
    normals = vertex_normals(vertices, faces)
    assert ray_hit(np.zeros(3), np.array([0.0, 0.0, 1.0]), vertices, normals, faces) is None


def test_a_sphere_touches_the_points_that_it_presses(ball: trimesh.Trimesh) -> None:
    vertices = np.asarray(ball.vertices)
    top = vertices[vertices[:, 2].argmax()]
    radius = 0.005
    pressed = touched_points(vertices, top * (1 + (radius - 0.0005) / 0.05), radius)
    assert len(pressed) >= 1 and (pressed == top).all(axis=1).any()
    assert len(touched_points(vertices, top * 1.2, radius)) == 0


def test_a_cut_keeps_the_area_and_the_orientation(ball: trimesh.Trimesh) -> None:
    vertices, faces = np.asarray(ball.vertices), np.asarray(ball.faces)
    corners, values = vertices[faces], vertices[:, 2][faces]
    (below, low), (above, high) = split(corners, values, 0.0123)
    assert low.max() <= 0.0123 <= high.min()
    assert area(below) + area(above) == pytest.approx(area(corners), rel=1e-12)
    np.testing.assert_allclose(low, below[:, :, 2], atol=1e-15)  # the value is linear on a triangle
    outward = np.cross(above[:, 1] - above[:, 0], above[:, 2] - above[:, 0])
    assert (np.einsum("ij,ij->i", outward, above.mean(axis=1)) >= 0).all()


def test_bands_are_what_lies_between_the_levels(ball: trimesh.Trimesh) -> None:
    vertices, faces = np.asarray(ball.vertices), np.asarray(ball.faces, np.int32)
    values, levels = vertices[:, 2], np.array([-0.01, 0.0, 0.02])
    found = bands(vertices, faces, values, levels)
    assert len(found) == 3
    for (points, triangles), low, high in zip(found, levels, [0.0, 0.02, 0.05], strict=True):
        assert len(triangles) and points[:, 2].min() >= low - 1e-8 and points[:, 2].max() <= high + 1e-8
    whole = split(vertices[faces], values[faces], -0.01)[1][0]
    assert sum(area(points[triangles].astype(float)) for points, triangles in found) == pytest.approx(
        area(whole), rel=1e-5
    )


def test_a_value_below_every_level_gives_empty_bands(ball: trimesh.Trimesh) -> None:
    vertices, faces = np.asarray(ball.vertices), np.asarray(ball.faces, np.int32)
    assert [len(t) for _, t in bands(vertices, faces, np.zeros(len(vertices)), np.array([0.1, 0.2]))] == [
        0,
        0,
    ]
