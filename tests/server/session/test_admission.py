"""Which commands are carried out: those of the holder, as a whole, and never those that were checked for another hold."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from palpate_client.wire import pack
from palpate_server.session.admission import Admission
from palpate_server.session.requests import Requests


class Payload(bytes):
    """As much of a Zenoh payload as the server looks at."""

    def to_bytes(self) -> bytes:
        return bytes(self)


class Commander:
    """Sends commands of a client straight to an admission."""

    def __init__(self, admission: Admission) -> None:
        self._admission = admission
        self._sequence = 0

    def send(self, client: str, **position_m: list[float]) -> int:
        self._sequence += 1
        message = {
            "kind": "command",
            "sequence": self._sequence,
            "client_time_ns": 1,
            "position_m": position_m,
        }
        return self._admission.admit(
            f"palpate/test/command/{client}", Payload(pack(message)), time.monotonic_ns()
        )


@pytest.fixture
def commander(session: Any) -> Commander:
    return Commander(Admission(session.state))


@pytest.fixture
def requests(session: Any, tmp_path: Path) -> Requests:
    return Requests(session.state, lambda client: True, lambda: None, tmp_path, None, 0)


def depth_of_tip(state: Any, pressed: list[float]) -> list[float]:
    x, y, z = state.model.contacts[0].center_m
    return [x + pressed[0], y + pressed[1], z + pressed[2]]


def test_a_command_moves_the_tip_to_its_position(
    session: Any, commander: Commander, requests: Requests
) -> None:
    requests.carry_out("first", "acquire", {"tools": ["tip"]})
    goal = depth_of_tip(session.state, [0.0, 0.0, -1e-3])
    give_up = time.monotonic() + 60
    while not np.array_equal(session.state.memory.ports["applied_m"][0], goal):
        assert time.monotonic() < give_up
        commander.send("first", tip=goal)
        time.sleep(0.001)


def test_others_are_refused_and_counted(session: Any, commander: Commander, requests: Requests) -> None:
    requests.carry_out("first", "acquire", {"tools": ["tip"]})
    refused = session.state.messages.refused
    commander.send("second", tip=[0.0, 0.0, 0.0])
    commander.send("first", tip=[0.0, 0.0, 0.0], tip1=[0.0, 0.0, 0.0])  # as a whole
    commander.send("first", tip=[0.0, 0.0, 0.0], nothing=[0.0, 0.0, 0.0])
    commander.send("first", tip=[0.0, 0.0, float("nan")])
    commander.send("first", tip=[0.0, 0.0, 2000.0])
    assert session.state.messages.accepted == 0
    counted = {reason: count for reason, count in refused.items() if count}
    assert counted == {"not_holder": 2, "unknown_tool": 1, "not_finite": 1, "out_of_range": 1}
    session.state.running = False
    commander.send("first", tip=[0.0, 0.0, 0.0])
    assert refused["stopping"] == 1


def test_while_forces_fade_for_a_new_hold_no_command_is_used(
    session: Any, commander: Commander, requests: Requests
) -> None:
    state = session.state
    state.leases.holders |= {"tip": "first", "tip1": "first"}
    heard: list[int] = []

    class Watched(dict[str, Any]):
        """Holders that tell when all tools have been taken away for the fading."""

        def __ior__(self, other: Any) -> Any:
            result = super().__ior__(other)
            if not any(self.values()):
                commander.send("first", tip1=[0.0, 0.0, 0.0])
                heard.append(state.messages.refused["not_holder"])
            return result

    state.leases.holders = Watched(state.leases.holders)
    requests.carry_out("first", "acquire", {"tools": ["tip", "tip1"]})
    assert heard == [1]
    assert state.messages.accepted == 0


def test_a_command_that_was_checked_before_its_tool_changed_hands_is_not_carried_out(
    session: Any, commander: Commander, requests: Requests
) -> None:
    """The receiving thread can lose the processor between the check and the handing over."""
    state = session.state
    requests.carry_out("first", "acquire", {"tools": ["tip"]})

    class ChangingHands(dict[str, Any]):
        """Holders of which one changes right after it was looked at."""

        def __getitem__(self, name: str) -> Any:
            holder = super().__getitem__(name)
            if holder == "first":
                state.leases.holders = dict(self)
                requests.carry_out("first", "release", {})
                requests.carry_out("second", "acquire", {"tools": ["tip"]})
            return holder

    state.leases.holders = ChangingHands(state.leases.holders)
    at_home = state.memory.ports["applied_m"].copy()
    first_tick = state.memory.counters["ticks"][0]
    commander.send("first", tip=depth_of_tip(state, [0.0, 0.0, 0.02]))
    assert state.leases.holders["tip"] == "second"
    give_up = time.monotonic() + 60
    while state.memory.counters["ticks"][0] < first_tick + 20:  # ticks that could have used it
        assert time.monotonic() < give_up
        time.sleep(0.001)
    np.testing.assert_array_equal(state.memory.ports["applied_m"], at_home)
    commander.send("second", tip=depth_of_tip(state, [0.0, 0.0, 1e-3]))
    assert state.messages.accepted == 2  # the first one was, before its hold ended
