"""The shipped liver scene, felt at rest."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from palpate.discretization import conservative
from palpate.scene.schema import load_config
from palpate.scene_cloud import build_cloud, contact_patches, fixed_nodes
from palpate_paper.static_stiffness import static_stiffness

LIVER = Path(__file__).parents[2] / "configs" / "liver.toml"


@pytest.mark.slow
def test_the_patch_is_several_nodes_across_and_the_tip_no_stiffer_than_a_bonded_punch_on_rigid_ground() -> (
    None
):
    """A soft organ held at its back is softer than a half-space under the same bonded punch, 4 ln(3 - 4 nu) G a / (1 - 2 nu)."""
    config = load_config(LIVER)
    material = config.material.material()
    cloud = build_cloud(config, LIVER.parent)
    (tip,) = config.contact
    fixed = fixed_nodes(config, cloud)
    (patch,) = contact_patches(config, cloud, fixed)
    stiffness = static_stiffness(conservative.assemble(cloud, material, fixed, [patch.nodes]))
    nu = material.poissons_ratio
    half_space = 4 * np.log(3 - 4 * nu) / (1 - 2 * nu) * material.shear_modulus_pa * tip.radius_m
    assert cloud.n_nodes >= 1000
    assert len(patch.nodes) >= 19
    assert 0.5 * half_space < patch.normal @ stiffness @ patch.normal < half_space
