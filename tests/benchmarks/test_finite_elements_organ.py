import numpy as np
import pytest

from finite_elements_organ import Ball, Height, longest_edges, on_rim, refined, signed_volumes, volumes
from palpate.geometry.shapes import box_lattice

skfem = pytest.importorskip("skfem")


@pytest.fixture(scope="module")
def mesh():
    axis = np.linspace(0, 1, 5)
    return skfem.MeshTet.init_tensor(axis, axis, axis)


def n_cut(mesh, region):
    """Edges of the surface with their ends on different sides of the rim."""
    corners = region(mesh.p[:, mesh.facets[:, mesh.boundary_facets()]])
    return np.count_nonzero(corners * np.roll(corners, 1, axis=0) < -1e-12) // 2


def test_surface_nodes_move_onto_the_rim_and_the_volume_stays(mesh):
    ball = Ball(np.array([0.47, 0.52, 1.0]), 0.3)
    moved = on_rim(mesh, ball)
    assert n_cut(mesh, ball) > 15
    assert n_cut(moved, ball) < 0.2 * n_cut(mesh, ball)
    assert volumes(moved).sum() == pytest.approx(1.0, rel=1e-12)
    assert np.all(signed_volumes(moved.p, moved.t) * signed_volumes(mesh.p, mesh.t) > 0)


def test_a_plane_between_two_layers_gets_nodes_of_its_own(mesh):
    height = Height(np.array([0.0, 0.6, 0.0]), np.array([0.0, 2.0, 0.0]))
    assert height(np.array([[0.0], [0.7], [0.0]])) == pytest.approx(-0.1)  # inside
    moved = on_rim(mesh, height)
    assert np.count_nonzero(np.abs(height(moved.p)) < 1e-12) >= 4 * 4


def test_cells_near_a_rim_are_bisected_and_others_kept(mesh):
    surface = box_lattice((0, 0, 0), (1, 1, 1), (5, 5, 5)).surface
    ball = Ball(np.array([0.5, 0.5, 1.0]), 0.3)
    fine = refined(mesh, surface, ball, 0.1)
    longest = longest_edges(fine.p[:, fine.t])
    middle = fine.p[:, fine.t].mean(axis=1)
    rim = np.hypot(np.hypot(middle[0] - 0.5, middle[1] - 0.5) - 0.3, middle[2] - 1)
    assert longest[rim < 0.03].max() < 0.11
    assert longest[middle[2] < 0.3].min() > 2 * longest[rim < 0.03].max()
    assert volumes(fine).sum() == pytest.approx(1.0)
