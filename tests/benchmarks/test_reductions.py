import numpy as np
import pytest

from palpate.discretization import conservative
from palpate.geometry.shapes import box_lattice
from palpate.lti.frequencies import relative_errors
from palpate.modes.dense import elastic_modes
from palpate.scene.tissues import PRESETS
from reductions import Body, Damped, direct_force, n_coordinates

MATERIAL = PRESETS["liver"]


@pytest.fixture(scope="module")
def assembled():
    cloud = box_lattice((0, 0, 0), (0.08, 0.08, 0.08), (4, 4, 4))
    bottom = np.flatnonzero(cloud.points[:, 2] < 1e-9)
    tip = np.argsort(np.linalg.norm(cloud.points - (0.04, 0.04, 0.08), axis=1))[:4]
    return conservative.assemble(cloud, MATERIAL.unit, bottom, [tip])


@pytest.fixture(scope="module")
def body(assembled):
    modes = elastic_modes(assembled).scaled(MATERIAL.youngs_modulus_pa, MATERIAL.density_kg_per_m3)
    return Body(modes, MATERIAL.prony, np.zeros((0, modes.n_modes)), np.zeros((0, 3)))


@pytest.mark.parametrize("frequency_hz", [5.0, 29.0])
def test_a_direct_solve_gives_the_force_of_all_modes(assembled, body, frequency_hz):
    solve = direct_force(assembled, MATERIAL, 2 * np.pi * frequency_hz)
    exact = body.full.transfer(np.array([2j * np.pi * frequency_hz]))[0]
    assert solve.residual < 1e-9
    np.testing.assert_allclose(solve.force, exact, rtol=1e-8, atol=1e-8 * np.abs(exact).max())


def test_coordinates_are_as_many_as_the_order_holds(body):
    for order in (60, 121):
        n = n_coordinates(body, order)
        states = 2 * 3 + 4 * n  # two branches
        assert states <= order < states + 12
        assert n % 3 == 0


def test_a_peer_of_all_coordinates_is_the_body_itself(body):
    mu, coupling = body.modes.squared_frequencies, body.modes.input_coupling
    points = 2j * np.pi * np.array([1.0, 20.0])
    whole = body.with_modes(mu, coupling).transfer(points)
    assert np.max(relative_errors(body.full.transfer(points), whole)) < 1e-12


def test_the_damped_system_has_the_materials_stiffness_at_the_bands_end(body):
    s = np.array([2j * np.pi * 30.0])
    h = MATERIAL.prony.transfer_factor(s)[0]
    damped = Damped.of(body)
    mu, b = body.modes.squared_frequencies, body.modes.input_coupling
    expected = (b.T * (h.real**2 / (s[0] ** 2 + h * mu))) @ b
    assert relative_errors(expected[None], damped.response(s))[0] < 1e-12
