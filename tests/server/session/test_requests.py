"""Requests without Zenoh: what is asked for is carried out, or refused with a reason, as a whole or not at all."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from palpate.model_file import save_model
from palpate_client.wire import MalformedMessage
from palpate_server.errors import Refused
from palpate_server.realtime import scheduler
from palpate_server.session import state as state_module
from palpate_server.session.requests import Requests


@pytest.fixture
def requests(session: Any, tmp_path: Path) -> Requests:
    """Every client is alive, and the folder of models has the running one as same.npz."""
    save_model(session.state.model, tmp_path / "same.npz")
    return Requests(session.state, lambda client: True, lambda: None, tmp_path, None, 0)


def wait_for(condition: Callable[[], object], what: str, seconds: float = 60.0) -> None:
    give_up = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < give_up, f"waited {seconds:g} s for {what}"
        time.sleep(0.001)


def refusal_of(requests: Requests, client: str, action: str, request: dict[str, Any]) -> str:
    with pytest.raises(Refused) as refusal:
        requests.carry_out(client, action, request)
    return refusal.value.reason


def test_an_acquired_tool_has_its_home_where_its_frame_says(session: Any, requests: Requests) -> None:
    frame = {
        "rotation": [[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]],
        "scale": 2.0,
        "client_origin_m": [0.5, 0.0, 0.0],
        "model_origin_m": [0.01, 0.0, 0.002],
    }
    answer = requests.carry_out("first", "acquire", {"tools": ["tip", "tip1"], "frame": frame})
    assert answer["frame"]["scale"] == 2.0
    for name, granted in answer["tools"].items():
        contact = session.state.model.contacts[session.state.tool_index[name]]
        home = np.array(granted["home_m"]) - frame["client_origin_m"]
        in_model = frame["model_origin_m"] + 2.0 * np.array(frame["rotation"]) @ home
        np.testing.assert_allclose(in_model, contact.center_m, rtol=0, atol=1e-15)
        assert session.state.leases.settings[name].home_m == granted["home_m"]


def test_before_the_first_hold_a_tools_home_is_its_start(session: Any) -> None:
    for contact in session.state.model.contacts:
        assert session.state.leases.settings[contact.name].home_m == contact.center_m


def test_acquiring_gives_all_tools_or_leaves_all_as_they_were(session: Any, requests: Requests) -> None:
    state = session.state
    state.leases.holders["tip1"] = "first"
    before = dict(state.leases.holders), dict(state.leases.settings)
    session.stop()
    state.memory.ports["force_scale"][1] = 0.5  # of a force that no tick lets fade
    request = {"tools": ["tip", "tip1"], "frame": {"scale": 2.0}}
    assert refusal_of(requests, "first", "acquire", request) == "busy"
    assert (state.leases.holders, state.leases.settings) == before


def test_without_a_tick_a_change_is_refused_and_not_made_later_either(
    session: Any, requests: Requests, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(state_module, "CHANGE_TIMEOUT_S", 0.05)
    state = session.state
    state.leases.holders["tip"] = "first"
    session.stop()
    for action, request in (("limits", {"limits": {"max_force_n": 1.0}}), ("reset", {})):
        assert refusal_of(requests, "first", action, request) == "busy"
    assert state.leases.settings["tip"].limits.max_force_n == 10.0
    state.memory.ports["force_scale"] = 0.5
    now = time.monotonic_ns()
    scheduler.repeat_tick(state.image, now, now, False)
    assert state.memory.settings["max_force_n"][0] == 10.0
    assert np.all(state.memory.ports["force_scale"] > 0)  # a reset would have made it zero


def test_while_the_server_stops_changes_are_refused_at_once(session: Any, requests: Requests) -> None:
    session.state.leases.holders["tip"] = "first"
    session.state.stopping.set()
    started = time.monotonic()
    for _ in range(20):
        assert refusal_of(requests, "first", "limits", {"limits": {"max_force_n": 1.0}}) == "stopping"
    # Each of them would else wait for a tick.
    assert time.monotonic() - started < 20 * state_module.CHANGE_TIMEOUT_S


def test_while_a_model_is_loaded_nobody_acquires_and_the_other_way_round(
    session: Any, requests: Requests
) -> None:
    state = session.state
    state.leases.holders["tip"] = "first"
    answers: list[dict[str, Any]] = []
    loading = threading.Thread(
        target=lambda: answers.append(requests.carry_out("first", "load", {"file": "same.npz"}))
    )
    loading.start()
    wait_for(state.exchanging.locked, "the loading")
    reason = refusal_of(requests, "second", "acquire", {"tools": ["tip1"]})
    loading.join()
    assert reason == "busy"
    assert answers[0]["model"]["order"] == state.model.order
    assert requests.carry_out("second", "acquire", {"tools": ["tip1"]})
    assert refusal_of(requests, "first", "load", {"file": "same.npz"}) == "held"


def test_limits_are_answered_in_the_shape_of_acquire(session: Any, requests: Requests) -> None:
    acquired = requests.carry_out("first", "acquire", {"tools": ["tip"]})
    changed = requests.carry_out("first", "limits", {"limits": {"max_force_n": 1.0}})
    assert changed["tools"]["tip"]["limits"] == acquired["tools"]["tip"]["limits"] | {"max_force_n": 1.0}
    assert requests.carry_out("first", "release", {}) == {"tools": ["tip"]}


@pytest.mark.parametrize(
    ("request_", "reason"),
    [
        ({}, "missing_field"),
        ({"tools": None}, "wrong_type"),
        ({"tools": "tip"}, "wrong_type"),
        ({"tools": []}, "wrong_type"),
        ({"tools": [["tip"]]}, "wrong_type"),
        ({"tools": ["tip"] * 3000}, "wrong_shape"),
        ({"tools": ["nothing"]}, "unknown_tool"),
        ({"tools": ["tip"], "frame": {"scale": 2**64 - 1}}, "out_of_range"),
        ({"tools": ["tip"], "frame": {"origin_m": [0, 0, 0]}}, "wrong_type"),  # of schema version 1
        ({"tools": ["tip"], "device": "hammer"}, "unknown_device"),
        ({"tools": ["tip"], "round_trip_s": 2**64 - 1, "device": "omega"}, "out_of_range"),
        ({"tools": ["tip"], "frame": None, "device": None, "round_trip_s": None}, None),
    ],
)
def test_what_an_acquire_may_hold(requests: Requests, request_: dict[str, Any], reason: str | None) -> None:
    if reason is None:
        assert requests.carry_out("first", "acquire", request_)["tools"].keys() == {"tip"}
        return
    with pytest.raises((Refused, MalformedMessage)) as caught:
        requests.carry_out("first", "acquire", request_)
    assert caught.value.reason == reason  # type: ignore[attr-defined]
