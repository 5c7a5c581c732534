"""Nodal masses against exact moments of the kinetic energy."""

import numpy as np
import pytest

from palpate.discretization.inertia import inertial_volumes
from palpate.discretization.nodal import SUPPORT_RADIUS_FACTOR, nodal_basis
from palpate.geometry.shapes import ball, box_lattice


def _volumes(cloud, factor=SUPPORT_RADIUS_FACTOR):
    basis, _ = nodal_basis(cloud.points, cloud.spacing, factor, derivatives=0, gaps=cloud.gaps)
    return inertial_volumes(cloud, basis)


@pytest.mark.parametrize(
    "cloud", [box_lattice((0, 0, 0), (1, 1, 1), (7, 7, 7), 0.25, seed=3), ball(1.0, 0.25)]
)
def test_masses_are_positive_and_sum_to_that_of_the_body(cloud):
    volumes = _volumes(cloud)
    assert volumes.min() > 0.4 * cloud.volumes.min()
    assert volumes.sum() == pytest.approx(cloud.volumes.sum(), rel=1e-12)


def test_a_boundary_node_of_a_lattice_gives_a_sixth_of_its_mass_to_its_nearest_neighbor():
    """Gregory's weights 5/12 and 13/12: with so small a support a node of a face reaches only one layer further inside."""
    cloud = box_lattice((0, 0, 0), (1, 1, 1), (11, 11, 11))
    volumes = _volumes(cloud, factor=1.5).reshape(11, 11, 11) * 1000
    np.testing.assert_allclose(volumes[:, 5, 5], [5 / 12, 13 / 12, *7 * [1], 13 / 12, 5 / 12], rtol=1e-9)


@pytest.mark.parametrize("jitter", [0.0, 0.2])
def test_the_moment_of_inertia_is_nearer_than_by_the_cells_own_volumes(jitter):
    cloud = box_lattice((-1, -1, -1), (1, 1, 1), (9, 9, 9), jitter, seed=3)
    square = cloud.points[:, 0] ** 2
    own, moved = (abs(v @ square / (8 / 3) - 1) for v in (cloud.volumes, _volumes(cloud)))
    assert own > 0.01
    assert moved < own / 2.5  # measured 4.8 and 2.8
