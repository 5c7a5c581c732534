"""Regions choose the boundary nodes they hold, and say so when they hold none."""

import numpy as np
import pytest

from palpate.geometry.regions import RegionError, contact_patch, nodes_in
from palpate.geometry.shapes import ball, box_lattice
from palpate.scene.regions import BoxRegion, NearestRegion, PlaneRegion, SphereRegion

CUBE = box_lattice((0, 0, 0), (1, 1, 1), (5, 5, 5))
SEVENTHS = box_lattice((0, 0, 0), (1, 1, 1), (8, 8, 8))


def points_of(nodes):
    return {tuple(p) for p in CUBE.points[nodes].tolist()}


def test_a_box_takes_the_boundary_nodes_within_it_and_no_others():
    nodes = nodes_in(BoxRegion(lower_m=(0, 0, 0), upper_m=(1, 0.25, 0.25)), CUBE)
    assert points_of(nodes) == {
        (x, y, z)
        for x in (0, 0.25, 0.5, 0.75, 1)
        for y in (0, 0.25)
        for z in (0, 0.25)
        if x in (0, 1) or y == 0 or z == 0
    }
    assert np.all(np.diff(nodes) > 0)


def test_a_plane_takes_its_positive_side():
    nodes = nodes_in(PlaneRegion(point_m=(0, 0, 0), normal=(0, 0, -2.5)), CUBE)
    assert len(nodes) == 25
    assert not CUBE.points[nodes, 2].any()


def test_round_off_does_not_lose_nodes_on_the_edge():
    nodes = nodes_in(PlaneRegion(point_m=(0, 0, 3 * (1 / 7) + 1e-12), normal=(0, 0, 1)), SEVENTHS)
    assert SEVENTHS.points[nodes, 2].min() == pytest.approx(3 / 7)


def test_a_sphere_takes_what_is_within_its_radius():
    nodes = nodes_in(SphereRegion(center_m=(0.5, 0.5, 1), radius_m=0.25), CUBE)
    assert points_of(nodes) == {
        (0.5, 0.5, 1), (0.25, 0.5, 1), (0.75, 0.5, 1), (0.5, 0.25, 1), (0.5, 0.75, 1)
    }  # fmt: skip


def test_nearest_takes_one_boundary_node_though_an_inner_one_is_nearer():
    assert points_of(nodes_in(NearestRegion(point_m=(0.5, 0.5, 0.65)), CUBE)) == {(0.5, 0.5, 1)}


@pytest.mark.parametrize(
    ("region", "says", "distance"),
    [
        (
            BoxRegion(lower_m=(2, 0, 0), upper_m=(3, 1, 1)),
            "the box from lower_m = [2.0, 0.0, 0.0] to upper_m",
            "1 m",
        ),
        (
            PlaneRegion(point_m=(0, 0, 1.5), normal=(0, 0, 1)),
            "plane through point_m = [0.0, 0.0, 1.5]",
            "0.5 m",
        ),
        (
            SphereRegion(center_m=(0.5, 0.5, 0.5), radius_m=0.4),
            "the sphere of radius_m = 0.4 around",
            "0.1 m",
        ),
    ],
)
def test_an_empty_region_is_told_in_the_scenes_words_with_the_body_and_how_far_it_is(region, says, distance):
    with pytest.raises(RegionError) as caught:
        nodes_in(region, CUBE)
    message = str(caught.value)
    assert says in message
    assert "The body reaches from [0.0, 0.0, 0.0] to [1.0, 1.0, 1.0] m" in message
    assert f"is {distance} outside" in message
    assert "Region" not in message


def test_a_patch_between_nodes_is_centered_on_the_surface():
    patch = contact_patch((0.5, 0.5, 1.3), 0.11, SEVENTHS)  # the four nodes around the top's center
    assert len(patch.nodes) == 4
    np.testing.assert_allclose(patch.center_m, (0.5, 0.5, 1), atol=1e-12)
    np.testing.assert_allclose(patch.normal, (0, 0, 1), atol=1e-12)
    assert patch.radius_m == 0.11


def test_a_patch_on_a_ball_faces_outward():
    cloud = ball(0.1, 0.02)
    direction = np.array([1.0, 2.0, -2.0]) / 3
    patch = contact_patch(tuple(0.2 * direction), 0.03, cloud)
    assert len(patch.nodes) > 3
    assert np.all(np.linalg.norm(cloud.points[patch.nodes] - patch.center_m, axis=1) <= 0.03 * (1 + 1e-5))
    np.testing.assert_allclose(patch.normal, direction, atol=0.1)
    np.testing.assert_allclose(np.linalg.norm(patch.normal), 1)


def test_a_patch_on_a_thin_plate_leaves_the_far_side_alone():
    plate = box_lattice((0, 0, 0), (1, 1, 0.1), (11, 11, 2))
    patch = contact_patch((0.5, 0.5, 0.2), 0.25, plate)
    assert np.all(plate.points[patch.nodes, 2] == 0.1)


def test_a_patch_without_nodes_says_how_far_the_nearest_is():
    with pytest.raises(
        RegionError, match=r"radius_m = 0.05 around .* no boundary node: the nearest is 0.1\d* m"
    ):
        contact_patch((0.5, 0.5, 1.0), 0.05, SEVENTHS)
