"""The shipped liver scene: what a finger feels does not depend on how fine the nodes under the tip are."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from palpate.build import build_cloud
from palpate.config import check_config, load_config
from palpate.discretization.statics import static_stiffness
from palpate.geometry.regions import PlaneRegion, contact_patch, nodes_in

LIVER = Path(__file__).parents[2] / "configs" / "liver.toml"


def tip_stiffness(spacing_m: float) -> tuple[float, int]:
    """(N/m along the normal at rest, nodes on the patch) with this node spacing on the patch."""
    tables = load_config(LIVER).model_dump(mode="json", exclude_none=True)
    tables["contact"][0]["spacing_m"] = spacing_m
    config = check_config(tables, "liver")
    cloud = build_cloud(config, LIVER.parent)
    tip, back = config.contact[0], tables["fixed"][0]
    patch = contact_patch(tip.point_m, tip.radius_m, cloud)
    fixed = nodes_in(PlaneRegion(tuple(back["point_m"]), tuple(back["normal"])), cloud)
    stiffness = static_stiffness(cloud, config.material.material(), fixed, [patch.nodes])
    return float(patch.normal @ stiffness @ patch.normal), len(patch.nodes)


@pytest.mark.slow
def test_halving_the_spacing_on_the_patch_changes_the_tip_stiffness_by_less_than_five_percent() -> None:
    coarse, coarse_nodes = tip_stiffness(0.002)
    fine, fine_nodes = tip_stiffness(0.001)
    assert fine_nodes > 3 * coarse_nodes
    assert fine == pytest.approx(coarse, rel=0.05)


def test_the_patch_is_several_nodes_across_and_the_tip_no_stiffer_than_a_bonded_punch_on_rigid_ground() -> (
    None
):
    """A soft organ held at its back is softer than a half-space under the same bonded punch, 4 ln(3 - 4 nu) G a / (1 - 2 nu)."""
    material = load_config(LIVER).material.material()
    nu = material.poissons_ratio
    half_space = 4 * np.log(3 - 4 * nu) / (1 - 2 * nu) * material.shear_modulus_pa * 0.005
    stiffness, nodes = tip_stiffness(0.002)
    assert nodes >= 19
    assert 0.5 * half_space < stiffness < half_space
