"""The demonstration of a patch model: a poke, beside the full model's answer."""

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

from palpate.files import check_output
from palpate.model_file import ReducedModel
from palpate.plots import Touch, draw_touch, in_band
from palpate.progress import Progress

Array = NDArray[np.float64]

_CLIENT_TIMEOUT_S = 60.0


@dataclass(frozen=True)
class Poke:
    """Results of a poke.

    client        the headless client's summary, as it prints it with --json
    touch         the recorded poke beside the full model's answer
    error         largest force error over the largest force, on this poke
    error_in_band the same within the model's haptic band
    """

    model: ReducedModel
    client: dict[str, Any]
    touch: Touch
    error: float
    error_in_band: float

    def lines(self) -> list[str]:
        """Depth and force, for a person."""
        inward = -np.asarray(self.model.contacts[0].normal)
        force = self.touch.force_n[:, :3] @ -inward
        depth = self.touch.displacement_m[:, :3] @ inward
        return [
            f"depth         up to {1e3 * depth.max():.2f} mm",
            f"force         {force.min():+.3f} to {force.max():+.3f} N along the outward normal: positive pushes the device out",
            f"full model    served and exact force differ by at most {100 * self.error_in_band:.2g} % of the largest "
            f"force below {self.model.accuracy.band_hz[1]:g} Hz (the file states {100 * self.model.accuracy.error_in_band:.2g} %); "
            f"{100 * self.error:.2g} % with all that late commands add above",
        ]

    def draw(self, picture: Path) -> None:
        draw_touch(self.model, self.touch, picture)


def poke(model: ReducedModel, endpoint: str, seconds: float, out: Path, progress: Progress) -> Poke:
    """Poke the first contact of the model that is served at an endpoint; `out` gets the recording.

    Raises ValueError when the client fails, with what it said.
    """
    recording = out / "poke.csv"
    check_output(recording)
    progress(f"poke, {seconds:g} s")
    client = _poke(endpoint, seconds, recording)
    progress.note(f"{client['commands_answered']:,} of {client['commands_sent']:,} commands answered")
    touch = read_touch(recording, model)
    difference = touch.force_n - touch.force_full_n
    largest = np.linalg.norm(touch.force_full_n, axis=1).max()
    error, within_band = (
        float(np.linalg.norm(d, axis=1).max() / largest)
        for d in (difference, in_band(difference, model.accuracy.band_hz, model.period_s))
    )
    return Poke(model, client, touch, error, within_band)


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
