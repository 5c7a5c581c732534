"""Builds a scene unless it is built, serves it in a second process, and has it touched."""

from __future__ import annotations

import functools
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from palpate.build import build_model
from palpate.build_surface import build_surface_model, surface_body, surface_modes
from palpate.demo.patch import Poke, poke
from palpate.demo.surface import Slide, slide
from palpate.files import check_output, make_folder
from palpate.model_file import ModelFileError, ReducedModel, SurfaceModel, load_model, save_model
from palpate.plots import require_matplotlib
from palpate.progress import Progress
from palpate.scene.schema import Config, fingerprint, load_config
from palpate.stage_cache import NO_CACHE, StageCache
from palpate.surface_model.reference import reference_model
from palpate_client.local_server import free_endpoint, running

_COMPILE = "from palpate_server.session.warm_up import warm_up; warm_up(0.001, 1)"


@dataclass(frozen=True)
class Demo:
    """Results of a demonstration. touch: what was felt"""

    model: ReducedModel | SurfaceModel
    touch: Poke | Slide
    model_path: Path
    picture: Path

    def lines(self) -> list[str]:
        """The summary of latency and force, for a person."""
        client = self.touch.client
        trip, broken = client["round_trip_s"], client["contract_broken"]
        return [
            f"commands      {client['commands_sent']:,} sent, {client['commands_answered']:,} answered",
            f"round trip    p50 {1e6 * trip['p50']:.0f}, p99 {1e6 * trip['p99']:.0f} microseconds, command to force, over the wire",
            *self.touch.lines(),
            f"contract      {'BROKEN: ' + '; '.join(broken) if broken else 'held'}",
            f"model         {self.model_path}",
            f"picture       {self.picture}",
        ]


def run_demo(
    scene: Path, out: Path, seconds: float, progress: Progress, cache: StageCache = NO_CACHE
) -> Demo:
    """Build (unless `out` holds a model of the same scene, or there is one beside it), serve, touch for `seconds`, draw.

    A model with contact patches is poked; on a surface model a tool presses, slides and lets go.

    Raises what `build_model` and `build_surface_model` raise, and ValueError or ClientError when server or client fail.
    """
    require_matplotlib()
    make_folder(out)
    config, folder = load_config(scene), scene.parent
    new_path, picture = out / f"{scene.stem}.npz", out / "demo.png"
    for path in (new_path, picture):  # better to fail now than after the work
        check_output(path)
    with _compiling():
        model, model_path = _built(new_path, scene, config, progress, cache)
    progress("server in a second process")
    endpoint = free_endpoint()
    command = [sys.executable, "-m", "palpate_server", str(model_path), "--listen", endpoint]
    touch: Poke | Slide
    with running(command, "serving") as (_, line):
        progress.note(line)
        if isinstance(model, SurfaceModel):
            reference = functools.partial(_reference, config, folder, cache, model)
            touch = slide(model, endpoint, seconds, reference, progress)
        else:
            touch = poke(model, endpoint, seconds, out, progress)
    progress("picture")
    touch.draw(picture)
    return Demo(model, touch, model_path, picture)


def show(model_path: Path) -> None:
    """Serve a model and open its page in the browser, until Ctrl-C or a signal ends the page. Raises ServerGone."""
    endpoint = free_endpoint()
    serve = [sys.executable, "-m", "palpate_server", str(model_path), "--listen", endpoint]
    view = [sys.executable, "-m", "palpate", "view", "--connect", endpoint, "--open"]
    with running(serve, "serving"), running(view, "palpate view:") as (page, where):
        print(where, flush=True)
        page.wait()


def _reference(
    config: Config, folder: Path, cache: StageCache, model: SurfaceModel, points: NDArray[np.intp]
) -> SurfaceModel:
    """The full model of some points, from the stages that the model was built of.

    Raises ValueError where another version has built the model, of another cloud.
    """
    body = surface_body(config, folder, cache=cache)
    if not np.array_equal(body.cloud.points[body.touched.nodes], model.points):
        raise ValueError(
            f"{model.name}: the model's points are not those of this scene's body, which another version built: remove its file"
        )
    modes = surface_modes(config, body, cache=cache)
    return reference_model(model, body.held(), modes, body.touched.rows, points)


@contextmanager
def _compiling() -> Iterator[None]:
    """Meanwhile the server's functions are compiled in a process beside, unless they are."""
    process = subprocess.Popen([sys.executable, "-c", _COMPILE])
    try:
        yield
        process.wait()
    finally:
        process.kill()
        process.wait()


def _built(
    path: Path, scene: Path, config: Config, progress: Progress, cache: StageCache
) -> tuple[ReducedModel | SurfaceModel, Path]:
    """The model at the path, or beside the scene, if it is of this scene; else it is built and saved at the path."""
    for there in (path, scene.with_suffix(".npz")):
        if not there.exists():
            continue
        try:
            model = load_model(there)
        except ModelFileError as error:
            progress("look at the model that is there")
            progress.note(f"{error}; building it again")
            continue
        if model.config_sha256 == fingerprint(config, scene.parent):
            progress(f"model {there}")
            progress.note("already built from this configuration")
            return model, there
    build = build_surface_model if config.tool else build_model
    model = build(config, scene.parent, progress, cache)
    save_model(model, path)
    return model, path
