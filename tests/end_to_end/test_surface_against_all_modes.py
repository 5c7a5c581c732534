"""Forces of surface models against the same bodies with all their modes, exact in time: pokes, slides, memory; and as a client gets them."""

from __future__ import annotations

import time
import tomllib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from full_contact import FullBody, Tip, full_body, press
from palpate.build_surface import build_surface_model
from palpate.model_file import SurfaceModel, ToolShape
from palpate.scene.schema import Config, check_config
from palpate_server.coupling.models import tools_of
from palpate_server.recording.replay import read_recording
from palpate_server.simulation import Simulation

Floats = NDArray[np.float64]

CONFIGS = Path(__file__).parents[2] / "configs"
STIFFNESS_N_PER_M = 700.0

BLOCK = """
name = "block"
[geometry]
shape = "box"
upper_m = [0.06, 0.06, 0.036]
counts = [6, 6, 4]
[material]
preset = "liver"
[[fixed]]
region = "plane"
point_m = [0.0, 0.0, 0.001]
normal = [0.0, 0.0, -1.0]
[surface]
band_hz = [0.0, 15.0]
[[tool]]
name = "tip"
radius_m = 0.02
friction = 0.0
"""

LIVER = """
name = "coarse-liver"
[geometry]
shape = "surface"
file = "liver.ply"
spacing_m = 0.012
[material]
preset = "liver"
[[fixed]]
region = "plane"
point_m = [0.0, 0.044, 0.0]
normal = [0.0, 1.0, 0.0]
[surface]
band_hz = [0.0, 20.0]
[[tool]]
name = "tip"
radius_m = 0.02
friction = 0.0
"""
"""Points 12 mm apart can carry a tip of 20 mm. Every mode of the body can be computed."""


@pytest.fixture(scope="module")
def block() -> tuple[SurfaceModel, FullBody]:
    config = check_config(tomllib.loads(BLOCK), "block")
    return build_surface_model(config, Path()), full_body(config)


def along(times_s: list[float], places_m: Floats) -> Floats:
    """(n, 3), m, each millisecond: through places (k, 3), which it leaves and reaches at rest."""
    now = np.arange(0.0, times_s[-1], 1e-3)
    leg = np.clip(np.searchsorted(times_s, now, side="right") - 1, 0, len(times_s) - 2)
    start, end = np.take(times_s, leg), np.take(times_s, leg + 1)
    share = (1 - np.cos(np.pi * (now - start) / (end - start)))[:, None] / 2
    return places_m[leg] * (1 - share) + places_m[leg + 1] * share


def heights(place: Floats, normal: Floats, *heights_m: float) -> Floats:
    return place + np.array(heights_m)[:, None] * normal


def poke(place: Floats, normal: Floats, depth_m: float, press_s: float = 0.2) -> Floats:
    """(n, 3), m: press, hold, and leave; `place` touches without pressing."""
    times = np.cumsum([0.0, press_s, 0.1, press_s, 0.05]).tolist()
    return along(times, heights(place, normal, 1e-3, -depth_m, -depth_m, 1e-3, 1e-3))


def slide(place: Floats, normal: Floats, depth_m: float, way_m: float) -> Floats:
    """(n, 3), m: press, slide along the surface at the place, and leave."""
    beside = np.cross(normal, [0.3, 0.5, 0.8])
    places = heights(place, normal, 1e-3, -depth_m, -depth_m, 1e-3)
    places[2:] += way_m * beside / np.linalg.norm(beside)
    return along([0.0, 0.2, 0.6, 0.8], places)


def felt(model: SurfaceModel, path: Floats) -> Floats:
    """(n, 3), N"""
    simulation = Simulation(model, STIFFNESS_N_PER_M)
    return np.array([simulation.step({"tip": position})["tip"].force_n for position in path])


def error(force: Floats, exact: Floats) -> float:
    """The largest difference over the largest force."""
    return float(np.max(np.linalg.norm(force - exact, axis=1)) / np.max(np.linalg.norm(exact, axis=1)))


def test_pokes_and_a_slide_on_a_block_feel_as_with_all_its_modes(
    block: tuple[SurfaceModel, FullBody],
) -> None:
    model, body = block
    assert model.n_modes < len(body.squared_frequencies) / 2
    radius = model.tools[0].radius_m
    up, tip = np.array([0.0, 0.0, 1.0]), Tip(radius, STIFFNESS_N_PER_M)
    at_a_point, between = np.array([0.024, 0.036, 0.036 + radius]), np.array([0.03, 0.03, 0.036 + radius])
    for path in (poke(at_a_point, up, 4e-3), poke(between, up, 6e-3), slide(at_a_point, up, 5e-3, 0.015)):
        exact, moved = press(body, tip, path, model.period_s)
        assert moved.max() > 1e-3
        assert error(felt(model, path), exact) < model.accuracy.error_in_working_area


def test_a_place_that_was_pressed_is_softer_when_it_is_touched_again(
    block: tuple[SurfaceModel, FullBody],
) -> None:
    """Pressed for 0.6 s, left, touched again after 0.3 s."""
    model, body = block
    radius = model.tools[0].radius_m
    place, up = np.array([0.024, 0.036, 0.036 + radius]), np.array([0.0, 0.0, 1.0])
    again = poke(place, up, 4e-3)
    path = np.concatenate(
        [
            along([0.0, 0.1, 0.7, 0.8, 1.1], heights(place, up, 1e-3, -5e-3, -5e-3, 1e-3, 1e-3)),
            again,
        ]
    )
    exact, _ = press(body, Tip(radius, STIFFNESS_N_PER_M), path, model.period_s)
    force = felt(model, path)[-len(again) :]
    assert error(force, exact[-len(again) :]) < model.accuracy.error_in_working_area
    at_first = felt(model, again)
    assert np.max(force[:, 2]) < 0.98 * np.max(at_first[:, 2])  # the memory is no small part of it


@pytest.mark.slow
def test_a_shorter_period_changes_little_of_the_forces_with_all_modes(
    block: tuple[SurfaceModel, FullBody],
) -> None:
    """The reference is as exact in time as it has to be: its forces are constant in a tick."""
    model, body = block
    path = poke(np.array([0.024, 0.036, 0.036 + 0.02]), np.array([0.0, 0.0, 1.0]), 3e-3)
    fine = np.concatenate([path[:-1] + share * np.diff(path, axis=0) for share in (0.25, 0.5, 0.75, 1.0)])
    fine = fine.reshape(4, -1, 3).transpose(1, 0, 2).reshape(-1, 3)
    tip = Tip(0.02, STIFFNESS_N_PER_M)
    coarse = press(body, tip, path[1:], model.period_s)[0]
    finer = press(body, tip, fine, model.period_s / 4)[0].reshape(-1, 4, 3).mean(axis=1)
    assert error(coarse, finer) < 0.01


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_a_client_feels_pokes_at_20_places_of_the_liver_and_three_slides_as_with_all_its_modes(
    serve: Callable[..., Any], connect: Callable[..., Any], tmp_path: Path
) -> None:
    """A tool for each place: its home is where it comes from."""
    config = check_config(tomllib.loads(LIVER), "liver")
    model, names = at_places(build_surface_model(config, CONFIGS), config, 23)
    body = full_body(config, CONFIGS)
    served = serve("--recordings", str(tmp_path), model=model)
    errors = []
    with connect(served.endpoint) as client:
        for i, name in enumerate(names):
            granted, answer = client.acquire(name)
            assert granted, answer
            tool = answer["tools"][name]
            assert tool["stiffness_n_per_m"] == STIFFNESS_N_PER_M
            start, normal = np.array(tool["home_m"]), np.array(tools_of(model)[i].normal)
            path = poke(start, normal, 6e-3) if i < 20 else slide(start, normal, 4e-3, 0.025)
            client.control("reset")
            client.record(f"{name}.mcap")
            for position in np.concatenate([np.tile(path[0], (500, 1)), path]):
                client.command({name: position.tolist()})
                time.sleep(1e-3)
            assert client.control("record", file=None)[0]
            client.control("release")
            received = {message["tick"]: message["force_n"][i] for message in client.forces}
            recorded = read_recording(tmp_path / f"{name}.mcap")
            is_felt, ticks = recorded.ports[:, i]["force_scale"] > 0, recorded.ticks["tick"]
            positions = np.where(is_felt[:, None], recorded.ports[:, i]["position_m"], path[0])
            tip = Tip(model.tools[i].radius_m, STIFFNESS_N_PER_M)
            exact, _ = press(body, tip, positions, model.period_s)
            whole = (recorded.ports[:, i]["force_scale"] == 1) & np.isin(ticks, list(received))
            assert np.count_nonzero(whole) > 0.8 * len(path)
            force = np.array([received[tick] for tick in ticks[whole].tolist()])
            errors.append(error(force, exact[whole]))
            largest = np.max(np.linalg.norm(exact, axis=1))
            assert largest > 0.1
            print(f"{name}: {largest:.3g} N, {100 * errors[-1]:.2g} %")
    assert np.max(errors) < model.accuracy.error_in_working_area


def at_places(model: SurfaceModel, config: Config, n: int) -> tuple[SurfaceModel, list[str]]:
    """The model with n tools that come to random points from outside."""
    points = np.random.default_rng(5).choice(np.flatnonzero(~model.held), n, replace=False)
    shape = model.tools[0]
    tools = [
        ToolShape(
            f"tip{i}",
            shape.radius_m,
            0.0,
            tuple((model.points[p] + 2 * shape.radius_m * model.normals[p]).tolist()),
        )
        for i, p in enumerate(points)
    ]
    return replace(model, tools=tuple(tools)), [tool.name for tool in tools]
