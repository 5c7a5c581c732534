"""A build tells how many nodes lie across thin parts that are loaded."""

import numpy as np
import pytest

from palpate.geometry.regions import contact_patch
from palpate.geometry.shapes import ball, box_lattice
from palpate.geometry.thickness import nodes_across, thickness
from palpate.thin_parts import thin_patch


@pytest.mark.parametrize("nodes", [3, 5])
def test_the_nodes_across_a_plate_are_counted(nodes):
    side = 0.1 / 4
    lattice = box_lattice((0, 0, 0), (0.1, 0.1, side * (nodes - 1)), (5, 5, nodes))
    top = np.flatnonzero(lattice.normals[:, 2] == 1)
    np.testing.assert_allclose(thickness(lattice, top), side * (nodes - 1), rtol=1e-5)
    np.testing.assert_allclose(nodes_across(lattice, top), nodes, rtol=1e-5)


def test_across_a_ball_lies_its_diameter():
    cloud = ball(0.1, 0.02)
    surface = np.flatnonzero(cloud.boundary)
    np.testing.assert_allclose(thickness(cloud, surface), 0.2, rtol=0.03)
    np.testing.assert_allclose(nodes_across(cloud, surface), 11, rtol=0.03)


def test_a_contact_on_a_plate_of_three_nodes_is_warned_of_with_the_number_and_how_much_too_soft_it_is():
    lattice = box_lattice((0, 0, 0), (0.1, 0.1, 0.02), (11, 11, 3))
    text = thin_patch("tip", contact_patch((0.05, 0.05, 0.02), 0.012, lattice), lattice)
    assert text is not None
    assert text.startswith("contact 'tip': the body is 0.02 m thick there, 3 nodes across")
    assert "too softly by about 8 %" in text
    assert "spacing_m of 0.0067" in text


def test_a_contact_on_a_thick_body_is_not_warned_of():
    lattice = box_lattice((0, 0, 0), (0.1, 0.1, 0.05), (11, 11, 6))
    assert thin_patch("tip", contact_patch((0.05, 0.05, 0.05), 0.012, lattice), lattice) is None
