"""Held bodies and Ritz modes against the dense path on bodies small enough for both."""

from dataclasses import replace

import numpy as np
import pytest

from palpate.discretization import collocation, conservative
from palpate.discretization.supports import components, supports
from palpate.geometry.shapes import box_lattice
from palpate.modes import ritz as module
from palpate.modes.dense import elastic_modes, nodal_stiffness
from palpate.modes.held_body import hold
from palpate.modes.krylov import KrylovSpace
from palpate.modes.ritz import ritz_modes
from palpate.scene.material import Material
from palpate.scene.tissues import PRESETS

EPS = np.finfo(float).eps
LIVER = PRESETS["liver"]


def _slab(n_contacts=1, nu=None):
    """A jittered slab of liver, 6 x 6 x 3 cm, its lower side held."""
    cloud = box_lattice((0, 0, 0), (0.06, 0.06, 0.03), (7, 7, 4), 0.1, seed=3)
    centers = [(0.02, 0.03), (0.045, 0.03)][:n_contacts]
    top = cloud.points[:, 2] == 0.03
    contacts = [
        np.flatnonzero(top & (np.linalg.norm(cloud.points[:, :2] - center, axis=1) < 0.012))
        for center in centers
    ]
    material = LIVER if nu is None else replace(LIVER, poissons_ratio=nu)
    return conservative.assemble(cloud, material, np.flatnonzero(cloud.points[:, 2] == 0), contacts)


def _points(material: Material):
    """s² / h(s) from 0 to 40 Hz, where the slab has some tens of modes."""
    s = 2j * np.pi * np.linspace(0.0, 40.0, 61)
    return s**2 / material.prony.transfer_factor(s)


def _force(modes, squared_s):
    terms = 1 / (squared_s[:, None] + modes.squared_frequencies)
    return modes.direct_stiffness - np.einsum(
        "ik,fk,kj->fij", modes.output_coupling, terms, modes.input_coupling
    )


@pytest.fixture(scope="module")
def body():
    return _slab()


@pytest.mark.parametrize("nu", [0.3, 0.499])
def test_static_responses_of_the_held_body_are_those_of_the_nodal_values(nu):
    body = _slab(nu=nu)
    held = hold(body, body.supports.prescribed)
    force = np.random.default_rng(0).standard_normal((3 * body.n_nodes, 4))
    solution = held.solve(body.basis.loads(force))
    free = components(body.supports.free, 3)
    alone = replace(body, supports=supports(body.n_nodes, body.supports.prescribed, []))
    stiffness = nodal_stiffness(alone)
    expected = np.linalg.solve(stiffness, force[free])
    values = body.basis.values(solution)
    tolerance = 100 * EPS * np.linalg.cond(stiffness) * np.abs(expected).max()
    np.testing.assert_allclose(values[free], expected, atol=tolerance)
    np.testing.assert_allclose(values[components(held.nodes, 3)], 0, atol=100 * EPS * np.abs(values).max())


def test_the_approximate_inverse_is_symmetric_and_off_by_the_compliance_of_the_penalty(body):
    held = hold(body, body.supports.prescribed)
    loads = np.random.default_rng(1).standard_normal((3 * body.n_nodes, 5))
    approximate, exact = held.approximate(loads), held.solve(loads)
    energy = loads.T @ approximate
    np.testing.assert_allclose(energy, energy.T, atol=1e-9 * np.abs(energy).max())
    assert np.linalg.norm(approximate - exact) < 1e-3 * np.linalg.norm(exact)
    np.testing.assert_allclose(
        held.constraints.matrix @ approximate, 0, atol=100 * EPS * np.abs(approximate).max()
    )


def test_a_body_that_nothing_holds_and_one_that_is_not_symmetric_are_refused(body):
    with pytest.raises(np.linalg.LinAlgError):
        held = hold(body, np.array([0]))  # it still turns about node 0
        held.solve(np.random.default_rng(2).standard_normal((3 * body.n_nodes, 1)))
    cloud = box_lattice((0, 0, 0), (1, 1, 1), (5, 5, 5))
    collocated = collocation.assemble(cloud, PRESETS["paper-cube"], [0, 1, 2], [])
    with pytest.raises(ValueError, match="not symmetric"):
        hold(collocated, np.array([0]))


def test_krylov_vectors_are_orthonormal_in_the_mass_and_vanish_at_the_held_nodes(body):
    held = hold(body, body.supports.prescribed)
    start = held.solve(np.random.default_rng(3).standard_normal((3 * body.n_nodes, 3)))
    space = KrylovSpace(body, held.constraints, most=60)
    assert space.append(start)
    while space.append(held.approximate(body.inertia(space.last_block))):
        pass
    assert space.size == 60
    values = body.basis.values(space.vectors)
    mass = np.repeat(body.mass, 3)[:, None]
    np.testing.assert_allclose(values.T @ (mass * values), np.eye(60), atol=1e3 * EPS)
    np.testing.assert_allclose(values[components(held.nodes, 3)], 0, atol=1e3 * EPS * np.abs(values).max())


def test_a_krylov_space_that_is_exhausted_ends():
    """Six nodes are free: 18 vectors are all there are, however many are asked for."""
    body = _slab()
    few = body.supports.free[:6]
    held = hold(body, np.setdiff1d(np.arange(body.n_nodes), few))
    space = KrylovSpace(body, held.constraints, most=60)
    space.append(held.solve(np.random.default_rng(4).standard_normal((3 * body.n_nodes, 4))))
    while space.append(held.approximate(body.inertia(space.last_block))):
        pass
    assert space.size == 18


@pytest.mark.parametrize("n_contacts", [1, 2])
def test_ritz_modes_give_the_force_of_all_modes_in_the_band_and_at_rest(n_contacts):
    body = _slab(n_contacts)
    squared_s = _points(LIVER)
    full, ritz = elastic_modes(body), ritz_modes(body, squared_s, 1e-3)
    modes = ritz.modes
    assert modes.n_modes < full.n_modes
    np.testing.assert_allclose(modes.direct_stiffness, full.direct_stiffness, rtol=1e-9)
    np.testing.assert_allclose(modes.static_stiffness, full.static_stiffness, rtol=1e-8)
    np.testing.assert_array_equal(modes.output_coupling, modes.input_coupling.T)
    exact = _force(full, squared_s)
    error = np.linalg.norm(_force(modes, squared_s) - exact, 2, axis=(1, 2)) / np.linalg.norm(
        exact, 2, axis=(1, 2)
    )
    assert error.max() < ritz.change + 1e-9 < 1e-3
    # Each is a vector of the projected body, so it lies above the mode that it approximates (Cauchy).
    lowest = slice(0, 5)
    assert np.all(modes.squared_frequencies >= full.squared_frequencies[: modes.n_modes] * (1 - 1e-9))
    np.testing.assert_allclose(modes.squared_frequencies[lowest], full.squared_frequencies[lowest], rtol=1e-3)


def test_displacements_everywhere_are_those_of_all_modes(body):
    squared_s = _points(LIVER)
    full, ritz = elastic_modes(body), ritz_modes(body, squared_s, 1e-6).modes

    def field(modes, at):
        q = -modes.input_coupling / (at + modes.squared_frequencies)[:, None]
        return body.basis.values(modes.parameters @ q + modes.patch_parameters)

    for at in squared_s[[0, 20, 60]]:
        exact = field(full, at)
        assert np.linalg.norm(field(ritz, at) - exact) < 1e-3 * np.linalg.norm(exact)
    np.testing.assert_allclose(field(ritz, 0), field(full, 0), atol=1e-8)


def test_a_known_space_serves_another_band_without_a_factorization(body, monkeypatch):
    wide, narrow = _points(LIVER), _points(LIVER)[:31]
    first = ritz_modes(body, wide, 1e-3)
    fresh = ritz_modes(body, narrow, 1e-3)
    assert fresh.modes.n_modes < first.modes.n_modes

    def refused(*_):
        raise AssertionError("the body is factorized again")

    monkeypatch.setattr(module, "hold", refused)
    again = ritz_modes(body, narrow, 1e-3, known=first.space)
    assert again.space is first.space
    for name in ("squared_frequencies", "input_coupling", "direct_stiffness", "parameters"):
        known, alone = getattr(again.modes, name), getattr(fresh.modes, name)
        np.testing.assert_allclose(np.abs(known), np.abs(alone), atol=1e-9 * np.abs(alone).max())


def test_a_space_that_is_too_small_is_continued_and_gives_what_one_go_gives(body):
    wide, narrow = _points(LIVER), _points(LIVER)[:31]
    whole = ritz_modes(body, wide, 1e-3).modes
    continued = ritz_modes(body, wide, 1e-3, known=ritz_modes(body, narrow, 1e-3).space).modes
    np.testing.assert_array_equal(continued.squared_frequencies, whole.squared_frequencies)
    np.testing.assert_array_equal(continued.parameters, whole.parameters)
