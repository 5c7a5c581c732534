"""A contact that is made one-sided: outside of the tissue nothing happens, and what was let go has to leave it first."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from palpate_client import OneSidedContact, Tool
from palpate_client.messages import Description, ToolDescription, Vector

HOLD_S = 0.02


class Hand:
    """A hand over a tool whose home is the client's origin and whose normal is z."""

    def __init__(self) -> None:
        self.tool: Any = SimpleNamespace(
            home_m=(0.0, 0.0, 0.0), normal=(0.0, 0.0, 1.0), silent_s=0.0, touches_anywhere=False
        )
        self.contact = OneSidedContact(self.tool, HOLD_S)

    def at(self, z: float, x: float = 0.0, silent_s: float = 0.0) -> tuple[list[float], bool]:
        self.tool.silent_s = silent_s
        return self.contact.tip((x, 0.0, z))


def test_outside_of_the_tissue_the_tip_is_left_at_its_home() -> None:
    assert Hand().at(0.01, x=0.3) == ([0.0, 0.0, 0.0], False)


def test_inside_the_tip_moves_as_the_hand_does_from_where_it_went_in() -> None:
    hand = Hand()
    hand.at(0.001, x=0.3)
    tip, touches = hand.at(-0.002, x=0.31)
    assert touches
    assert tip == pytest.approx([0.01, 0.0, -0.002])


@pytest.mark.parametrize("silent_s", [0.0, HOLD_S * 1.01])
def test_a_hand_that_begins_in_the_tissue_or_was_let_go_in_it_has_to_leave_it_first(silent_s: float) -> None:
    hand = Hand()
    if silent_s:
        hand.at(0.001)
        assert hand.at(-0.001)[1]
        assert not hand.at(-0.001, silent_s=silent_s)[1]
    assert not hand.at(-0.002)[1]
    assert not hand.at(0.001)[1]
    assert hand.at(-0.001)[1]


def test_a_hand_that_came_in_during_a_silence_has_to_leave_first() -> None:
    hand = Hand()
    hand.at(0.001)
    hand.at(0.001, silent_s=HOLD_S * 2)
    assert not hand.at(-0.001, silent_s=HOLD_S * 2)[1]
    assert not hand.at(-0.001)[1]


def test_a_surface_model_gets_the_hand_as_it_is_wherever_it_is() -> None:
    hand = Hand()
    hand.tool.touches_anywhere = True
    for z in (0.01, -0.002):
        assert hand.at(z, x=0.3) == ([0.3, 0.0, z], True)


class FakeConnection:
    """A connection whose server has loaded another model since it was opened."""

    tool_in_use = None

    def __init__(self, before: Description, now: Description) -> None:
        self.description, self._now = before, now
        self.acquired: list[dict[str, Any]] = []

    def describe(self) -> Description:
        self.description = self._now
        return self._now

    def control(self, action: str, **fields: Any) -> dict[str, Any]:
        if action == "acquire":
            self.acquired.append(fields)
        agreed = {"limits": {"max_force_n": 3.0}, "home_m": [0.0, 0.0, 0.005]}
        return {"tools": {"tip": agreed}, "warnings": []}

    def on_tool_force(self, name: str, receive: Any) -> Any:
        return SimpleNamespace(undeclare=lambda: None)

    def check(self) -> None:
        pass


def described(kind: str, normal: Vector) -> Description:
    tool = ToolDescription("tip", (0.0, 0.0, 0.005), normal, 0.005)
    return Description((tool,), 1e-3, 0.02, 0.05, 3.0, 600.0, kind, {"model": {"kind": kind}})


@pytest.mark.parametrize(("before", "now"), [("surface", "patch"), ("patch", "surface")])
def test_a_tool_is_of_the_model_that_runs_when_it_is_acquired(before: str, now: str) -> None:
    """A device on patches that is taken for one on a surface would be pulled into the tissue."""
    connection: Any = FakeConnection(described(before, (0.0, 0.0, 1.0)), described(now, (1.0, 0.0, 0.0)))
    with Tool(connection, "tip") as tool:
        assert tool.touches_anywhere == (now == "surface")
        assert tool.normal == (1.0, 0.0, 0.0)
        contact = OneSidedContact(tool, HOLD_S)
        assert contact.tip((0.3, 0.0, 0.005))[1] == (now == "surface")


def test_what_is_asked_for_of_a_tip_is_in_the_request() -> None:
    connection: Any = FakeConnection(*[described("surface", (0.0, 0.0, 1.0))] * 2)
    with Tool(connection, radius_m=0.004, friction=0.1, stiffness_n_per_m=50.0):
        (request,) = connection.acquired
    assert {"radius_m": 0.004, "friction": 0.1, "stiffness_n_per_m": 50.0}.items() <= request.items()
