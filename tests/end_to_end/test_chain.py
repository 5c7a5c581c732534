"""From a scene to forces over the wire: what the server gives is what the full model says, within the stated error."""

from __future__ import annotations

import csv
import json
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from palpate.lti.stepping import step_through
from palpate.model_file import ReducedModel, load_model
from palpate.plots import Touch, in_band
from palpate_client.local_server import free_endpoint
from palpate_client.wire import RECORDER

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Poke:
    """What the client said and heard of a poke, and what was recorded of every tick."""

    model: ReducedModel
    summary: dict[str, Any]
    heard: list[dict[str, str]]
    ticks: list[dict[str, Any]]

    def channels(self, quantity: str) -> Array:
        """(ticks, 3 n_tools)"""
        return np.array([tick[quantity] for tick in self.ticks]).reshape(len(self.ticks), -1)

    def displacement_m(self) -> Array:
        """(ticks, 3 n_tools) of every tip from where it touches the tissue at rest"""
        return self.channels("position_m") - np.concatenate([c.center_m for c in self.model.contacts])


@pytest.fixture(scope="module")
def poke(
    start_for_module: Callable[..., Any],
    connect: Callable[..., Any],
    tmp_path_factory: pytest.TempPathFactory,
    slab_scene: Callable[..., str],
    forces_in: Callable[..., Any],
) -> Poke:
    """A slab built, served in one process and poked at its second contact by the headless client in another."""
    folder = tmp_path_factory.mktemp("chain")
    palpate = partial(start_for_module, "-m", "palpate", cwd=folder)
    (folder / "slab.toml").write_text(
        slab_scene(("left", 0.02, 0.006), ("right", 0.05, 0.006), more="[reduction]\ntolerance = 0.02\n")
    )
    code, _, err = palpate("build", "slab.toml").finish()
    assert code == 0, err
    endpoint = free_endpoint()
    place = ("--session", "chain", "--listen", endpoint)
    server = palpate("serve", "slab.npz", *place, "--recordings", ".", ready="serving slab")
    with connect(endpoint, server="chain", name=RECORDER) as client:
        client.record("poke.mcap")
        place = ("--session", "chain", "--connect", endpoint, "--silence-s", "30")
        motion = ("--tool", "right", "--amplitude-m", "0.002", "--frequency-hz", "2", "--duration-s", "2")
        code, out, err = palpate("client", *place, *motion, "--record", "poke.csv", "--json").finish()
        assert code == 0, err
        assert client.control("record", file=None)[1]["recording"]["error"] is None
    assert server.stop() == 0
    with (folder / "poke.csv").open(newline="") as file:
        heard = list(csv.DictReader(file))
    ticks = forces_in(folder / "poke.mcap")
    return Poke(load_model(folder / "slab.npz"), json.loads(out), heard, ticks)


def test_commands_are_answered_and_the_contract_holds(poke: Poke) -> None:
    assert poke.summary["tool"] == "right"
    assert poke.summary["commands_answered"] > 0
    assert poke.summary["contract_broken"] == []
    assert poke.summary["server_lost"] is None


def test_the_poke_moved_the_chosen_contact_and_the_one_that_nobody_holds_gives_no_force(poke: Poke) -> None:
    inward = -np.asarray(poke.model.contacts[1].normal)
    displacement, force = poke.displacement_m(), poke.channels("force_n")
    assert np.max(displacement[:, 3:] @ inward) == pytest.approx(0.002, rel=0.02)
    assert np.all(displacement[:, :3] == 0)
    assert np.max(force[:, 3:] @ -inward) > 0  # pushes out
    assert np.all(force[:, :3] == 0)


def test_the_client_heard_the_forces_that_the_server_computed(poke: Poke) -> None:
    """Force messages are best effort: on a busy machine some ticks may be unheard."""
    recorded = {tick["tick"]: tick for tick in poke.ticks}
    common = [row for row in poke.heard if int(row["tick"]) in recorded]
    assert len(common) > 100
    for row in common:
        force = [[float(row[f"{name}.force_{axis}_n"]) for axis in "xyz"] for name in ("left", "right")]
        assert force == recorded[int(row["tick"])]["force_n"]


def test_the_served_force_is_the_full_models_within_the_error_that_the_file_states(poke: Poke) -> None:
    """By Parseval, the force error in the band has at most error_in_band times the energy of |F| |u| there."""
    model = poke.model
    full = model.full
    displacement, force = poke.displacement_m(), poke.channels("force_n")
    time = np.arange(len(force)) * model.period_s
    scale = np.repeat(poke.channels("force_scale"), 3, axis=1)
    touch = Touch(time, displacement, force, -scale * full.response(displacement, model.period_s))
    steady = np.all(touch.force_n[:, 3:] != 0, axis=1)  # a contact that nobody holds gives no force
    steady_difference = (touch.force_n - touch.force_full_n)[:, 3:] * steady[:, None]
    difference = in_band(steady_difference, model.accuracy.band_hz, model.period_s)
    frequencies = np.fft.rfftfreq(len(touch.time_s), model.period_s)
    spectrum = np.fft.rfft(touch.displacement_m, axis=0)
    inside = frequencies <= model.accuracy.band_hz[1]
    gain = np.linalg.norm(full.transfer(2j * np.pi * frequencies[inside]), 2, axis=(1, 2))
    felt = gain * np.linalg.norm(spectrum[inside], axis=1)
    weights = np.where(frequencies[inside] == 0, 1.0, 2.0)  # both signs of the frequency
    energy = np.sum(weights * felt**2) / len(touch.time_s)
    assert np.sum(difference**2) <= model.accuracy.error_in_band**2 * energy


def test_the_stated_time_domain_error_is_found_again_from_the_file_alone(
    poke: Poke,
) -> None:
    model = poke.model
    full = model.full
    time = np.arange(5000) * model.period_s
    press = 1e-3 * np.outer(np.sin(np.pi * time / 5) ** 4, np.ones(model.n_inputs))
    exact = full.response(press, model.period_s)
    served, _ = step_through(model.discrete, press)
    error = np.max(np.linalg.norm(served - exact, axis=1)) / np.max(np.linalg.norm(exact, axis=1))
    assert error <= max(model.accuracy.error_in_band, model.accuracy.error_time_domain)
