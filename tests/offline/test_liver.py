"""The shipped liver scene, felt at rest."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from palpate.build import build_cloud
from palpate.discretization.statics import static_stiffness
from palpate.geometry.regions import PlaneRegion, contact_patch, nodes_in
from palpate.scene import schema as config_tables
from palpate.scene.schema import load_config

LIVER = Path(__file__).parents[2] / "configs" / "liver.toml"


def test_the_patch_is_several_nodes_across_and_the_tip_no_stiffer_than_a_bonded_punch_on_rigid_ground() -> (
    None
):
    """A soft organ held at its back is softer than a half-space under the same bonded punch, 4 ln(3 - 4 nu) G a / (1 - 2 nu)."""
    config = load_config(LIVER)
    material = config.material.material()
    cloud = build_cloud(config, LIVER.parent)
    (tip,) = config.contact
    (back,) = config.fixed
    assert isinstance(back, config_tables.PlaneRegion)
    patch = contact_patch(tip.point_m, tip.radius_m, cloud)
    fixed = nodes_in(PlaneRegion(back.point_m, back.normal), cloud)
    stiffness = static_stiffness(cloud, material, fixed, [patch.nodes])
    nu = material.poissons_ratio
    half_space = 4 * np.log(3 - 4 * nu) / (1 - 2 * nu) * material.shear_modulus_pa * tip.radius_m
    assert cloud.n_nodes >= 1000
    assert len(patch.nodes) >= 19
    assert 0.5 * half_space < patch.normal @ stiffness @ patch.normal < half_space
