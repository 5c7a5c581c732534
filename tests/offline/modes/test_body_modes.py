"""Which modes a body gets, and how they scale."""

import numpy as np

from palpate.discretization import conservative
from palpate.geometry.shapes import box_lattice
from palpate.lti.frequencies import relative_errors
from palpate.lti.viscoelastic import viscoelastic_system
from palpate.modes.body_modes import TOLERANCE, by_ritz, ritz_body_modes
from palpate.modes.dense import elastic_modes
from palpate.scene.tissues import PRESETS

LIVER = PRESETS["liver"]


def test_small_bodies_and_collocated_ones_get_all_modes():
    assert not by_ritz(2000, symmetric=True)
    assert by_ritz(2001, symmetric=True)
    assert not by_ritz(2001, symmetric=False)


def _block(material):
    cloud = box_lattice((0, 0, 0), (0.05, 0.05, 0.03), (6, 6, 4), 0.1, seed=1)
    top = np.flatnonzero(
        (cloud.points[:, 2] == 0.03) & (np.abs(cloud.points[:, :2] - 0.025).max(axis=1) < 0.01)
    )
    return conservative.assemble(cloud, material, np.flatnonzero(cloud.points[:, 2] == 0), [top])


def test_modes_of_the_unit_material_scale_to_those_of_any():
    direct = elastic_modes(_block(LIVER))
    scaled = elastic_modes(_block(LIVER.unit)).scaled(LIVER.youngs_modulus_pa, LIVER.density_kg_per_m3)
    np.testing.assert_allclose(scaled.squared_frequencies, direct.squared_frequencies, rtol=1e-9)
    np.testing.assert_allclose(scaled.static_stiffness, direct.static_stiffness, rtol=1e-9)
    s = 2j * np.pi * np.array([3.0, 30.0, 300.0])

    def force(modes):
        terms = 1 / (s[:, None] ** 2 + modes.squared_frequencies)
        return np.einsum("ik,fk,kj->fij", modes.output_coupling, terms, modes.input_coupling)

    np.testing.assert_allclose(force(scaled), force(direct), atol=1e-8 * np.abs(force(direct)).max())


def test_ritz_modes_of_a_body_have_the_statics_of_all_modes_and_its_force_in_the_band():
    ritz = ritz_body_modes(_block(LIVER.unit), LIVER, 30.0)
    full = elastic_modes(_block(LIVER))
    assert ritz.change <= TOLERANCE
    np.testing.assert_allclose(ritz.modes.static_stiffness, full.static_stiffness, rtol=1e-8)
    s = 2j * np.pi * np.linspace(0, 30, 61)
    forces = [viscoelastic_system(modes, LIVER.prony).transfer(s) for modes in (full, ritz.modes)]
    assert np.max(relative_errors(*forces)) < 1e-3
