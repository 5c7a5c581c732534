"""What a region holds ends at its edge: nodes lie in pairs on both sides of it."""

import numpy as np
import pytest
import trimesh

from palpate.discretization import conservative
from palpate.geometry.cloud import TriangleSurface
from palpate.geometry.fill import fill_surface
from palpate.geometry.region_edge import INSIDE, region_edge
from palpate.geometry.regions import distance_outside, nodes_in
from palpate.geometry.shapes import box_lattice
from palpate.geometry.spacing import SpacingField
from palpate.modes.held_body import hold
from palpate.modes.lanczos import lowest_modes
from palpate.scene.material import Material
from palpate.scene.regions import BoxRegion, PlaneRegion, SphereRegion

LENGTH, SIDE, HELD_UP_TO = 1.6, 0.6, 0.8
BLOCK = box_lattice((0, 0, 0), (LENGTH, SIDE, SIDE), (2, 2, 2)).surface
PART_OF_THE_BOTTOM = BoxRegion(lower_m=(-1, -1, -1), upper_m=(HELD_UP_TO, 1, 1e-3))

_ball = trimesh.creation.icosphere(subdivisions=4)
BALL = TriangleSurface(np.asarray(_ball.vertices), np.asarray(_ball.faces, dtype=np.int32))
CAPS = {
    "plane": PlaneRegion(point_m=(0, 0, 0.5), normal=(0, 0, 1)),
    "sphere": SphereRegion(center_m=(0, 0, 1), radius_m=1.0),  # ends at z = 1/2 as well
}


def filled(surface, region, spacing, seed=0):
    return fill_surface(surface, spacing, held=lambda p: distance_outside(region, p), seed=seed)


def test_within_a_box_the_distance_is_that_to_its_nearest_face():
    box = BoxRegion(lower_m=(0, 0, 0), upper_m=(1, 2, 3))
    points = np.array([[0.5, 1, 1.5], [0.9, 1, 1.5], [1, 1, 1], [1.3, 2.4, 1]])
    np.testing.assert_allclose(distance_outside(box, points), [-0.5, -0.1, 0, 0.5], atol=1e-12)


@pytest.mark.parametrize("kind", CAPS)
def test_the_edge_is_a_circle_and_points_out_of_the_region(kind):
    region = CAPS[kind]
    edge = region_edge(BALL, lambda p: distance_outside(region, p), SpacingField(0.2))
    a, b = edge.points[edge.segments[:, 0]], edge.points[edge.segments[:, 1]]
    assert np.linalg.norm(b - a, axis=1).sum() == pytest.approx(2 * np.pi * np.sqrt(0.75), rel=0.005)
    np.testing.assert_allclose(edge.points[edge.segments.ravel(), 2], 0.5, atol=0.005)
    assert edge.outward[:, 2].max() < -0.8
    assert not len(edge.on_sharp_edges.points)


@pytest.mark.parametrize("kind", CAPS)
def test_the_last_held_nodes_are_a_little_inside_and_the_next_a_spacing_further(kind):
    spacing = 0.2
    cloud = filled(BALL, CAPS[kind], spacing)
    latitude = np.arcsin(np.clip(cloud.points[cloud.boundary, 2], -1, 1))
    beyond = (np.pi / 6 - latitude) / spacing  # along the ball, from the edge at 30 degrees
    assert np.abs(beyond[(beyond > -0.7) & (beyond <= 0)] + INSIDE).max() < 0.1
    assert np.abs(beyond[(beyond > 0) & (beyond < 1)] - (1 - INSIDE)).max() < 0.15
    circle = 2 * np.pi * np.cos(np.pi / 6) / spacing
    assert np.sum(np.abs(beyond + INSIDE) < 0.1) == pytest.approx(circle, rel=0.15)


@pytest.mark.parametrize("kind", CAPS)
def test_the_held_nodes_stand_for_the_regions_area_and_the_strip_up_to_the_middle_of_the_pairs(kind):
    spacing = 0.2
    cloud = filled(BALL, CAPS[kind], spacing)
    middle = np.pi / 6 - (0.5 - INSIDE) * spacing
    area = cloud.areas[nodes_in(CAPS[kind], cloud)].sum()
    assert area == pytest.approx(2 * np.pi * (1 - np.sin(middle)), rel=0.015)


def test_where_the_edge_crosses_a_sharp_edge_a_pair_lies_on_it():
    cloud = filled(BLOCK, PART_OF_THE_BOTTOM, 0.15)
    points = cloud.points[cloud.boundary]
    on_edge = points[(points[:, 1] == 0) & (np.abs(points[:, 2]) < 1e-9)]
    beyond = np.sort((on_edge[:, 0] - HELD_UP_TO) / 0.15)
    for expected in (-INSIDE, 1 - INSIDE):
        assert np.abs(beyond - expected).min() < 1e-6
    assert np.sum((beyond > -0.8) & (beyond < 1.2)) == 2


def test_a_region_that_ends_at_a_sharp_edge_holds_the_face_with_its_edges_and_adds_no_nodes():
    face = PlaneRegion(point_m=(0, 0, 0), normal=(-1, 0, 0))
    cloud, free = filled(BLOCK, face, 0.15), fill_surface(BLOCK, 0.15)
    assert cloud.n_nodes == pytest.approx(free.n_nodes, rel=0.03)
    near = np.abs(cloud.points[:, 0]) < 0.5 * 0.15
    assert not cloud.points[near, 0].any()
    assert set(nodes_in(face, cloud)) == set(np.flatnonzero(near))


def test_the_same_seed_gives_the_same_cloud():
    first, second = (filled(BALL, CAPS["plane"], 0.25) for _ in range(2))
    np.testing.assert_array_equal(first.points, second.points)
    np.testing.assert_array_equal(first.areas, second.areas)


def test_a_region_that_holds_nothing_changes_nothing():
    away = PlaneRegion(point_m=(0, 0, 9), normal=(0, 0, 1))
    np.testing.assert_array_equal(filled(BALL, away, 0.25).points, fill_surface(BALL, 0.25).points)


NU = 0.45
FIRST_FREQUENCY = 0.4365
"""rad/s, E = rho = 1: quadratic hexahedra (scikit-fem), 18 x 8 x 7, finer towards the edge."""


def _first_frequency(spacing, seed):
    cloud = filled(BLOCK, PART_OF_THE_BOTTOM, spacing, seed)
    held = nodes_in(PART_OF_THE_BOTTOM, cloud)
    body = conservative.assemble(cloud, Material(1.0, NU, 1.0), held, [])
    return np.sqrt(lowest_modes(hold(body, held), 1).squared_frequencies[0])


def test_a_block_held_at_a_part_of_its_bottom_is_right_whatever_the_cloud():
    """Without pairs these clouds are 6 % apart."""
    found = np.array([_first_frequency(0.15, seed) for seed in range(2)])
    np.testing.assert_allclose(found, FIRST_FREQUENCY, rtol=0.02)
    assert np.ptp(found) < 0.015 * FIRST_FREQUENCY


@pytest.mark.slow
@pytest.mark.parametrize("spacing", [0.12, 0.1, 0.08])
def test_a_block_held_at_a_part_of_its_bottom_stays_right_as_the_cloud_is_refined(spacing):
    """Measured: 1.8 to 3.0 % too low. It does not fall with the spacing, for a reason that is not known."""
    found = np.array([_first_frequency(spacing, seed) for seed in range(2)])
    np.testing.assert_allclose(found, FIRST_FREQUENCY, rtol=0.035)
