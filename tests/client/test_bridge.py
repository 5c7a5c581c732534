"""The order in which a bridge renders, reads and sends, with a device and a tool that note what is called."""

from __future__ import annotations

import itertools
import threading
from types import SimpleNamespace
from typing import Any

import pytest

from palpate_client import bridge
from palpate_client.messages import Vector

PERIOD_S = 1e-3


class Noted:
    """A device at rest, and a tool whose n-th command is answered by a force of n newtons, at once or never."""

    home_m, normal, silent_s, touches_anywhere = (0.0, 0.0, 0.0), (0.0, 0.0, 1.0), 0.0, True

    def __init__(self, *, reads_at_render: bool | None, answers: bool) -> None:
        self.calls: list[Any] = []
        self.waits_s: list[float] = []
        self._answers = answers
        self._sent = itertools.count(1)
        self._force_n = bridge.NO_FORCE
        if reads_at_render is not None:
            self.reads_at_render = reads_at_render

    def render(self, force_n: Vector) -> None:
        self.calls.append(("render", force_n[2]))

    def read(self) -> tuple[Vector, Vector]:
        self.calls.append("read")
        return (0.0, 0.0, -1e-3), (0.0, 0.0, 0.0)

    def take_force(self) -> Vector:
        return self._force_n

    def move(self, position_m: Any, velocity_m_per_s: Any) -> None:
        number = float(next(self._sent))
        self.calls.append("move")
        if self._answers:
            self._force_n = (0.0, 0.0, number)

    def wait_for_answer(self, timeout_s: float) -> bool:
        self.waits_s.append(timeout_s)
        return self._answers or threading.Event().wait(timeout_s)


def calls_of(noted: Noted, n_steps: int) -> list[Any]:
    device: Any = noted
    description: Any = SimpleNamespace(hold_s=0.02, period_s=PERIOD_S)
    bridge._drive(device, device, description, n_steps * PERIOD_S)
    return noted.calls


@pytest.mark.parametrize("reads_at_render", [None, False])
def test_a_force_is_rendered_at_the_step_after_its_command(reads_at_render: bool | None) -> None:
    calls = calls_of(Noted(reads_at_render=reads_at_render, answers=True), 3)
    step = ["read", "move"]
    # Whether the tip touches is not known before the first position.
    assert calls == [("render", 0), *step, ("render", 1), *step, ("render", 2), *step, ("render", 0)]


def test_where_a_state_is_that_of_the_last_force_each_force_is_rendered_as_soon_as_it_comes() -> None:
    noted = Noted(reads_at_render=True, answers=True)
    step = ["read", "move"]
    assert calls_of(noted, 3) == [
        ("render", 0), *step, ("render", 1), *step, ("render", 2), *step, ("render", 3), ("render", 0),
    ]  # fmt: skip


def test_without_an_answer_a_step_ends_in_time_and_the_next_ones_catch_up() -> None:
    noted = Noted(reads_at_render=True, answers=False)
    assert calls_of(noted, 20).count("move") == 20
    assert all(0 <= wait_s <= PERIOD_S for wait_s in noted.waits_s)
