"""A scene says what it means, and a wrong one is told the key, the value and what is allowed."""

from __future__ import annotations

import copy
import tomllib
from pathlib import Path
from typing import Any

import pytest

from palpate.scene.schema import (
    ConfigError,
    canonical_text,
    check_config,
    fingerprint,
    load_config,
    override_reduction,
)

CONFIGS = Path(__file__).parents[3] / "configs"

SCENE: dict[str, Any] = tomllib.loads("""
name = "slab"
[geometry]
shape = "box"
upper_m = [1.0, 1.0, 0.5]
counts = [5, 5, 3]
[material]
youngs_modulus_pa = 5000.0
poissons_ratio = 0.45
density_kg_per_m3 = 1000.0
gamma = [0.5]
tau_s = [0.1]
[[fixed]]
region = "plane"
point_m = [0.0, 0.0, 0.01]
normal = [0.0, 0.0, -1.0]
[[contact]]
name = "tip"
point_m = [0.5, 0.5, 0.5]
radius_m = 0.2
""")


def changed(path: str, value: Any) -> dict[str, Any]:
    """SCENE with the entry at a dotted path replaced, or removed when the value is None."""
    scene = copy.deepcopy(SCENE)
    *parents, last = [int(p) if p.isdigit() else p for p in path.split(".")]
    table: Any = scene
    for part in parents:
        table = table.setdefault(part, {}) if isinstance(part, str) else table[part]
    if value is None:
        del table[last]
    else:
        table[last] = value
    return scene


def test_a_valid_scene_is_taken_with_its_defaults() -> None:
    config = check_config(SCENE, "slab.toml")
    assert config.reduction.method == "passive"
    assert config.reduction.tolerance == 0.01
    assert config.reduction.tolerance_surface == 0.03
    assert config.discretization.method == "conservative"
    material = config.material.material()
    assert material.shear_modulus_pa == pytest.approx(5000 / 2.9)
    assert material.prony.instant_factor == 1.5


@pytest.mark.parametrize("scene", sorted(CONFIGS.glob("*.toml")), ids=lambda p: p.stem)
def test_every_shipped_scene_is_valid(scene: Path) -> None:
    assert load_config(scene).name == scene.stem


@pytest.mark.parametrize(
    ("path", "value", "says"),
    [
        ("geometry.counts", [5, 2, 3], ["geometry", "counts", "[5, 2, 3]", "at least 3"]),
        (
            "geometry",
            {"shape": "ball", "radius_m": 1.0, "spacing_m": 0.6},
            ["geometry.spacing_m = 0.6", "at most half the radius"],
        ),
        ("geometry.seed", -3, ["geometry.seed", "-3", "0"]),
        ("fixed.0.point_m", [float("nan"), 0.0, 0.0], ["fixed[0].point_m[0]", "nan", "finite"]),
        ("fixed", {"region": "plane"}, ["fixed", "[[fixed]]"]),
        ("contact.0.radius_m", True, ["contact[0].radius_m", "True", "number"]),
        ("material.tau_s", [1e-8], ["material.tau_s", "1e-08", "1e-05"]),
        ("material.tau_s", [1e30], ["material.tau_s = 1e+30", "expected from 1e-09 to 1e+06"]),
        ("material.gamma", [1e30], ["material.gamma = 1e+30", "10000"]),
        ("geometry.shape", "sphere", ["geometry.shape", "'sphere'", "'box'", "'ball'", "'surface'"]),
        ("geometry.shape", None, ["geometry.shape", "'box'"]),
        ("geometry.upper_m", [1.0, 0.0, 1.0], ["geometry", "upper_m", "above lower_m"]),
        ("geometry.spacing", 1.0, ["geometry.spacing", "unknown key"]),
        ("material.youngs_modulus_pa", -3.0, ["material.youngs_modulus_pa = -3.0", "from 0.001 to 1e+13"]),
        ("material.poissons_ratio", 0.5, ["material.poissons_ratio = 0.5", "to 0.49999"]),
        ("material.poissons_ratio", 45.0, ["material.poissons_ratio = 45.0", "45 % is 0.45"]),
        ("fixed.0.normal", [0.0, 0.0, 0.0], ["fixed[0].normal = [0.0, 0.0, 0.0]", "a direction"]),
        ("fixed.0.normal", [0.0, 0.0, 1e-300], ["fixed[0].normal", "a direction"]),
        (
            "fixed.0",
            {"region": "box", "lower_m": [0.0, 0.0, 1.0], "upper_m": [1.0, 1.0, 0.0]},
            ["fixed[0].lower_m", "at most upper_m"],
        ),
        ("geometry.upper_m", [1e300, 1.0, 1.0], ["geometry.upper_m[0] = 1e+300", "at most 10000"]),
        ("geometry.upper_m", [1e-300, 1.0, 1.0], ["geometry", "1e-300", "1e-06 m"]),
        (
            "reduction",
            {"order": 10, "period_s": 1.0},
            ["reduction.period_s = 1.0", "at most 0.1", "1 ms is 0.001"],
        ),
        ("reduction", {"tolerance": 2.0}, ["reduction.tolerance = 2.0", "below 1", "2 % is 0.02"]),
        ("material.density_kg_per_m3", None, ["material", "density_kg_per_m3 missing", "preset"]),
        ("material.preset", "spleen", ["preset", "'spleen'", "liver"]),
        ("material.gamma", [0.5, 0.2], ["material", "gamma has 2", "tau_s has 1"]),
        ("material.tau_s", None, ["material", "gamma and tau_s"]),
        ("fixed", [], ["fixed", "at least 1"]),
        ("fixed.0.region", "line", ["fixed[0].region", "'line'", "'plane'"]),
        ("contact", None, ["neither of [[contact]] and [[tool]]"]),
        ("contact.0.radius_m", 0.0, ["contact[0].radius_m = 0.0", "at least 1e-06", "5 mm is 0.005"]),
        ("contact.0.spacing_m", 0.01, ["'tip'", "spacing_m", "only a surface"]),
        ("contact.0.name", "a b", ["contact[0].name", "'a b'"]),
        ("reduction", {"order": 10, "tolerance": 0.1}, ["reduction", "exactly one"]),
        ("reduction", {"order": 1}, ["reduction.order", "1", "2"]),
        ("reduction", {"order": 10, "method": "pod"}, ["reduction.method", "'pod'", "tbr-band"]),
        ("reduction", {"order": 10, "band_hz": [0.0, 600.0]}, ["reduction", "band_hz", "500"]),
        ("name", 7, ["name", "7", "string"]),
    ],
)
def test_a_mistake_is_named_with_its_key_value_and_what_is_allowed(
    path: str, value: Any, says: list[str]
) -> None:
    with pytest.raises(ConfigError) as caught:
        check_config(changed(path, value), "slab.toml")
    message = str(caught.value)
    assert message.startswith("slab.toml: ")
    for words in says:
        assert words in message


def test_two_contacts_with_one_name_are_refused() -> None:
    scene = copy.deepcopy(SCENE)
    scene["contact"] = scene["contact"] * 2
    with pytest.raises(ConfigError, match="each name once"):
        check_config(scene, "slab.toml")


def test_a_wrong_entry_of_a_list_is_told_once() -> None:
    with pytest.raises(ConfigError) as caught:
        check_config(changed("fixed.0.region", "line"), "slab.toml")
    assert len(str(caught.value).splitlines()) == 1


def test_every_mistake_gets_its_own_line() -> None:
    scene = changed("geometry.counts", [5, 5])
    scene["material"]["poissons_ratio"] = 2.0
    with pytest.raises(ConfigError) as caught:
        check_config(scene, "slab.toml")
    assert len(str(caught.value).splitlines()) == 2


def test_broken_toml_and_a_missing_file_are_told(tmp_path: Path) -> None:
    broken = tmp_path / "broken.toml"
    broken.write_text("name = \n")
    with pytest.raises(ConfigError, match=r"broken.toml: not valid TOML.*line 1"):
        load_config(broken)
    with pytest.raises(FileNotFoundError, match="no such configuration"):
        load_config(tmp_path / "none.toml")


def test_an_override_displaces_the_other_stopping_rule_and_is_checked() -> None:
    config = check_config(SCENE, "slab.toml")
    replaced = override_reduction(config, "modal", 40, None)
    assert (replaced.reduction.method, replaced.reduction.order, replaced.reduction.tolerance) == (
        "modal",
        40,
        None,
    )
    with pytest.raises(ConfigError, match=r"command line: reduction.order"):
        override_reduction(config, None, 0, None)


def test_the_fingerprint_follows_the_configuration_and_the_surface_file(tmp_path: Path) -> None:
    config = check_config(SCENE, "slab.toml")
    other = check_config(changed("material.poissons_ratio", 0.4), "slab.toml")
    assert fingerprint(config, tmp_path) == fingerprint(config, tmp_path)
    assert fingerprint(config, tmp_path) != fingerprint(other, tmp_path)
    organ = check_config(
        changed("geometry", {"shape": "surface", "file": "organ.ply", "spacing_m": 0.01}), "organ.toml"
    )
    with pytest.raises(FileNotFoundError, match=r"organ.ply"):
        fingerprint(organ, tmp_path)
    (tmp_path / "organ.ply").write_bytes(b"one")
    first = fingerprint(organ, tmp_path)
    (tmp_path / "organ.ply").write_bytes(b"two")
    assert fingerprint(organ, tmp_path) != first


def test_the_canonical_text_builds_the_same_configuration_again() -> None:
    config = check_config(SCENE, "slab.toml")
    import json

    assert check_config(json.loads(canonical_text(config)), "model file") == config
