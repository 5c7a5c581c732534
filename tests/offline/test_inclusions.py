"""Inclusions: the stiffness of the cells, what a scene may say of them, and the force map against finite elements."""

from __future__ import annotations

import copy
import re
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from palpate.discretization import conservative
from palpate.discretization.resolution import resolved_frequency_hz
from palpate.expected import expected_size
from palpate.geometry.cloud import NodeCloud
from palpate.geometry.fill import fill_surface
from palpate.geometry.ply import ply_bytes
from palpate.geometry.sampling import depth_inside
from palpate.geometry.shapes import ball, box_lattice
from palpate.geometry.spacing import RefinedArea
from palpate.geometry.surface import load_surface
from palpate.inclusions import finer_around_inclusions, with_inclusions
from palpate.modes.held_body import hold
from palpate.scene.material import Material
from palpate.scene.schema import ConfigError, canonical_text, check_config, fingerprint
from palpate.scene_cloud import build_cloud
from palpate.stage_keys import stage_keys

# A block of 80 x 80 x 40 mm, its bottom held, with a ball of 16 mm whose top is 10 mm beneath the surface.
SCENE: dict[str, Any] = tomllib.loads("""
name = "block"
[geometry]
shape = "surface"
file = "block.ply"
spacing_m = 0.006
[material]
youngs_modulus_pa = 1.0
poissons_ratio = 0.45
density_kg_per_m3 = 1000.0
[[fixed]]
region = "plane"
point_m = [0.0, 0.0, 0.001]
normal = [0.0, 0.0, -1.0]
[[contact]]
name = "tip"
point_m = [0.0, 0.0, 0.04]
radius_m = 0.01
[[inclusion]]
shape = "sphere"
center_m = [0.0, 0.0, 0.022]
radius_m = 0.008
relative_stiffness = 10.0
spacing_m = 0.002
""")


def changed(**keys: Any) -> dict[str, Any]:
    """SCENE with keys of its inclusion replaced, or removed where the value is None."""
    scene = copy.deepcopy(SCENE)
    table = scene["inclusion"][0] | keys
    scene["inclusion"] = [{key: value for key, value in table.items() if value is not None}]
    return scene


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """With the block, and a ball of the inclusion's size around the origin in mm."""
    folder = tmp_path_factory.mktemp("scenes")
    block = box_lattice((-0.04, -0.04, 0.0), (0.04, 0.04, 0.04), (9, 9, 5)).surface
    (folder / "block.ply").write_bytes(ply_bytes(block.vertices, block.triangles))
    round_one = ball(0.008, 0.001).surface
    (folder / "tumor.ply").write_bytes(
        ply_bytes(1000 * (round_one.vertices + np.array([0, 0, 0.022])), round_one.triangles)
    )
    return folder


@pytest.fixture(scope="module")
def cloud(folder: Path) -> NodeCloud:
    return build_cloud(check_config(SCENE, "scene"), folder)


def no_warning(text: str) -> None:
    pytest.fail(text)


def stiffness_of(cloud: NodeCloud, scene: dict[str, Any], folder: Path) -> NDArray[np.float64]:
    found = with_inclusions(check_config(scene, "scene"), folder, cloud, no_warning).relative_stiffness
    assert found is not None
    return found


def test_cells_within_are_stiffer_and_their_volume_is_the_inclusions(cloud: NodeCloud, folder: Path) -> None:
    stiffness = stiffness_of(cloud, SCENE, folder)
    depth = 0.008 - np.linalg.norm(cloud.centroids - (0, 0, 0.022), axis=1)
    np.testing.assert_array_equal(stiffness[depth > 0.003], 10.0)
    np.testing.assert_array_equal(stiffness[depth < -0.003], 1.0)
    volume = np.log10(stiffness) @ cloud.volumes
    assert volume == pytest.approx(4 / 3 * np.pi * 0.008**3, rel=0.03)


def test_a_ball_from_a_file_is_the_ball(cloud: NodeCloud, folder: Path) -> None:
    from_file = changed(shape="surface", file="tumor.ply", file_unit="mm", center_m=None, radius_m=None)
    np.testing.assert_allclose(
        stiffness_of(cloud, from_file, folder), stiffness_of(cloud, SCENE, folder), atol=0.5
    )


def test_nodes_are_finer_around_an_inclusion_that_asks_for_it(cloud: NodeCloud, folder: Path) -> None:
    at_surface = np.abs(np.linalg.norm(cloud.points - (0, 0, 0.022), axis=1) - 0.008) < 0.001
    assert cloud.spacing[at_surface].max() < 0.0025
    assert cloud.spacing.max() == pytest.approx(0.006)
    assert expected_size(check_config(SCENE, "scene"), folder).n_nodes == pytest.approx(
        cloud.n_nodes, rel=0.15
    )


def test_where_inclusions_overlap_the_later_one_counts(cloud: NodeCloud, folder: Path) -> None:
    scene = copy.deepcopy(SCENE)
    core = SCENE["inclusion"][0] | {"radius_m": 0.006, "relative_stiffness": 0.1}
    scene["inclusion"].append(core)
    stiffness = stiffness_of(cloud, scene, folder)
    assert stiffness.min() == pytest.approx(0.1)
    assert 3 < stiffness.max() < 10


def test_a_uniform_inclusion_is_another_material(cloud: NodeCloud, folder: Path) -> None:
    whole = changed(center_m=[0.0, 0.0, 0.02], radius_m=1.0, relative_stiffness=3.0)
    warned: list[str] = []
    stiffer = with_inclusions(check_config(whole, "scene"), folder, cloud, warned.append)
    assert "its volume is" in warned[0]
    one, three = (conservative.assemble(c, Material(1, 0.45, 1), [0], []) for c in (cloud, stiffer))
    np.testing.assert_allclose(three.stiffness.data, 3 * one.stiffness.data, rtol=1e-12, atol=1e-16)


def test_waves_in_a_softer_part_are_carried_to_a_lower_frequency(cloud: NodeCloud, folder: Path) -> None:
    material = Material(1000.0, 0.45, 1000.0)
    carried = resolved_frequency_hz(cloud, material)
    soft = with_inclusions(check_config(changed(relative_stiffness=0.01), "scene"), folder, cloud, no_warning)
    # The coarsest cells of the soft part are some 3.5 mm apart, a tenth as fast; the body's are 6 mm.
    assert 0.1 * carried < resolved_frequency_hz(soft, material) < 0.3 * carried


def test_an_inclusion_outside_the_body_is_refused_and_one_half_outside_is_told(
    cloud: NodeCloud, folder: Path
) -> None:
    outside = check_config(changed(center_m=[0.0, 0.0, 0.1]), "scene")
    with pytest.raises(
        ValueError, match=r"inclusion\[0\]: holds no part of the body, whose nearest node is 0.0"
    ):
        with_inclusions(outside, folder, cloud, no_warning)
    warned: list[str] = []
    for height in (0.036, 0.043):
        scene = check_config(changed(center_m=[0.0, 0.0, height]), "scene")
        with_inclusions(scene, folder, cloud, warned.append)
    assert "center_m is 0.004 m inside the body: expected it at least radius_m = 0.008 inside" in warned[0]
    assert "center_m is 0.003 m outside the body" in warned[1]


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"shape": None}, r"inclusion\[0\].shape: missing, expected one of 'sphere', 'surface'"),
        ({"shape": "cone"}, r"inclusion\[0\].shape = 'cone': expected one of 'sphere', 'surface'"),
        ({"relative_stiffness": 0.0}, r"inclusion\[0\].relative_stiffness = 0.0: expected at least 0.001"),
        ({"relative_stiffness": None}, r"inclusion\[0\].relative_stiffness: missing"),
        ({"radius_m": -1.0}, r"inclusion\[0\].radius_m = -1.0: expected at least 1e-06"),
        ({"spacing_m": 0.01}, r"inclusion\[0\].spacing_m = 0.01: expected at most geometry.spacing_m, 0.006"),
    ],
)
def test_a_mistake_is_named(keys: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        check_config(changed(**keys), "scene")


def test_a_spacing_that_asks_for_millions_of_nodes_is_refused_before_they_are_made(folder: Path) -> None:
    with pytest.raises(ValueError, match=r"inclusion\[0\].spacing_m = 1e-06: would put 8e\+08 nodes"):
        expected_size(check_config(changed(spacing_m=1e-6), "scene"), folder)


def test_collocation_and_uniform_clouds_refuse_what_they_cannot_do() -> None:
    scene = SCENE | {"discretization": {"method": "collocation"}, "reduction": {"method": "tbr", "order": 10}}
    with pytest.raises(ConfigError, match=r"'collocation': \[\[inclusion\]\] needs 'conservative'"):
        check_config(scene, "scene")
    box = {"shape": "box", "upper_m": [0.1, 0.1, 0.05], "counts": [5, 5, 3]}
    with pytest.raises(ConfigError, match=r"inclusion\[0\] has spacing_m, but a box is a uniform cloud"):
        check_config(SCENE | {"geometry": box}, "scene")


def test_files_and_stages_know_the_inclusion(folder: Path) -> None:
    plain = check_config({k: v for k, v in SCENE.items() if k != "inclusion"}, "scene")
    assert "inclusion" not in canonical_text(plain)
    config, softer = (check_config(changed(relative_stiffness=r), "scene") for r in (10.0, 2.0))
    assert fingerprint(config, folder) != fingerprint(softer, folder)
    keys, others = stage_keys(config, folder), stage_keys(softer, folder)
    assert keys.cloud == others.cloud
    assert keys.body != others.body
    missing = changed(shape="surface", file="none.ply", center_m=None, radius_m=None)
    with pytest.raises(FileNotFoundError, match=r"inclusion\[0\].file = 'none.ply'"):
        fingerprint(check_config(missing, "scene"), folder)


PLACES_M = (0.0, 0.005, 0.01, 0.015, 0.02)
# How much stiffer the block is at these places along x on its top, %, under a normal pressure ~ exp(-r² / (2 (3 mm)²)):
# quadratic hexahedra, 33,075 unknowns for the half y >= 0, the modulus taken at each quadrature point (scikit-fem).
CHANGES = {10.0: (15.01, 12.23, 6.90, 2.96, 1.02), 0.2: (-7.99, -6.67, -3.96, -1.76, -0.61)}


def stiffness_along_x(cloud: NodeCloud) -> NDArray[np.float64]:
    """N/m, the force over the mean displacement that it weighs, at each place."""
    bottom = np.flatnonzero(cloud.points[:, 2] < 1e-9)
    body = conservative.assemble(cloud, Material(1.0, 0.45, 1.0), bottom, [])
    loads = []
    for x in PLACES_M:
        squared = (cloud.points[:, 0] - x) ** 2 + cloud.points[:, 1] ** 2
        weight = cloud.areas * np.exp(-squared / (2 * 0.003**2)) * (cloud.points[:, 2] > 0.04 - 1e-9)
        force = np.outer(weight / weight.sum(), (0.0, 0.0, 1.0))
        loads.append((body.basis.value.T @ force).ravel())
    load = np.column_stack(loads)
    return 1 / np.einsum("ij,ij->j", load, hold(body, bottom).solve(load))


@pytest.mark.slow
@pytest.mark.parametrize(("relative", "tolerance"), [(10.0, 0.05), (0.2, 0.15)])
def test_an_inclusion_changes_the_force_map_as_finite_elements_say(
    folder: Path, relative: float, tolerance: float
) -> None:
    """Measured: within 2 % of the change where it is stiffer, 13 % where it is softer."""
    surface = load_surface(folder / "block.ply").surface
    x, y = (axis.ravel() for axis in np.meshgrid(np.arange(-0.03, 0.031, 0.00125), np.arange(-8, 9) * 1e-3))
    band = RefinedArea(np.column_stack([x, y, np.full(len(x), 0.04)]), 0.06 * 0.016, 0.0025)
    config = check_config(changed(relative_stiffness=relative, spacing_m=0.0015), "scene")
    cloud = fill_surface(surface, 0.006, (), (band, *finer_around_inclusions(config, folder)))
    without = stiffness_along_x(cloud)
    found = stiffness_along_x(with_inclusions(config, folder, cloud, no_warning)) / without - 1
    np.testing.assert_allclose(100 * found, CHANGES[relative], rtol=tolerance)


def test_the_inclusion_that_the_readme_shows_lies_in_the_liver() -> None:
    root = Path(__file__).parents[2]
    (table,) = re.findall(
        r"^```toml\n(\[\[inclusion\]\].*?)^```$", (root / "README.md").read_text(), re.MULTILINE | re.DOTALL
    )
    (inclusion,) = tomllib.loads(table)["inclusion"]
    liver = load_surface(root / "configs" / "liver.ply", "m").surface
    assert depth_inside(np.array([inclusion["center_m"]]), liver)[0] > inclusion["radius_m"]
