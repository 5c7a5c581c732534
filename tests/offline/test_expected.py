"""What a build is said to take, before it takes it."""

import copy
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from palpate_configs import __file__ as configs

from palpate.build import build_model
from palpate.expected import (
    BodySize,
    expectation_text,
    expected_size,
    expected_stages,
    require_memory,
)
from palpate.expected_surface import expected_surface_model
from palpate.geometry.ply import ply_bytes
from palpate.geometry.shapes import box_lattice
from palpate.scene.schema import check_config
from palpate.scene_cloud import build_cloud

FOLDER = Path(configs).parent


def liver(spacing_m):
    tables = tomllib.loads((FOLDER / "liver.toml").read_text(encoding="utf-8"))
    tables["geometry"]["spacing_m"] = spacing_m
    return check_config(tables, "liver"), FOLDER


@pytest.mark.parametrize("spacing_m", [0.012, pytest.param(0.008, marks=pytest.mark.slow)])
def test_the_expected_number_of_nodes_of_the_liver_is_right_to_a_tenth(spacing_m):
    config, folder = liver(spacing_m)
    assert expected_size(config, folder).n_nodes == pytest.approx(
        build_cloud(config, folder).n_nodes, rel=0.1
    )


def test_larger_clouds_take_more_of_everything():
    sizes = [BodySize(n, 1, True, 2.2, True) for n in (3000, 10_000, 30_000)]
    stages = [expected_stages(size) for size in sizes]
    for column in zip(*stages, strict=True):
        assert np.all(np.diff([stage.seconds for stage in column]) > 0)
        assert np.all(np.diff([stage.peak_bytes for stage in column]) > 0)


@pytest.mark.parametrize(
    ("n_nodes", "symmetric", "kind"), [(1500, True, "all"), (3000, True, "Ritz"), (3000, False, "all")]
)
def test_a_cloud_too_large_for_the_machine_is_refused_with_the_memory_it_would_take(
    monkeypatch, n_nodes, symmetric, kind
):
    monkeypatch.setattr("os.sysconf", lambda name: 1024)
    with pytest.raises(
        MemoryError,
        match=rf"{kind} modes of about {n_nodes:,} nodes need about \d+\.\d GiB, this machine has 0.0",
    ):
        require_memory(BodySize(n_nodes, 1, symmetric, 2.2, True))


def test_a_scene_beyond_the_machine_is_refused_before_a_cloud_is_made(monkeypatch):
    config, folder = liver(0.0004)
    monkeypatch.setattr("palpate.scene_cloud.build_cloud", lambda *_: pytest.fail("a cloud is made"))
    with pytest.raises(MemoryError, match="use a coarser cloud"):
        build_model(config, folder)


def test_the_dry_run_names_nodes_unknowns_and_stages():
    text = expectation_text(*liver(0.0049))
    for part in ("nodes", "unknowns", "node cloud", "assembly", "modes, Ritz", "GiB"):
        assert part in text


BLOCK: dict[str, Any] = tomllib.loads("""
name = "block"
[geometry]
shape = "surface"
file = "block.ply"
spacing_m = 0.015
[material]
preset = "liver"
[[fixed]]
region = "plane"
point_m = [0.0, 0.0, 0.001]
normal = [0.0, 0.0, -1.0]
[surface]
band_hz = [0.0, 15.0]
spacing_m = 0.01
[[surface.working_area]]
region = "sphere"
center_m = [0.0, 0.0, 0.04]
radius_m = 0.02
[[tool]]
name = "tip"
radius_m = 0.016
friction = 0.3
""")


@pytest.fixture
def block_folder(tmp_path):
    block = box_lattice((-0.04, -0.04, 0.0), (0.04, 0.04, 0.04), (5, 5, 3)).surface
    (tmp_path / "block.ply").write_bytes(ply_bytes(block.vertices, block.triangles))
    return tmp_path


def test_the_dry_run_of_a_scene_with_tools_counts_nodes_and_points(block_folder, monkeypatch):
    config = check_config(BLOCK, "block")
    cloud = build_cloud(config, block_folder)
    expected = expected_surface_model(config, block_folder)
    assert (expected.n_nodes, expected.n_points) == (cloud.n_nodes, cloud.boundary.sum())
    assert 0.5 * 2**30 < expected.peak_bytes < 2**30
    assert f"{3 * cloud.n_nodes:,} unknowns" in expected.text()
    assert "smaller surface.working_area" not in expected.text()
    monkeypatch.setattr("palpate.expected_surface.machine_memory", lambda: 2**28)
    assert "smaller surface.working_area" in expected_surface_model(config, block_folder).text()


def test_the_dry_run_of_a_scene_with_tools_finds_the_mistakes_that_the_build_finds(block_folder):
    tables = copy.deepcopy(BLOCK)
    tables["surface"]["working_area"][0]["center_m"] = [0.0, 0.0, 0.5]
    with pytest.raises(ValueError, match=r"surface.working_area\[0\]: holds nothing of the surface"):
        expected_surface_model(check_config(tables, "block"), block_folder)
    with pytest.raises(FileNotFoundError, match=r"block\.ply"):
        expected_surface_model(check_config(BLOCK, "block"), block_folder / "elsewhere")
