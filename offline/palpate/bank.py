"""A family of models: scenes built side by side, the stages that they share computed once."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from concurrent.futures import Executor, ProcessPoolExecutor, ThreadPoolExecutor, as_completed
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path

from palpate.build import build_model
from palpate.files import make_folder
from palpate.model_file import save_model
from palpate.scene.schema import load_config
from palpate.stage_cache import StageCache

_DASK = "dask://"


@dataclass(frozen=True)
class Built:
    """One model of the bank: where it is, its states, its largest force error in the band (a fraction)."""

    path: Path
    n_states: int
    error_in_band: float


def build_bank(
    scenes: Sequence[Path], out: Path, cache: StageCache, executor: str, workers: int
) -> Iterator[Built]:
    """The models as they are finished, each in `out` under its scene's name.

    cache     shared by all: one build computes a stage, the others wait for it. With Dask on other machines it has to be a
              folder that all of them see, as `out` and the scenes
    executor  "threads", "processes" or "dask://ADDRESS" of a scheduler
    workers   builds at once; with Dask its workers

    Raises ValueError for an unknown executor, for two scenes of one name or for one with tools; what `build_model` raises,
    with the scene's name.
    """
    configs = [load_config(scene) for scene in scenes]
    names = [config.name for config in configs]
    for scene, config in zip(scenes, configs, strict=True):
        if names.count(config.name) > 1:
            raise ValueError(
                f"{scene}: name = {config.name!r} is that of another scene too: expected each once"
            )
        if config.tool:
            raise ValueError(f"{scene}: a bank builds scenes with contacts, expected none with [[tool]]")
    make_folder(out)
    with _pool(executor, workers) as pool:
        running = {
            pool.submit(_build, scene.resolve(), (out / f"{name}.npz").resolve(), cache): scene
            for scene, name in zip(scenes, names, strict=True)
        }
        try:
            for done in as_completed(running):
                try:
                    yield done.result()
                except ValueError as error:
                    raise ValueError(f"{running[done]}: {error}") from error
        finally:
            for future in running:
                future.cancel()


def _build(scene: Path, path: Path, cache: StageCache) -> Built:
    model = build_model(load_config(scene), scene.parent, cache=cache)
    save_model(model, path, [scene])
    return Built(path, model.order, model.accuracy.error_in_band)


@contextmanager
def _pool(executor: str, workers: int) -> Iterator[Executor]:
    if executor == "threads":
        with ThreadPoolExecutor(workers) as threads:
            yield threads
    elif executor == "processes":
        # Spawned, not forked: numba and the libraries' threads do not survive a fork.
        with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as processes:
            yield processes
    elif executor.startswith(_DASK):
        from distributed import Client

        with Client(f"tcp://{executor.removeprefix(_DASK)}") as client, client.get_executor() as remote:
            yield remote
    else:
        raise ValueError(f"executor = {executor!r}: expected threads, processes or dask://ADDRESS")
