"""Scenes with tools: what they mean, and what is refused."""

from __future__ import annotations

import copy
import json
import tomllib
from typing import Any

import numpy as np
import pytest

from palpate.geometry.shapes import box_lattice
from palpate.scene.schema import ConfigError, canonical_text, check_config, override_reduction
from palpate.scene_cloud import in_working_area, tool_shapes

SCENE: dict[str, Any] = tomllib.loads("""
name = "slab"
[geometry]
shape = "surface"
file = "slab.ply"
spacing_m = 0.01
[material]
preset = "liver"
[[fixed]]
region = "plane"
point_m = [0.0, 0.0, 0.001]
normal = [0.0, 0.0, -1.0]
[surface]
spacing_m = 0.003
[[surface.working_area]]
region = "sphere"
center_m = [0.0, 0.0, 0.03]
radius_m = 0.02
[[tool]]
name = "tip"
radius_m = 0.005
friction = 0.2
[[tool]]
name = "other"
radius_m = 0.004
friction = 0.0
""")

CONTACT = {"name": "patch", "point_m": [0.0, 0.0, 0.03], "radius_m": 0.01}
FAST = {"preset": "liver", "gamma": [0.5], "tau_s": [1e-4]}
BOX = {"shape": "box", "upper_m": [0.1, 0.1, 0.05], "counts": [5, 5, 3]}


def changed(**tables: Any) -> dict[str, Any]:
    """SCENE with tables replaced, or removed where the value is None."""
    return {name: table for name, table in (copy.deepcopy(SCENE) | tables).items() if table is not None}


def test_a_scene_with_tools_takes_its_defaults_and_records_nothing_of_a_reduction() -> None:
    config = check_config(SCENE, "slab.toml")
    assert config.surface.tolerance == 0.05
    assert config.surface.period_s == 1e-3
    text = canonical_text(config)
    assert "reduction" not in text
    assert "contact" not in text
    assert canonical_text(check_config(json.loads(text), "again")) == text


@pytest.mark.parametrize(
    ("scene", "says"),
    [
        (changed(contact=[CONTACT]), r"both of \[\[contact\]\] and \[\[tool\]\]"),
        (changed(tool=None), r"neither of \[\[contact\]\] and \[\[tool\]\]"),
        (changed(tool=2 * [SCENE["tool"][0]]), r"tool names \['tip', 'tip'\]: expected each name once"),
        (changed(tool=SCENE["tool"][0]), r"tool: expected a list of tables, \[\[tool\]\]"),
        (changed(tool=[{"name": "tip", "radius_m": 0.005}]), r"tool\[0\].friction: missing"),
        (changed(tool=[SCENE["tool"][0] | {"friction": -0.1}]), r"tool\[0\].friction = -0.1: expected at least 0"),
        (changed(reduction={"order": 10}), r"reduction: unknown in a scene with \[\[tool\]\]"),
        (changed(tool=None, contact=[CONTACT]), r"surface: unknown in a scene with \[\[contact\]\]"),
        (changed(discretization={"method": "collocation"}), r"discretization.method = 'collocation': \[\[tool\]\] needs"),
        (changed(surface={"spacing_m": 0.02}), r"surface.spacing_m = 0.02: expected at most geometry.spacing_m, 0.01"),
        (changed(surface={"working_area": SCENE["surface"]["working_area"]}), "surface.spacing_m = None: expected"),
        (changed(surface={"working_area": [{"region": "nearest", "point_m": [0, 0, 0]}]}), r"working_area\[0\].region = 'nearest': expected one of 'box', 'plane', 'sphere'"),
        (changed(surface={"band_hz": [0.0, 600.0]}), r"surface.band_hz = \[0.0, 600.0\]: expected"),
        (changed(surface={"modes": 0}), "surface.modes = 0: expected at least 1"),
        (changed(material=FAST, surface={"period_s": 0.1, "band_hz": [0.0, 4.0]}), "tau_s holds 0.0001: expected at least 0.001 s, 0.01 of surface.period_s"),
        (changed(geometry=BOX), "surface has spacing_m, but a box is a uniform cloud"),
    ],
)  # fmt: skip
def test_a_scene_with_tools_that_makes_no_sense_is_refused_by_its_key(
    scene: dict[str, Any], says: str
) -> None:
    with pytest.raises(ConfigError, match=says):
        check_config(scene, "slab.toml")


def test_options_of_a_reduction_are_refused_for_a_scene_with_tools() -> None:
    config = check_config(SCENE, "slab.toml")
    assert override_reduction(config, None, None, None) is config
    with pytest.raises(ConfigError, match=r"surface\.tolerance or surface\.modes"):
        override_reduction(config, None, 40, None)


def _block(tools: list[dict[str, Any]]) -> Any:
    return check_config(changed(geometry=BOX, surface=None, tool=tools), "block.toml")


def test_tools_without_a_home_start_clear_of_the_body_and_apart() -> None:
    cloud = box_lattice((0, 0, 0), (0.1, 0.1, 0.05), (5, 5, 3))
    tools = tool_shapes(_block(SCENE["tool"]), cloud)
    homes = np.array([tool.home_m for tool in tools])
    outside = np.linalg.norm(np.maximum(0, np.maximum(-homes, homes - [0.1, 0.1, 0.05])), axis=1)
    assert np.all(outside > [tool.radius_m for tool in tools])
    assert np.linalg.norm(homes[0] - homes[1]) > 0.03


def test_tools_without_a_home_start_where_the_body_can_move() -> None:
    cloud = box_lattice((0, 0, 0), (0.1, 0.1, 0.05), (9, 9, 5))
    tools = [SCENE["tool"][0] | {"name": f"tip{i}"} for i in range(6)]
    held = SCENE["fixed"][0]
    assert held["normal"] == [0.0, 0.0, -1.0]
    assert min(tool.home_m[2] for tool in tool_shapes(_block(tools), cloud)) > 0.05 / 3


def test_a_home_inside_the_body_is_refused() -> None:
    cloud = box_lattice((0, 0, 0), (0.1, 0.1, 0.05), (5, 5, 3))
    near = SCENE["tool"][0] | {"home_m": [0.05, 0.05, 0.053]}
    with pytest.raises(
        ValueError, match=r"tool 'tip': home_m = .* is 0.003 m outside the body: expected more than"
    ):
        tool_shapes(_block([near]), cloud)


def test_points_lie_in_a_working_area_where_a_region_holds_them() -> None:
    points = np.array([[0, 0, 0.03], [0, 0, 0.049], [0, 0, 0.051]])
    assert in_working_area(check_config(SCENE, "a"), points).tolist() == [True, True, False]
    assert in_working_area(_block(SCENE["tool"]), points).all()
