"""A number in another unit is told with its key, its value, and what was probably meant; a usual scene says nothing."""

from __future__ import annotations

import tomllib
from pathlib import Path

import pytest

from palpate.scene.plausibility import plausibility
from palpate.scene.schema import check_config, load_config

CONFIGS = Path(__file__).parents[3] / "configs"

SCENE = """
name = "organ"
[geometry]
shape = "surface"
file = "organ.stl"
file_unit = "mm"
spacing_m = 0.01
[material]
youngs_modulus_pa = 5400.0
poissons_ratio = 0.45
density_kg_per_m3 = 1060.0
gamma = [0.5, 0.3]
tau_s = [0.58, 0.004]
[[fixed]]
region = "sphere"
center_m = [0.0, 0.0, 0.0]
radius_m = 0.02
[[contact]]
name = "tip"
point_m = [0.0, 0.0, 0.05]
radius_m = 0.005
spacing_m = 0.002
[reduction]
tolerance = 0.02
band_hz = [0.0, 30.0]
period_s = 0.001
"""


def warnings(old: str = "", new: str = "", size_m: float = 0.2) -> tuple[str, ...]:
    assert old in SCENE
    return plausibility(check_config(tomllib.loads(SCENE.replace(old, new)), "scene"), size_m)


def test_a_usual_scene_says_nothing() -> None:
    assert warnings() == ()


@pytest.mark.parametrize(
    ("scene", "size_m"), [("liver.toml", 0.206), ("liver-coarse.toml", 0.206), ("cube.toml", 1.0)]
)
def test_the_shipped_scenes_say_nothing(scene: str, size_m: float) -> None:
    assert plausibility(load_config(CONFIGS / scene), size_m) == ()


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ("= 5400.0", "= 5.4", ["material.youngs_modulus_pa = 5.4 Pa", "5.4e+03 if it was in kPa"]),
        ("= 5400.0", "= 0.0054", ["material.youngs_modulus_pa = 0.0054 Pa", "5.4e+03 if it was in MPa"]),
        ("= 1060.0", "= 1.06", ["material.density_kg_per_m3 = 1.06 kg/m³", "1.06e+03 if it was in g/cm³"]),
        ("[0.58, ", "[580.0, ", ["material.tau_s = 580 s", "0.58 if it was in ms"]),
        ("[0.5, ", "[50.0, ", ["material.gamma = 50", "0.5 if it was in percent"]),
        ("= 0.45", "= -0.45", ["material.poissons_ratio = -0.45", "0 to 0.4999"]),
        ("spacing_m = 0.01", "spacing_m = 10", ["geometry.spacing_m = 10 m", "0.01 if it was in mm"]),
        ("radius_m = 0.005", "radius_m = 5.0", ["contact 'tip'.radius_m = 5 m", "0.005 if it was in mm"]),
        ("spacing_m = 0.002", "spacing_m = 2.0", ["contact 'tip'.spacing_m = 2 m", "0.002 if it was in mm"]),
        ("radius_m = 0.02", "radius_m = 20.0", ["fixed[0].radius_m = 20 m", "0.02 if it was in mm"]),
        ("30.0]", "188.5]", ["reduction.band_hz = 188.5 Hz", "30 if it was in rad/s"]),
        ("= 0.001", "= 0.01", ["reduction.period_s = 0.01 s", "check its unit"]),
        ("tolerance = 0.02", "tolerance = 0.5", ["reduction.tolerance = 0.5", "0.005 if it was in percent"]),
    ],
)
def test_a_number_in_another_unit_is_told(old: str, new: str, says: list[str]) -> None:
    (told,) = warnings(old, new)
    for words in says:
        assert words in told


@pytest.mark.parametrize(
    ("old", "new", "size_m", "says"),
    [
        (
            '"mm"',
            '"m"',
            103.0,
            'geometry.file_unit = "m": the body is 103 m across: usual are 0.003 to 1 m; probably meant: file_unit = "mm"',
        ),
        ('"mm"', '"mm"', 1e-4, 'file_unit = "m"'),
        ('"mm"', '"m"', 1e4, "check the unit of the file"),
    ],
)
def test_the_size_of_the_body_is_told_with_its_key(old: str, new: str, size_m: float, says: str) -> None:
    (told,) = warnings(old, new, size_m)
    assert says in told


def test_a_preset_is_not_the_users_number() -> None:
    scene = tomllib.loads(SCENE) | {"material": {"preset": "paper-cube"}}
    assert plausibility(check_config(scene, "scene"), 0.2) == ()
