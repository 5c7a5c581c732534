"""The shipped liver: the scene with few nodes felt at rest, and the built model of the other."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from palpate.build import build_model
from palpate.discretization import conservative
from palpate.lti.frequencies import relative_errors
from palpate.model_file import load_patch_model
from palpate.scene.schema import fingerprint, load_config
from palpate.scene_cloud import build_cloud, contact_patches, fixed_nodes
from palpate_paper.static_stiffness import static_stiffness

CONFIGS = Path(__file__).parents[2] / "configs"
COARSE, LIVER, BUILT = (CONFIGS / name for name in ("liver-coarse.toml", "liver.toml", "liver.npz"))


@pytest.mark.slow
def test_the_patch_is_several_nodes_across_and_the_tip_no_stiffer_than_a_bonded_punch_on_rigid_ground() -> (
    None
):
    """A soft organ held at its back is softer than a half-space under the same bonded punch, 4 ln(3 - 4 nu) G a / (1 - 2 nu)."""
    config = load_config(COARSE)
    material = config.material.material()
    cloud = build_cloud(config, CONFIGS)
    (tip,) = config.contact
    fixed = fixed_nodes(config, cloud)
    (patch,) = contact_patches(config, cloud, fixed)
    stiffness = static_stiffness(conservative.assemble(cloud, material, fixed, [patch.nodes]))
    nu = material.poissons_ratio
    half_space = 4 * np.log(3 - 4 * nu) / (1 - 2 * nu) * material.shear_modulus_pa * tip.radius_m
    assert cloud.n_nodes >= 1000
    assert len(patch.nodes) >= 19
    assert 0.5 * half_space < patch.normal @ stiffness @ patch.normal < half_space


def test_the_shipped_model_is_that_of_the_shipped_scene_and_is_passive_and_true_in_the_band():
    """Made by `palpate build configs/liver.toml -o configs/liver.npz`, whenever the scene or what a scene says changes."""
    config, model = load_config(LIVER), load_patch_model(BUILT)
    accuracy = model.accuracy
    assert model.config_sha256 == fingerprint(config, CONFIGS)
    assert accuracy.resolved_frequency_hz > config.reduction.band_hz[1]
    assert accuracy.error_in_band <= 0.01
    assert accuracy.error_surface_in_band <= 0.03
    assert accuracy.gain_above_band <= 1.5
    assert accuracy.passivity_margin > -1e-12
    assert accuracy.passive_up_to_hz == pytest.approx(0.5 / model.period_s)
    assert accuracy.largest_energy_out_j < 1e-12
    assert BUILT.stat().st_size < 8e6


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_the_shipped_model_is_what_a_build_gives():
    """The body's force to what the solvers' round-off leaves; the fit above the band may differ within its own error."""
    built, shipped = build_model(load_config(LIVER), CONFIGS), load_patch_model(BUILT)
    assert (built.n_nodes, built.contacts) == (shipped.n_nodes, shipped.contacts)
    np.testing.assert_allclose(built.static_stiffness, shipped.static_stiffness, rtol=1e-6)
    s = 2j * np.pi * np.linspace(0, 30, 301)
    assert np.max(relative_errors(shipped.full.transfer(s), built.full.transfer(s))) < 1e-4
    assert built.order == pytest.approx(shipped.order, rel=0.05)
    for name in ("error_in_band", "error_surface_in_band", "gain_above_band"):
        assert getattr(built.accuracy, name) == pytest.approx(getattr(shipped.accuracy, name), rel=0.2)
