"""What sees what inside a body: prongs across a slit don't, everything in a convex body does."""

import numpy as np
import pytest
import trimesh

from palpate.geometry.cloud import TriangleSurface
from palpate.geometry.crossings import triangle_grid
from palpate.geometry.fill import fill_surface
from palpate.geometry.visibility import find_gaps

SPACING = 0.006


def uniform(points):
    return np.full(len(points), SPACING)


@pytest.fixture(scope="module")
def gaps(two_prongs):
    return find_gaps(two_prongs(0.002), uniform)


def test_segments_cross_a_surface_as_often_as_an_exact_ball_says():
    mesh = trimesh.creation.icosphere(subdivisions=4)
    grid = triangle_grid(TriangleSurface(np.asarray(mesh.vertices), np.asarray(mesh.faces, np.int32)), 0.1)
    rng = np.random.default_rng(1)
    begins, ends = rng.uniform(-1.3, 1.3, (2, 20_000, 3))
    # The polyhedron's faces lie between the spheres of radius 0.995 and 1: a segment from inside one to outside the other
    # crosses, one that stays on its side of both doesn't.
    distance = [np.linalg.norm(p, axis=1) for p in (begins, ends)]
    inside, outside = ([d < 0.995 for d in distance], [d > 1 for d in distance])
    along = ends - begins
    nearest = np.clip(-np.einsum("ij,ij->i", begins, along) / np.einsum("ij,ij->i", along, along), 0, 1)
    closest = np.linalg.norm(begins + nearest[:, None] * along, axis=1)
    crossed = grid.crossed(begins, ends)
    must = (inside[0] & outside[1]) | (outside[0] & inside[1]) | (closest < 0.995) & (outside[0] | outside[1])
    must_not = (inside[0] & inside[1]) | (closest > 1)
    assert must.sum() > 1000 < must_not.sum()
    assert crossed[must].all()
    assert not crossed[must_not].any()


@pytest.mark.parametrize("size", [0.003, 0.02, 1.0])
def test_the_size_of_cells_changes_nothing(two_prongs, size):
    rng = np.random.default_rng(2)
    begins = rng.uniform(0, 1, (3000, 3)) * [0.06, 0.04, 0.03]
    ends = begins + rng.normal(0, 0.01, begins.shape)
    wanted = triangle_grid(two_prongs(0.002), 0.007).crossed(begins, ends)
    np.testing.assert_array_equal(triangle_grid(two_prongs(0.002), size).crossed(begins, ends), wanted)
    assert 0.1 < wanted.mean() < 0.9


def test_points_on_the_two_sides_of_a_slit_do_not_see_each_other(gaps):
    x = np.linspace(0.02, 0.058, 20)
    left = np.column_stack([x, np.full(20, 0.019), np.full(20, 0.015)])
    right = left + np.array([0, 0.002, 0])
    left, right = (gaps.inset(p, np.full(20, 0.25 * SPACING)) for p in (left, right))
    assert gaps.hidden(left, right).all()
    assert not gaps.hidden(left[:-1], left[1:]).any()


def test_places_next_to_a_gap_are_those_along_the_slit(gaps):
    near = gaps.places
    # Along the slit, and no further from it than gaps are looked for: 1.25 spacings.
    assert near[:, 0].min() > 0.015 - 1.25 * SPACING
    assert np.all(np.abs(near[:, 1] - 0.02) < 0.001 + 1.25 * SPACING)
    beside = gaps.beside(np.array([[0.05, 0.018, 0.01], [0.005, 0.005, 0.01]]))
    assert beside.tolist() == [True, False]


@pytest.mark.parametrize("point", [(0.06, 0.04, 0.03), (0.06, 0.03, 0.03), (0.05, 0.04, 0.015)])
def test_points_of_corners_edges_and_faces_are_moved_inside(gaps, point):
    depth = np.array([0.001])
    (moved,) = gaps.inset(np.array([point]), depth)
    assert np.linalg.norm(moved - point) < 0.001 * np.sqrt(3) * (1 + 1e-9)
    assert np.all(np.minimum(moved, [0.06, 0.04, 0.03] - moved) > 0.001 * (1 - 1e-6))


def test_a_convex_body_has_no_gaps():
    mesh = trimesh.creation.icosphere(subdivisions=3, radius=0.05)
    surface = TriangleSurface(np.asarray(mesh.vertices), np.asarray(mesh.faces, np.int32))
    gaps = find_gaps(surface, lambda p: np.full(len(p), 0.012))
    assert len(gaps.places) == 0
    cloud = fill_surface(surface, 0.012)
    own, other = np.triu_indices(cloud.n_nodes, 1)
    places = gaps.inset(cloud.points, 0.003 * np.ones(cloud.n_nodes))
    assert not gaps.hidden(places[own], places[other]).any()


def test_each_side_of_a_slit_gets_its_own_nodes_and_shares(prongs):
    cloud = prongs
    for side in (0.019, 0.021):
        on_face = np.abs(cloud.points[:, 1] - side) < 1e-9
        # 45 mm x 30 mm with one node a spacing², edges included (they add about half of their length a spacing).
        expected = (0.045 / SPACING + 1) * (0.03 / SPACING + 1)
        assert on_face.sum() == pytest.approx(expected, rel=0.15)
    left = cloud.points[:, 1] < 0.02
    # Each half has half of the volume and of the surface.
    assert cloud.volumes[left].sum() == pytest.approx(cloud.volumes.sum() / 2, rel=0.02)
    assert cloud.areas[left].sum() == pytest.approx(cloud.areas.sum() / 2, rel=0.02)
    prong = left & (cloud.points[:, 0] > 0.03)
    assert np.all(cloud.points[prong, 1] < 0.0191)
