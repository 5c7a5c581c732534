"""The demonstration: builds a scene, serves it in a second process, pokes it, and draws the forces."""

from __future__ import annotations

import csv
import json
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.build import build_model
from palpate.files import check_output, make_folder
from palpate.model_file import ModelFileError, ReducedModel, load_patch_model, save_model
from palpate.plots import Touch, draw_touch, require_matplotlib
from palpate.progress import Progress
from palpate.scene.schema import fingerprint, load_config
from palpate_client.local_server import free_endpoint, running

Array = NDArray[np.float64]

_CLIENT_TIMEOUT_S = 60.0


@dataclass(frozen=True)
class Demo:
    """Results of a demonstration.

    client        the headless client's summary, as it prints it with --json
    touch         the recorded poke beside the full model's answer
    error         largest force error over the largest force, on this poke
    error_in_band the same within the model's haptic band
    """

    model: ReducedModel
    model_path: Path
    picture: Path
    client: dict[str, Any]
    touch: Touch
    error: float
    error_in_band: float

    def lines(self) -> list[str]:
        """The summary of latency and force, for a person."""
        trip = self.client["round_trip_s"]
        inward = -np.asarray(self.model.contacts[0].normal)
        force = self.touch.force_n[:, :3] @ -inward
        depth = self.touch.displacement_m[:, :3] @ inward
        return [
            f"commands      {self.client['commands_sent']:,} sent, {self.client['commands_answered']:,} answered",
            f"round trip    p50 {1e6 * trip['p50']:.0f}, p99 {1e6 * trip['p99']:.0f} microseconds, command to force, over the wire",
            f"depth         up to {1e3 * depth.max():.2f} mm",
            f"force         {force.min():+.3f} to {force.max():+.3f} N along the outward normal: positive pushes the device out",
            f"full model    served and exact force differ by at most {100 * self.error_in_band:.2g} % of the largest "
            f"force below {self.model.accuracy.band_hz[1]:g} Hz (the file states {100 * self.model.accuracy.error_in_band:.2g} %); "
            f"{100 * self.error:.2g} % with all that late commands add above",
            f"contract      {'BROKEN: ' + '; '.join(self.client['contract_broken']) if self.client['contract_broken'] else 'held'}",
            f"model         {self.model_path}",
            f"picture       {self.picture}",
        ]


def run_demo(config_path: Path, out: Path, seconds: float, progress: Progress) -> Demo:
    """Build (unless `out` holds a model of the same configuration), serve, poke for `seconds`, draw.

    Raises what `build_model` raises, and ValueError when server or client fail, with what they said.
    """
    require_matplotlib()
    make_folder(out)
    model_path, recording, picture = (
        out / name for name in (f"{config_path.stem}.npz", "poke.csv", "demo.png")
    )
    for path in (model_path, recording, picture):  # better to fail now than after the work
        check_output(path)
    model = _built(model_path, config_path, progress)
    progress("server in a second process")
    endpoint = free_endpoint()
    command = [sys.executable, "-m", "palpate_server", str(model_path), "--listen", endpoint]
    with running(command, "serving") as (_, line):
        progress.note(line)
        progress(f"poke, {seconds:g} s")
        client = _poke(endpoint, seconds, recording)
        progress.note(f"{client['commands_answered']:,} of {client['commands_sent']:,} commands answered")
    progress("picture")
    touch = read_touch(recording, model)
    draw_touch(model, touch, picture)
    difference = touch.force_n - touch.force_full_n
    largest = np.linalg.norm(touch.force_full_n, axis=1).max()
    error, in_band = (
        float(np.linalg.norm(d, axis=1).max() / largest)
        for d in (difference, touch.in_band(difference, model))
    )
    return Demo(model, model_path, picture, client, touch, error, in_band)


def read_touch(recording: Path, model: ReducedModel) -> Touch:
    """A recording of the headless client beside what a device would render with the full model for the same positions.

    Raises ValueError where it lacks a column or a contact, or no tick was recorded.
    """
    with recording.open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    if len(rows) < 2:
        raise ValueError(f"{recording}: {len(rows)} ticks recorded, expected at least 2")

    def columns(quantity: str, unit: str) -> Array:
        names = [f"{c.name}.{quantity}_{axis}_{unit}" for c in model.contacts for axis in "xyz"]
        missing = [n for n in names if n not in rows[0]]
        if missing:
            raise ValueError(f"{recording}: no column {missing[0]!r}, expected a recording of {model.name}")
        return np.array([[float(row[n]) for n in names] for row in rows])

    received = np.array([int(row["tick"]) for row in rows])
    scale = np.repeat(
        [[float(row[f"{c.name}.force_scale"]) for c in model.contacts] for row in rows], 3, axis=1
    )
    start = np.concatenate([contact.center_m for contact in model.contacts])
    applied, force = columns("position", "m") - start, columns("force", "n")
    # Force messages may be lost: the displacement of such a tick is interpolated.
    ticks = np.arange(received[0], received[-1] + 1)
    every = np.stack([np.interp(ticks, received, channel) for channel in applied.T], axis=1)
    exact = model.full.response(every, model.period_s)[received - received[0]]
    # The model's force is what the tip does to the tissue, the device's is its negative.
    return Touch((received - received[0]) * model.period_s, applied, force, -scale * exact)


def _built(path: Path, config_path: Path, progress: Progress) -> ReducedModel:
    config = load_config(config_path)
    if path.exists():
        try:
            model = load_patch_model(path)
        except ModelFileError as error:
            progress("look at the model that is there")
            progress.note(f"{error}; building it again")
        else:
            if model.config_sha256 == fingerprint(config, config_path.parent):
                progress(f"model {path}")
                progress.note("already built from this configuration")
                return model
    model = build_model(config, config_path.parent, progress)
    save_model(model, path)
    return model


def _poke(endpoint: str, seconds: float, recording: Path) -> dict[str, Any]:
    command = [sys.executable, "-m", "palpate_client.poke", "--connect", endpoint]
    command += ["--duration-s", str(seconds), "--json", "--record", str(recording)]
    done = subprocess.run(
        command, capture_output=True, text=True, timeout=seconds + _CLIENT_TIMEOUT_S, check=False
    )
    try:
        summary: dict[str, Any] = json.loads(done.stdout)
    except json.JSONDecodeError:
        raise ValueError(f"the client failed (exit code {done.returncode}): {done.stderr.strip()}") from None
    return summary
