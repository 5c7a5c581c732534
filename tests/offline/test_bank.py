"""Banks of scenes by each executor: the models are those of single builds, what the scenes share is computed once."""

from __future__ import annotations

import pytest

from palpate import bank as module
from palpate.bank import build_bank
from palpate.build import build_model
from palpate.model_file import load_model, save_model
from palpate.scene.schema import load_config
from palpate.stage_cache import NO_CACHE, StageCache


@pytest.fixture
def family(slab_scene, tmp_path):
    """Three materials of one slab."""
    scenes = []
    for number, modulus in enumerate((4000.0, 5000.0, 6000.0)):
        text = slab_scene(more='[reduction]\nmethod = "tbr-band"\norder = 40\n')
        text = text.replace('name = "slab"', f'name = "slab-{number}"')
        text = text.replace('preset = "liver"', f'preset = "liver"\nyoungs_modulus_pa = {modulus}')
        scenes.append(tmp_path / f"{number}.toml")
        scenes[-1].write_text(text, encoding="utf-8")
    return scenes


def check(family, tmp_path, executor):
    cache = StageCache.open(tmp_path / "cache")
    built = list(build_bank(family, tmp_path / "out", cache, executor, 2))
    assert {b.path.name for b in built} == {"slab-0.npz", "slab-1.npz", "slab-2.npz"}
    kept = sorted(path.name.partition("-")[0] for path in (tmp_path / "cache").glob("*.stage"))
    assert kept == ["body", "cloud", "modes"], "one of each for the whole family"
    save_model(build_model(load_config(family[1]), tmp_path), tmp_path / "alone.npz")
    assert (tmp_path / "alone.npz").read_bytes() == (tmp_path / "out" / "slab-1.npz").read_bytes()
    stiffness = [load_model(tmp_path / "out" / f"slab-{n}.npz").static_stiffness[2, 2] for n in range(3)]
    assert stiffness == pytest.approx([stiffness[0] * factor for factor in (1, 5 / 4, 6 / 4)], rel=1e-9)


@pytest.mark.parametrize("executor", ["threads", pytest.param("processes", marks=pytest.mark.slow)])
def test_a_family_is_built_with_its_shared_stages_once(family, tmp_path, executor):
    check(family, tmp_path, executor)


def test_a_family_is_built_on_a_dask_cluster(family, tmp_path):
    distributed = pytest.importorskip("distributed", reason="palpate[dask] is not installed")
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, dashboard_address=None, host="127.0.0.1"
    ) as cluster:
        check(family, tmp_path, cluster.scheduler_address.replace("tcp://", "dask://"))


@pytest.mark.parametrize(
    ("change", "executor", "message"),
    [
        (lambda f: [f[0], f[0]], "threads", "name = 'slab-0' is that of another scene too"),
        (lambda f: f, "cloud", "executor = 'cloud': expected threads, processes or dask://ADDRESS"),
    ],
)
def test_what_a_bank_can_not_build_is_refused(family, tmp_path, change, executor, message):
    with pytest.raises(ValueError, match=message):
        list(build_bank(change(family), tmp_path / "out", NO_CACHE, executor, 1))


def test_a_scene_that_fails_is_named(family, tmp_path, monkeypatch):
    def fails(*_):
        raise ValueError("too thin")

    monkeypatch.setattr(module, "_build", fails)
    with pytest.raises(ValueError, match=r"0\.toml: too thin"):
        list(build_bank(family[:1], tmp_path / "out", NO_CACHE, "threads", 1))
