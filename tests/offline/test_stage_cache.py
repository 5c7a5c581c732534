"""Kept stages: what is kept, what is damaged, how large it grows; and builds that go on from them, bit for bit."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import tomllib
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import pytest

from palpate import build as module
from palpate import scene_cloud
from palpate.build import build_model
from palpate.model_file import save_model
from palpate.modes import body_modes
from palpate.scene.schema import check_config
from palpate.stage_cache import NO_CACHE, StageCache, key_of
from palpate.stage_keys import stage_keys

CONFIGS = Path(__file__).parents[2] / "configs"


@dataclass(frozen=True)
class Thing:
    values: np.ndarray

    @cached_property
    def lock(self):
        return threading.Lock()  # can't be pickled


def test_a_stage_is_computed_once_and_only_its_fields_are_kept(tmp_path):
    cache, calls = StageCache.open(tmp_path / "cache"), []

    def compute():
        calls.append(1)
        thing = Thing(np.arange(5.0))
        assert thing.lock
        return thing

    first, second = (cache.kept("cloud", key_of("a"), compute) for _ in range(2))
    np.testing.assert_array_equal(first.values, second.values)
    assert len(calls) == 1
    assert (tmp_path / "cache").stat().st_mode & 0o077 == 0


def test_without_a_cache_nothing_is_kept():
    assert [NO_CACHE.kept("cloud", "k", lambda: 3), NO_CACHE.load("cloud", "k")] == [3, None]


@pytest.mark.parametrize("damage", ["cut", "changed", "empty"])
def test_a_damaged_stage_is_computed_again(tmp_path, damage):
    cache = StageCache.open(tmp_path)
    cache.store("body", "k", np.arange(1000.0))
    (path,) = tmp_path.glob("*.stage")
    data = bytearray(path.read_bytes())
    data[500] ^= 1
    path.write_bytes({"cut": data[:-100], "changed": data, "empty": b""}[damage])
    assert cache.load("body", "k") is None
    assert cache.kept("body", "k", lambda: 7) == 7 == cache.load("body", "k")


def test_the_stages_not_used_for_longest_go_first_and_what_a_killed_build_left_behind(tmp_path):
    cache = StageCache.open(tmp_path, most_bytes=25_000)
    (tmp_path / "body-x.part").write_bytes(b"unfinished")
    for key in ("old", "used", "new"):
        cache.store("body", key, np.zeros(1000))
        path = tmp_path / f"body-{key}.stage"
        os.utime(path, ns=(0, {"old": 1, "used": 0, "new": 2}[key] * 10**9))
        cache.load("body", "used")
    cache.store("body", "newest", np.zeros(1000))
    assert cache.load("body", "old") is None
    assert cache.load("body", "used") is not None
    assert sum(p.stat().st_size for p in tmp_path.glob("*.stage")) <= 25_000
    assert not list(tmp_path.glob("*.part"))


def test_of_several_builds_that_want_a_stage_one_computes_it(tmp_path):
    cache, calls, barrier = StageCache.open(tmp_path), [], threading.Barrier(4)

    def compute():
        calls.append(1)
        return 1

    def want():
        barrier.wait()
        cache.kept("modes", "k", compute)

    threads = [threading.Thread(target=want) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(60)
    assert len(calls) == 1


def slab(slab_scene, **changes):
    tables = tomllib.loads(slab_scene())
    for key, value in changes.items():
        table, _, entry = key.partition("__")
        tables.setdefault(table, {})[entry] = value
    return check_config(tables, "slab")


def test_keys_follow_what_a_stage_depends_on(slab_scene):
    here = Path()
    keys = stage_keys(slab(slab_scene), here)
    for change in (
        {"material__youngs_modulus_pa": 9000.0},
        {"material__density_kg_per_m3": 900.0},
        {"material__gamma": [0.2], "material__tau_s": [0.1]},
        {"reduction__tolerance": 0.02},
        {"reduction__band_hz": [0.0, 20.0], "reduction__tolerance": 0.01},
    ):
        assert stage_keys(slab(slab_scene, **change), here) == keys, change
    stiffer = stage_keys(slab(slab_scene, material__poissons_ratio=0.3), here)
    assert (stiffer.cloud == keys.cloud, stiffer.body == keys.body, stiffer.modes == keys.modes) == (
        True,
        False,
        False,
    )
    finer = stage_keys(slab(slab_scene, geometry__counts=[8, 7, 4]), here)
    assert finer.cloud != keys.cloud


def test_the_nodes_of_a_surface_follow_its_fixed_regions():
    """They lie in pairs along the edges of these; a cloud made for another region would be a wrong one."""
    scene = tomllib.loads((CONFIGS / "liver-coarse.toml").read_text(encoding="utf-8"))
    keys = stage_keys(check_config(scene, "liver"), CONFIGS)
    scene["fixed"][0]["point_m"] = [0.0, 0.05, 0.0]
    assert stage_keys(check_config(scene, "liver"), CONFIGS).cloud != keys.cloud


KILLED = """
import os, signal, sys, tomllib
from pathlib import Path
from palpate.build import build_model
from palpate.modes import body_modes
from palpate.scene.schema import check_config
from palpate.stage_cache import StageCache
body_modes.ALL_MODES_UP_TO = int(sys.argv[4])

class Killed:
    def __call__(self, stage):
        if stage.startswith(sys.argv[3]):
            os.kill(os.getpid(), signal.SIGKILL)
    def note(self, text): pass
    def warn(self, text): pass

config = check_config(tomllib.loads(Path(sys.argv[1]).read_text()), "slab")
build_model(config, Path(), Killed(), StageCache.open(Path(sys.argv[2])))
"""

STAGES = {"assembly": {"cloud"}, "modes": {"cloud", "body"}, "reduction": {"cloud", "body", "modes"}}


def killed(stage, modes, *marks):
    return pytest.param(stage, {"all": 2000, "Ritz": 0}[modes], id=f"{stage}-{modes}", marks=marks)


@pytest.mark.parametrize(
    ("killed_in", "all_modes_up_to"),
    [
        killed("assembly", "all"),
        killed("modes", "Ritz"),
        killed("reduction", "Ritz"),
        killed("assembly", "Ritz", pytest.mark.slow),
        killed("modes", "all", pytest.mark.slow),
        killed("reduction", "all", pytest.mark.slow),
    ],
)
def test_a_build_that_is_killed_goes_on_and_gives_the_same_file(
    slab_scene, tmp_path, monkeypatch, killed_in, all_modes_up_to
):
    monkeypatch.setattr(body_modes, "ALL_MODES_UP_TO", all_modes_up_to)
    scene, folder = tmp_path / "slab.toml", tmp_path / "cache"
    scene.write_text(slab_scene(), encoding="utf-8")
    command = [sys.executable, "-c", KILLED, str(scene), str(folder), killed_in, str(all_modes_up_to)]
    assert subprocess.run(command, timeout=240, check=False).returncode == -signal.SIGKILL
    kept = {path.name.partition("-")[0] for path in folder.glob("*.stage")}
    assert kept == STAGES[killed_in]

    config, asked = slab(slab_scene), []
    monkeypatch.setattr(scene_cloud, "build_cloud", _counted(scene_cloud.build_cloud, asked))
    files = []
    for name, cache in (("resumed", StageCache.open(folder)), ("whole", NO_CACHE)):
        save_model(build_model(config, Path(), cache=cache), tmp_path / f"{name}.npz")
        files.append((tmp_path / f"{name}.npz").read_bytes())
    assert files[0] == files[1]
    assert len(asked) == 1, "the cloud was made for the whole build alone"


def test_another_material_and_band_give_what_a_build_from_the_beginning_gives(
    slab_scene, tmp_path, monkeypatch
):
    cache = StageCache.open(tmp_path)
    build_model(slab(slab_scene), Path(), cache=cache)
    other = slab(
        slab_scene,
        material__youngs_modulus_pa=4000.0,
        reduction__band_hz=[0.0, 25.0],
        reduction__tolerance=0.01,
    )
    whole = build_model(other, Path())
    solved: list[int] = []
    monkeypatch.setattr(module, "elastic_modes", _counted(module.elastic_modes, solved))
    again = build_model(other, Path(), cache=cache)
    assert not solved
    save_model(whole, tmp_path / "whole.npz")
    save_model(again, tmp_path / "again.npz")
    assert (tmp_path / "whole.npz").read_bytes() == (tmp_path / "again.npz").read_bytes()


def _counted(function, calls):
    def counted(*arguments):
        calls.append(1)
        return function(*arguments)

    return counted
