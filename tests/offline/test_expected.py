"""What a build is said to take, before it takes it."""

import tomllib
from pathlib import Path

import numpy as np
import pytest
from palpate_configs import __file__ as configs

from palpate.build import build_model
from palpate.expected import BodySize, expectation_text, expected_size, expected_stages, require_memory
from palpate.scene.schema import check_config
from palpate.scene_cloud import build_cloud

FOLDER = Path(configs).parent


def liver(spacing_m):
    tables = tomllib.loads((FOLDER / "liver.toml").read_text(encoding="utf-8"))
    tables["geometry"]["spacing_m"] = spacing_m
    return check_config(tables, "liver"), FOLDER


@pytest.mark.parametrize("spacing_m", [0.012, 0.008])
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
