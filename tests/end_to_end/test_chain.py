"""From a scene to forces over the wire: what the server gives is what the full model says, within the stated error."""

from __future__ import annotations

import json
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest

from palpate.demo import read_touch
from palpate.diagonal_system import full_system
from palpate.model import ReducedModel, load_model
from palpate.plots import Touch
from palpate.reduction.evidence import step_through


@pytest.fixture(scope="module")
def recorded(
    tmp_path_factory: pytest.TempPathFactory, slab_scene: Callable[..., str]
) -> Iterator[tuple[ReducedModel, Touch, dict[str, object]]]:
    """A slab built, served in one process and poked at its second contact by the headless client in another."""
    folder = tmp_path_factory.mktemp("chain")
    (folder / "slab.toml").write_text(
        slab_scene(("left", 0.02, 0.006), ("right", 0.05, 0.006), more="[reduction]\ntolerance = 0.02\n")
    )
    build = [sys.executable, "-m", "palpate.cli", "build", "slab.toml"]
    subprocess.run(build, cwd=folder, check=True, capture_output=True, timeout=120)
    model = load_model(folder / "slab.npz")
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        endpoint = f"tcp/127.0.0.1:{probe.getsockname()[1]}"
    serve = [
        sys.executable,
        "-m",
        "palpate.cli",
        "serve",
        "slab.npz",
        "--listen",
        endpoint,
        "--session",
        "chain",
    ]
    with subprocess.Popen(serve, cwd=folder, stdout=subprocess.PIPE, text=True) as server:
        try:
            assert server.stdout is not None
            assert "serving slab" in server.stdout.readline()
            client = [
                sys.executable,
                "-m",
                "palpate.cli",
                "client",
                "--connect",
                endpoint,
                "--session",
                "chain",
            ]
            client += ["--contact", "right", "--amplitude-m", "0.002", "--frequency-hz", "2"]
            client += ["--duration-s", "3", "--record", "poke.csv", "--json"]
            done = subprocess.run(client, cwd=folder, capture_output=True, text=True, timeout=60, check=False)
            assert done.returncode == 0, done.stderr
        finally:
            server.terminate()
            assert server.wait(10) == 0
    yield model, read_touch(folder / "poke.csv", model), json.loads(done.stdout)


def test_the_client_installed_with_palpate_is_the_example_a_user_copies() -> None:
    assert (Path(str(files("palpate_client_examples"))) / "headless_client.py").is_file()


def test_commands_are_answered_and_the_contract_holds(
    recorded: tuple[ReducedModel, Touch, dict[str, object]],
) -> None:
    _, _, summary = recorded
    assert summary["contact"] == "right"
    assert summary["contract_broken"] == []
    assert summary["server_lost"] is None


def test_the_poke_moved_the_chosen_contact_and_the_one_that_nobody_holds_gives_no_force(
    recorded: tuple[ReducedModel, Touch, dict[str, object]],
) -> None:
    model, touch, _ = recorded
    inward = -np.asarray(model.contacts[1].normal)
    assert np.max(touch.displacement_m[:, 3:] @ inward) == pytest.approx(0.002, rel=0.02)
    assert np.all(touch.displacement_m[:, :3] == 0)
    assert np.max(touch.force_full_n[:, 3:] @ inward) > 0
    assert np.all(touch.force_n[:, :3] == 0)


def test_the_served_force_is_the_full_models_within_the_error_that_the_file_states(
    recorded: tuple[ReducedModel, Touch, dict[str, object]],
) -> None:
    """By Parseval, the force error in the band has at most error_in_band times the energy of |F| |u| there."""
    model, touch, _ = recorded
    full = full_system(model.full)
    steady = np.all(touch.force_n[:, 3:] != 0, axis=1)  # a contact that nobody holds gives no force
    difference = touch.in_band((touch.force_n - touch.force_full_n)[:, 3:] * steady[:, None], model)
    frequencies = np.fft.rfftfreq(len(touch.time_s), model.period_s)
    spectrum = np.fft.rfft(touch.displacement_m, axis=0)
    in_band = frequencies <= model.evidence.band_hz[1]
    gain = np.linalg.norm(full.transfer(2j * np.pi * frequencies[in_band]), 2, axis=(1, 2))
    felt = gain * np.linalg.norm(spectrum[in_band], axis=1)
    weights = np.where(frequencies[in_band] == 0, 1.0, 2.0)  # both signs of the frequency
    energy = np.sum(weights * felt**2) / len(touch.time_s)
    assert np.sum(difference**2) <= model.evidence.error_in_band**2 * energy


def test_the_stated_time_domain_error_is_found_again_from_the_file_alone(
    recorded: tuple[ReducedModel, Touch, dict[str, object]],
) -> None:
    model, _, _ = recorded
    full = full_system(model.full)
    time = np.arange(5000) * model.period_s
    poke = 1e-3 * np.outer(np.sin(np.pi * time / 5) ** 4, np.ones(model.n_inputs))
    exact = full.response(poke, model.period_s)
    served = step_through(model.discrete, poke)
    error = np.max(np.linalg.norm(served - exact, axis=1)) / np.max(np.linalg.norm(exact, axis=1))
    assert error <= max(model.evidence.error_in_band, model.evidence.error_time_domain)
