"""Finite elements against exact frequencies, and the meshfree models against finite elements."""

import importlib.util
import sys

import numpy as np
import pytest
from scipy.special import jn_zeros

from palpate.discretization import conservative
from palpate.geometry.shapes import box_lattice
from palpate.modes.dense import elastic_modes
from palpate.scene.material import Material, PronySeries
from palpate_paper import finite_elements, membrane
from palpate_paper.membranes import disc_membrane, square_membrane
from palpate_paper.time_integration import equations_of_motion, newmark

DISC = np.sort(np.concatenate([np.repeat(jn_zeros(m, 6), 1 if m == 0 else 2) for m in range(12)]))[:6]
SQUARE = np.sort([np.pi * np.hypot(m, n) for m in range(1, 9) for n in range(1, 9)])[:6]
CUBE = Material(1.0, 0.3, 10.0, PronySeries((1.0,), (1.0,)))
# Hz: quadratic hexahedra, 8 x 8 x 8.
CUBE_FREQUENCIES = np.array([0.03365, 0.03365, 0.04571, 0.08037, 0.08894, 0.08894])


def _on_circle(x):
    return np.linalg.norm(x, axis=1) > 1 - 1e-9


def _on_square(x):
    return np.any((x < 1e-9) | (x > 1 - 1e-9), axis=1)


def _disc_error(refinements, degree):
    body = finite_elements.disc(refinements, degree)
    return np.abs(finite_elements.frequencies(body, body.at(_on_circle), 6) / DISC - 1).max()


def _square_error(intervals, degree):
    body = finite_elements.square(intervals, degree)
    return np.abs(finite_elements.frequencies(body, body.at(_on_square), 6) / SQUARE - 1).max()


@pytest.mark.parametrize("degree", [1, 2])
def test_square_frequencies_converge_at_twice_the_degree(degree):
    order = np.log2(_square_error(8, degree) / _square_error(16, degree))
    assert order == pytest.approx(2 * degree, abs=0.35)


@pytest.mark.parametrize("degree", [1, 2])
def test_disc_frequencies_converge_at_twice_the_degree(degree):
    order = np.log2(_disc_error(3, degree) / _disc_error(4, degree))
    assert order == pytest.approx(2 * degree, abs=0.5)


def test_cube_frequencies_of_quadratic_tetrahedra_agree_with_quadratic_hexahedra():
    body = finite_elements.cube(4, CUBE, degree=2)
    bottom = body.at(lambda x: x[:, 2] < 1e-9)
    found = finite_elements.frequencies(body, bottom, 6) / (2 * np.pi)
    # Both converge from above; 4³ cells of six tetrahedra are the coarser mesh.
    np.testing.assert_allclose(found, CUBE_FREQUENCIES, rtol=0.01)


def test_every_degree_of_freedom_has_its_component():
    body = finite_elements.cube(2, CUBE, degree=2)
    np.testing.assert_array_equal(np.bincount(body.components), np.full(3, body.n_dofs // 3))
    # A unit translation along one component weighs the body's mass along it and needs no force.
    for k in range(3):
        u = (body.components == k).astype(float)
        assert u @ body.mass @ u == pytest.approx(10.0)
        np.testing.assert_allclose(body.stiffness @ u, 0, atol=1e-12)


def test_the_conservative_cube_pushed_by_a_patch_moves_as_finite_elements_do():
    """Reaction force in time on a quarter of the top, 9³ nodes against quadratic tetrahedra."""
    cloud = box_lattice((0, 0, 0), (1, 1, 1), (9, 9, 9))
    bottom = np.flatnonzero(cloud.points[:, 2] == 0)

    def pressed(x):
        return (x[:, 2] > 1 - 1e-9) & np.all(np.abs(x[:, :2] - 0.5) < 0.2501, axis=1)

    times = 0.1 * np.arange(101)
    inputs = np.outer(np.sin(np.pi * np.minimum(times / 10, 1)) ** 2, [0, 0, 1.0])
    pushed = [np.flatnonzero(pressed(cloud.points))]
    meshfree = equations_of_motion(conservative.assemble(cloud, CUBE, bottom, pushed))
    body = finite_elements.cube(6, CUBE, degree=2)
    tip = [np.flatnonzero(pressed(body.places) & (body.components == k)) for k in range(3)]
    elements = finite_elements.equations_of_motion(body, body.at(lambda x: x[:, 2] < 1e-9), [tip])
    ours, theirs = (newmark(e, CUBE.prony, inputs, 0.1).forces[:, 2] for e in (meshfree, elements))
    assert np.linalg.norm(ours - theirs) < 0.1 * np.linalg.norm(theirs)


@pytest.mark.parametrize(
    ("body", "on_edge", "cloud", "reference"),
    [
        (finite_elements.disc(4), _on_circle, disc_membrane, DISC),
        (finite_elements.square(13), _on_square, square_membrane, SQUARE),
    ],
    ids=["disc", "square"],
)
def test_the_conservative_membrane_beats_linear_triangles_with_as_many_nodes(body, on_edge, cloud, reference):
    theirs = np.abs(finite_elements.frequencies(body, body.at(on_edge), 6) / reference - 1).max()
    modes = elastic_modes(membrane.conservative(cloud(body.n_dofs)))
    ours = np.abs(np.sqrt(modes.squared_frequencies[:6]) / reference - 1).max()
    assert ours < theirs / 2


def test_without_scikit_fem_the_module_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "skfem", None)
    specification = importlib.util.spec_from_file_location("without_skfem", finite_elements.__file__)
    with pytest.raises(ImportError, match=r"needs scikit-fem: pip install 'palpate\[dev\]'"):
        specification.loader.exec_module(importlib.util.module_from_spec(specification))


def test_an_unknown_degree_is_refused():
    with pytest.raises(ValueError, match="degree = 3: expected 1 or 2"):
        finite_elements.square(4, 3)
