"""Clouds filled into surfaces: measures, normals, spacing, patches, and the requests they refuse."""

import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree

from palpate.geometry.cloud import TriangleSurface
from palpate.geometry.fill import fill_surface
from palpate.geometry.measures import enclosed_volume
from palpate.geometry.regions import contact_patch
from palpate.geometry.sampling import closest_point, depth_inside
from palpate.geometry.shapes import box_lattice
from palpate.geometry.spacing import Refinement, SpacingField

RADIUS = 0.1
BLOCK = box_lattice((-0.05, -0.05, -0.06), (0.05, 0.05, 0.0), (2, 2, 2)).surface
TIP = Refinement(center_m=(0.0, 0.0, 0.01), radius_m=0.007, spacing_m=0.0025, growth=0.3)


def from_trimesh(mesh):
    return TriangleSurface(np.asarray(mesh.vertices), np.asarray(mesh.faces, dtype=np.int32))


@pytest.fixture(scope="module")
def ball():
    return fill_surface(from_trimesh(trimesh.creation.icosphere(subdivisions=3, radius=RADIUS)), 0.025)


@pytest.fixture(scope="module")
def block():
    return fill_surface(BLOCK, 0.015, [TIP])


@pytest.fixture(params=["ball", "block"])
def cloud(request):
    return request.getfixturevalue(request.param)


def test_volumes_and_areas_sum_to_those_of_the_surface(cloud):
    mesh = trimesh.Trimesh(cloud.surface.vertices, cloud.surface.triangles, process=False)
    assert cloud.volumes.sum() == pytest.approx(mesh.volume, rel=1e-12)
    assert cloud.areas.sum() == pytest.approx(mesh.area, rel=1e-12)
    assert cloud.volumes.min() > 0
    assert np.all((cloud.areas > 0) == cloud.boundary)


def test_boundary_nodes_lie_on_the_surface_and_the_others_well_inside(cloud):
    on_surface, _ = closest_point(cloud.points, cloud.surface.vertices, cloud.surface.triangles)
    distance = np.linalg.norm(cloud.points - on_surface, axis=1)
    assert distance[cloud.boundary].max() < 1e-12
    inside = ~cloud.boundary
    assert np.all(depth_inside(cloud.points[inside], cloud.surface) > 0.4 * cloud.spacing[inside])
    assert np.all(np.diff(cloud.boundary.astype(int)) <= 0), "boundary nodes come first"


def test_nodes_keep_the_asked_distance(cloud):
    distance, _ = cKDTree(cloud.points).query(cloud.points, k=2)
    ratio = distance[:, 1] / cloud.spacing
    # A hexagonal or body-centered lattice with one node per spacing^d has 1.07 and 1.09.
    assert ratio.min() > 0.5
    assert ratio.max() < 1.4
    assert 0.85 < np.median(ratio) < 1.1


def test_a_node_inside_stands_for_about_its_spacing_cubed(cloud):
    share = cloud.volumes[~cloud.boundary] / cloud.spacing[~cloud.boundary] ** 3
    assert 0.85 < np.median(share) < 1.2
    assert share.min() > 0.5
    assert share.max() < 2.0


def test_spacing_follows_the_refinement(block):
    distance = np.maximum(0, np.linalg.norm(block.points, axis=1) - TIP.radius_m)
    # Rings at most 2.5 mm apart with 7 mm midway between two of them: 2 mm.
    np.testing.assert_allclose(block.spacing, np.minimum(0.015, 0.002 + 0.3 * distance), rtol=1e-12)


def test_two_refinements_give_the_finer_spacing():
    field = SpacingField(0.1, (Refinement((0, 0, 0), 0.1, 0.01), Refinement((1, 0, 0), 0.1, 0.02)))
    points = np.array([[0.0, 0.1, 0.0], [1.0, 0.0, 0.05], [0.2, 0.0, 0.0], [0.5, 0.0, 9.0]])
    np.testing.assert_allclose(field(points), [0.01, 0.02, 0.04, 0.1])


def test_normals_of_a_ball_are_radial(ball):
    boundary = ball.boundary
    np.testing.assert_allclose(np.linalg.norm(ball.normals[boundary], axis=1), 1, rtol=1e-12)
    assert not ball.normals[~boundary].any()
    radial = ball.points[boundary] / np.linalg.norm(ball.points[boundary], axis=1, keepdims=True)
    cosine = np.einsum("ni,ni->n", radial, ball.normals[boundary])
    # The mean over a cell is the normal at its centroid, which is within a quarter of a spacing of the node.
    assert np.arccos(cosine.min()) < 0.25 * 0.025 / RADIUS


def test_the_volumes_of_a_ball_have_its_first_and_second_moments(ball):
    volume = enclosed_volume(ball.surface)
    np.testing.assert_allclose(ball.volumes @ ball.points / volume, 0, atol=0.01 * RADIUS)
    polar = ball.volumes @ (ball.points**2).sum(axis=1) / volume
    # A skin of h/2 lumped at the surface gives 4 pi R² h/2 * 2R h/4 too much, 3/4 h² of the volume; cells inside
    # lack their own moment, h²/4 (a cube's).
    assert -0.25 * 0.025**2 < polar - 3 / 5 * RADIUS**2 < 0.75 * 0.025**2


def test_faces_of_a_block_have_its_normals(block):
    top = (block.points[:, 2] == 0) & np.all(np.abs(block.points[:, :2]) < 0.03, axis=1)
    assert top.sum() > 60
    np.testing.assert_allclose(block.normals[top], np.tile([0, 0, 1], (top.sum(), 1)), atol=1e-12)


def test_corners_and_edges_of_a_block_carry_nodes(block):
    low, high = BLOCK.vertices.min(axis=0), BLOCK.vertices.max(axis=0)
    faces_met = ((block.points == low) | (block.points == high)).sum(axis=1)
    assert (faces_met == 3).sum() == 8
    # 4 edges of 0.1, 0.1 and 0.06 m with 0.015 m between nodes, corners apart.
    assert (faces_met == 2).sum() == pytest.approx(4 * (0.1 + 0.1 + 0.06) / 0.015 - 12, rel=0.15)
    corner = block.points[faces_met == 3] > (low + high) / 2
    np.testing.assert_allclose(block.normals[faces_met == 3], np.where(corner, 1, -1) / np.sqrt(3), atol=0.15)


def test_the_edge_of_a_round_patch_runs_midway_between_two_rings(block):
    radius = np.linalg.norm(block.points, axis=1)[block.boundary]
    for ring, expected in enumerate((1, 6, 12, 18, 24)):
        assert np.sum(np.abs(radius - ring * 0.002) < 1e-9) == expected
    assert np.sum(radius <= 0.008 + 1e-9) == 1 + 6 + 12 + 18 + 24


def test_the_nodes_of_a_round_patch_stand_for_its_disc(block):
    patch = contact_patch(TIP.center_m, TIP.radius_m, block)
    assert len(patch.nodes) == 1 + 6 + 12 + 18
    # The cells of a ring of n nodes end on a polygon that is off the circle by up to (pi/n)²/2 of the radius.
    assert block.areas[patch.nodes].sum() == pytest.approx(np.pi * TIP.radius_m**2, rel=(np.pi / 18) ** 2)


def test_a_patch_on_a_curved_surface_keeps_its_radii():
    mesh = trimesh.creation.icosphere(subdivisions=4, radius=RADIUS)
    asked = Refinement((0.03, -0.04, 0.2), 0.025, 0.01)
    cloud = fill_surface(from_trimesh(mesh), 0.025, [asked])
    center, _ = closest_point(np.array([asked.center_m]), cloud.surface.vertices, cloud.surface.triangles)
    radius = np.linalg.norm(cloud.points[cloud.boundary] - center, axis=1)
    for ring, expected in enumerate((1, 6, 12, 18)):
        assert np.sum(np.abs(radius - ring * 0.01) < 1e-8) == expected
    patch = contact_patch(asked.center_m, asked.radius_m, cloud)
    np.testing.assert_allclose(patch.center_m, center[0], rtol=1e-12)
    assert len(patch.nodes) == 1 + 6 + 12


def test_the_same_seed_gives_the_same_cloud_and_another_seed_another(ball):
    again = fill_surface(ball.surface, 0.025, seed=0)
    other = fill_surface(ball.surface, 0.025, seed=1)
    for name in ("points", "volumes", "areas", "normals", "boundary", "spacing"):
        np.testing.assert_array_equal(getattr(again, name), getattr(ball, name))
    assert not np.array_equal(other.points, ball.points)


def test_a_thin_wedge_leaves_no_node_without_a_volume():
    blade = TriangleSurface(
        np.array([[0, 0, 0], [0, 1, 0], [1, 0, -0.1], [1, 1, -0.1], [1, 0, 0.1], [1, 1, 0.1]], float),
        np.array(
            [[0, 2, 4], [1, 5, 3], [0, 1, 3], [0, 3, 2], [0, 4, 5], [0, 5, 1], [2, 3, 5], [2, 5, 4]], np.int32
        ),
    )
    cloud = fill_surface(blade, 0.12)
    assert cloud.volumes.min() > 0
    assert cloud.volumes.sum() == pytest.approx(0.1, rel=1e-12)
    np.testing.assert_allclose(np.linalg.norm(cloud.normals[cloud.boundary], axis=1), 1, rtol=1e-12)
    # Top and bottom nodes look up and down, though they are close to each other.
    up, down = cloud.points[:, 2] > 1e-3, cloud.points[:, 2] < -1e-3
    assert np.all(cloud.normals[cloud.boundary & up, 2] > -0.1)
    assert np.all(cloud.normals[cloud.boundary & down, 2] < 0.1)


@pytest.mark.parametrize(
    ("spacing", "refinements", "message"),
    [
        (
            0.05,
            [],
            "spacing_m = 0.05: expected at most a quarter of the body's largest extent, 0.1 x 0.1 x 0.06 m",
        ),
        (
            1e-5,
            [],
            "spacing_m = 1e-05 would give some 6e[+]11 nodes .* this machine has .* expected a larger spacing",
        ),
        (0.01, [Refinement((0, 0, 0), 0.02, 1e-5)], "would give some .* nodes"),
        (0.01, [TIP, Refinement((0.005, 0, 0), 0.006, 0.002)], "two round patches overlap near"),
        (0.02, [Refinement((0, 0, 0), 0.2, 0.02)], "radius 0.2 m finds no place around"),
    ],
)
def test_a_fill_that_makes_no_sense_is_refused(spacing, refinements, message):
    with pytest.raises(ValueError, match=message):
        fill_surface(BLOCK, spacing, refinements)
