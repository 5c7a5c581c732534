"""Tips of a surface model's tools: agreed at acquire and load, stated in the status, and refused where the loop could not use them."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from palpate.model_file import ReducedModel, SurfaceModel, load_model, save_model
from palpate_server.coupling import models
from palpate_server.errors import Refused
from palpate_server.realtime import scheduler
from palpate_server.session import loading, status
from palpate_server.session.requests import Requests
from palpate_server.session.tips import tip_warnings


@pytest.fixture
def requests(surface_session: Any, tmp_path: Path) -> Requests:
    """Every client is alive; the folder of models is `tmp_path`."""
    return Requests(surface_session.state, lambda client: True, lambda: None, tmp_path, None, 0)


def told(state: Any, tool: str) -> dict[str, float | None]:
    stated = status.status(state, 1)["tools"][tool]
    return {name: stated[name] for name in ("radius_m", "friction", "stiffness_n_per_m")}


def in_the_loop(state: Any, tool: str) -> dict[str, float]:
    tools, i = state.memory.coupling.running.contact.tools, state.tool_index[tool]
    return {
        "radius_m": tools.radius[i],
        "friction": tools.friction[i],
        "stiffness_n_per_m": 1 / tools.compliance[i],
    }


def test_the_status_computes_no_geometry(surface_session: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """It is published ten times a second, while ticks run: its cost must not grow with points times tools."""

    def fail(*_: Any) -> None:
        raise AssertionError("the way to the surface was computed for a status")

    monkeypatch.setattr(models, "start_of", fail)
    monkeypatch.setattr(models, "tools_of", fail)
    assert told(surface_session.state, "tip1")["radius_m"] == 0.005


def test_the_status_states_the_tip_that_the_loop_has(surface_session: Any, requests: Requests) -> None:
    """A released tool keeps its tip, as its limits, frame and home, until the next acquire."""
    state = surface_session.state
    assert told(state, "tip") == pytest.approx(in_the_loop(state, "tip"))
    wanted = {"radius_m": 0.0045, "friction": 0.1, "stiffness_n_per_m": 50.0}
    answer = requests.carry_out("first", "acquire", {"tools": ["tip"], **wanted})
    assert wanted.items() <= answer["tools"]["tip"].items()
    for _ in range(2):
        assert told(state, "tip") == wanted
        assert in_the_loop(state, "tip") == pytest.approx(wanted)
        requests.carry_out("first", "release", {})
    of_file = {"radius_m": 0.005, "friction": 0.3, "stiffness_n_per_m": 700.0}
    requests.carry_out("second", "acquire", {"tools": ["tip"]})
    assert told(state, "tip") == of_file


def test_a_model_that_is_loaded_brings_its_own_tips_except_for_what_was_asked_for(
    surface_session: Any,
    requests: Requests,
    make_surface_model: Callable[..., SurfaceModel],
    make_spring_mass_model: Callable[..., ReducedModel],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(loading, "load_model_elsewhere", lambda path, *_: load_model(path))  # quicker here
    other = make_surface_model(2)
    other = replace(other, tools=tuple(replace(tool, radius_m=0.0048, friction=0.2) for tool in other.tools))
    save_model(other, tmp_path / "other.npz")
    save_model(make_spring_mass_model(2), tmp_path / "patch.npz")
    state = surface_session.state
    requests.carry_out("first", "acquire", {"tools": ["tip", "tip1"], "friction": 0.5})
    requests.carry_out("first", "load", {"file": "other.npz"})
    expected = {"radius_m": 0.0048, "friction": 0.5, "stiffness_n_per_m": 700.0}
    assert told(state, "tip1") == expected
    assert in_the_loop(state, "tip1") == pytest.approx(expected)
    requests.carry_out("first", "acquire", {"tools": ["tip", "tip1"]})
    requests.carry_out("first", "load", {"file": "patch.npz"})
    assert told(state, "tip1") == dict.fromkeys(expected)
    requests.carry_out("first", "load", {"file": "other.npz"})
    assert told(state, "tip1") == expected | {"friction": 0.2}


def test_a_tip_is_warned_of_where_the_points_do_not_carry_it(
    surface_session: Any, requests: Requests, make_surface_model: Callable[..., SurfaceModel]
) -> None:
    assert requests.carry_out("first", "acquire", {"tools": ["tip"]})["warnings"] == []
    (warning,) = requests.carry_out("first", "acquire", {"tools": ["tip"], "radius_m": 0.002})["warnings"]
    assert "tool 'tip': radius_m = 0.002 touches about 0.7 points 0.003 m apart" in warning

    model = make_surface_model()
    far = np.linalg.norm(model.points[:, :2], axis=1) > 0.012
    stretched = replace(model, points=model.points * np.where(far, 4.0, 1.0)[:, None])
    tip = models.tips_of_file(stretched)[0]
    (warning,) = tip_warnings(stretched, 0, tip)
    assert "outside the working areas, a tip of radius_m = 0.005 acts as a blunter one" in warning
    assert "near enough on" in warning


NUMBERS = ("radius_m", "friction", "stiffness_n_per_m", "round_trip_s", "device_damping_n_s_per_m")


@pytest.mark.parametrize("value", [5e-324, 1e-310, 1e-200, 1e-160, 1e300, math.inf, math.nan, -1.0, -1e-310])
def test_a_number_that_the_loop_could_not_bear_is_refused_by_its_name(
    surface_session: Any, requests: Requests, value: float
) -> None:
    """A compliance of infinity, an area of zero: one tool with it would end the balance of energy for all."""
    state, tools = surface_session.state, {"tools": ["tip", "tip1"]}
    requests.carry_out("first", "acquire", tools)
    agreed = told(state, "tip")
    for field in NUMBERS:
        request = tools | {"device": "touch", "device_damping_n_s_per_m": 1.0, field: value}
        if field in ("friction", "round_trip_s") and 0 < value < 1:  # as good as none
            requests.carry_out("first", "acquire", request)
            requests.carry_out("first", "acquire", tools)
            continue
        with pytest.raises(Refused, match=rf"^{field} ") as refusal:
            requests.carry_out("first", "acquire", request)
        assert refusal.value.reason == "out_of_range"
    assert told(state, "tip") == agreed
    assert_energy_is_counted(state)
    assert np.all(state.memory.reactions["work_j"] > 0)


@pytest.mark.parametrize("value", [5e-324, 1e-200])
def test_the_smallest_limits_and_positions_leave_the_loop_unharmed(
    surface_session: Any, requests: Requests, value: float
) -> None:
    state = surface_session.state
    requests.carry_out("first", "acquire", {"tools": ["tip", "tip1"]})
    limits = {"max_force_n": value, "workspace_radius_m": value, "max_damping_n_s_per_m": value}
    for name in limits:
        requests.carry_out("first", "limits", {"limits": {name: limits[name]}})
        assert_energy_is_counted(state, value)
        requests.carry_out("first", "acquire", {"tools": ["tip", "tip1"]})


def assert_energy_is_counted(state: Any, beside_m: float = 0.0) -> None:
    """Both tools, which their client holds, go 2 mm into the tissue: forces and energies are finite, and there was work."""
    before, commands = int(state.memory.counters["ticks"][0]), state.memory.commands
    homes = [np.array(state.leases.settings[name].home_m) for name in state.tools]
    for sequence in range(400):
        depth = 2e-3 * min(1.0, max(0.0, (sequence - 250) / 50)) - 1e-3 * (sequence < 250)
        for tool, home in enumerate(homes):
            incoming = commands.incoming[tool]
            incoming["tool"], incoming["lease"], incoming["sequence"] = (
                tool,
                state.lease_numbers[tool],
                sequence,
            )
            incoming["arrival_ns"] = time.monotonic_ns()
            incoming["position_m"] = home + np.array([beside_m, beside_m, -depth])
            incoming["velocity_m_per_s"] = 0.0
            incoming["rendered_tick"] = -1
        assert scheduler.hand_over(state.image, len(homes)) == 0
        give_up = time.monotonic() + 30
        while int(state.memory.counters["ticks"][0]) < before + sequence:
            assert time.monotonic() < give_up
            time.sleep(2e-4)
    assert state.memory.counters["faults"][0] == 0
    for name in ("work_j", "stored_j", "dissipated_j"):
        assert np.all(np.isfinite(state.memory.reactions[name])), name
    assert np.all(np.isfinite(state.memory.ledger))
    assert np.all(np.isfinite(state.memory.ports["force_n"]))
    assert np.all(np.isfinite(state.memory.coupling.running.contact.budget))
