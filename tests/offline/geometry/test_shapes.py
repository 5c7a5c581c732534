"""Lattice boxes and balls: exact measures, outward normals, and the arguments they refuse."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from palpate.geometry.measures import enclosed_volume
from palpate.geometry.shapes import ball, box_lattice
from palpate.geometry.soundness import check_surface

LOWER, UPPER = (-1.0, 0.0, 2.0), (1.0, 3.0, 3.0)
COUNTS = (5, 7, 4)


@pytest.mark.parametrize("jitter", [0.0, 0.3])
def test_volumes_and_areas_of_a_box_sum_to_its_own(jitter):
    cloud = box_lattice(LOWER, UPPER, COUNTS, jitter, seed=3)
    assert cloud.n_nodes == np.prod(COUNTS)
    assert cloud.volumes.sum() == pytest.approx(6.0, rel=1e-13)
    assert cloud.areas.sum() == pytest.approx(22.0, rel=1e-13)
    assert cloud.volumes.min() > 0
    assert np.all((cloud.areas > 0) == cloud.boundary)


def test_lattice_volumes_integrate_multilinear_functions_exactly():
    cloud = box_lattice(LOWER, UPPER, COUNTS)
    x, y, z = cloud.points.T
    # The product of the integrals over [-1, 1], [0, 3] and [2, 3].
    assert cloud.volumes @ ((1 + x) * (2 - y) * z) == pytest.approx(2.0 * 1.5 * 2.5, rel=1e-13)


def test_nine_nodes_along_a_metre_are_an_eighth_apart():
    cloud = box_lattice((0, 0, 0), (1, 1, 1), (9, 9, 9))
    distance, _ = cKDTree(cloud.points).query(cloud.points, k=2)
    np.testing.assert_allclose(distance[:, 1], 1 / 8, rtol=1e-14)
    np.testing.assert_array_equal(cloud.spacing, 1 / 8)


@pytest.mark.parametrize("jitter", [0.0, 0.3])
def test_the_boundary_nodes_of_a_box_are_those_on_its_faces(jitter):
    cloud = box_lattice(LOWER, UPPER, COUNTS, jitter)
    strictly_inside = np.all((cloud.points > LOWER) & (cloud.points < UPPER), axis=1)
    np.testing.assert_array_equal(cloud.boundary, ~strictly_inside)
    on_a_face = np.any((cloud.points == LOWER) | (cloud.points == UPPER), axis=1)
    np.testing.assert_array_equal(cloud.boundary, on_a_face)


def test_normals_are_unit_and_edges_average_their_faces_by_area():
    cloud = box_lattice((0, 0, 0), (2, 1, 1), (3, 3, 3))  # steps 1, 1/2, 1/2
    np.testing.assert_allclose(np.linalg.norm(cloud.normals[cloud.boundary], axis=1), 1, rtol=1e-14)
    assert not cloud.normals[~cloud.boundary].any()

    def normal_at(point):
        return cloud.normals[np.argmin(np.linalg.norm(cloud.points - point, axis=1))]

    np.testing.assert_array_equal(normal_at((1, 0.5, 1)), (0, 0, 1))
    # Edge along y at x = 2, z = 1: 1/2 * 1/4 of face x+ and 1/2 * 1/2 of face z+.
    np.testing.assert_allclose(normal_at((2, 0.5, 1)), np.array([1, 0, 2]) / np.sqrt(5), rtol=1e-14)
    # Corner: 1/16 of face x+, 1/8 of each of the others.
    np.testing.assert_allclose(normal_at((2, 1, 1)), np.array([1, 2, 2]) / 3, rtol=1e-14)


def test_jitter_moves_nodes_only_within_what_they_lie_on():
    straight, jittered = (box_lattice(LOWER, UPPER, COUNTS, j, seed=1) for j in (0.0, 0.3))
    step = (np.array(UPPER) - LOWER) / (np.array(COUNTS) - 1)
    shift = (jittered.points - straight.points) / step
    pinned = (straight.points == LOWER) | (straight.points == UPPER)
    assert np.all(shift[pinned] == 0)
    assert np.all(shift[~pinned] != 0)
    assert np.abs(shift).max() <= 0.3


def test_jittered_volumes_are_those_of_the_nearest_points():
    cloud = box_lattice((0, 0, 0), (1, 1, 1), (5, 5, 5), 0.3, seed=2)
    samples = np.random.default_rng(0).uniform(size=(200_000, 3))
    _, owner = cKDTree(cloud.points).query(samples)
    counted = np.bincount(owner, minlength=cloud.n_nodes)
    expected = cloud.volumes * len(samples)
    # Poisson noise of the count, five sigma, and the grid of 8 samples a spacing: 1 % of a cell of 1/64.
    assert np.all(np.abs(counted - expected) < 5 * np.sqrt(expected) + 0.02 * len(samples) / 64)


def test_the_same_seed_gives_the_same_box_and_another_seed_another():
    a, b, c = (box_lattice((0, 0, 0), (1, 1, 1), (4, 4, 4), 0.2, seed=s) for s in (5, 5, 6))
    np.testing.assert_array_equal(a.points, b.points)
    np.testing.assert_array_equal(a.volumes, b.volumes)
    assert not np.array_equal(a.points, c.points)


@pytest.mark.parametrize(
    "surface",
    [box_lattice(LOWER, UPPER, COUNTS).surface, box_lattice(LOWER, UPPER, (2, 2, 2)).surface],
    ids=["lattice", "twelve triangles"],
)
def test_surface_of_a_box_is_closed_outward_and_holds_its_volume(surface):
    check_surface(surface)
    assert enclosed_volume(surface) == pytest.approx(6.0, rel=1e-13)


def test_a_ball_has_its_volume_its_area_and_radial_normals():
    cloud = ball(0.1, 0.02)
    assert cloud.volumes.sum() == pytest.approx(4 / 3 * np.pi * 0.1**3, rel=1e-13)
    assert cloud.areas.sum() == pytest.approx(4 * np.pi * 0.1**2, rel=1e-13)
    assert cloud.volumes.min() > 0
    np.testing.assert_allclose(cloud.normals[cloud.boundary], cloud.points[cloud.boundary] / 0.1, atol=1e-14)
    assert np.linalg.norm(cloud.points[~cloud.boundary], axis=1).max() <= 0.1 - 0.6 * 0.02
    check_surface(cloud.surface)


def test_ball_volumes_give_its_moment_of_inertia():
    radius, errors = 1.0, []
    for spacing in (0.25, 0.125):
        cloud = ball(radius, spacing)
        polar = cloud.volumes @ (cloud.points**2).sum(axis=1)
        errors.append(abs(polar / (4 / 3 * np.pi * 3 / 5) - 1))
    # Lumping a cell at its node costs its own moment, O(spacing²): a quarter at half the spacing, here with slack.
    assert errors[1] < 0.4 * errors[0]
    assert errors[1] < 0.125**2
