"""The contract, message by message. Everything happens in the time of the client's clock."""

from __future__ import annotations

import math
from typing import Any

import pytest

from palpate_client import Contract, Force
from palpate_client.messages import read_description
from palpate_client.wire import LEASE_MS, Flags

MS = 1_000_000
HOLD_NS, DECAY_NS = 20 * MS, 50 * MS
FADE_MS = (HOLD_NS + DECAY_NS) // MS
DESCRIPTION = read_description(
    {
        "tools": [{"name": "tip", "start_m": [0.0] * 3, "normal": [0.0, 0.0, 1.0], "radius_m": 0.01}],
        "limits": {"max_force_n": 1.0, "max_force_rate_n_per_s": 1000.0},
        "period_s": 1e-3,
        "hold_s": HOLD_NS * 1e-9,
        "decay_s": DECAY_NS * 1e-9,
        "model": {"config_sha256": "0"},
    }
)
GOOD = Force(
    tick=200,
    server_time_ns=0,
    sequence=98,
    client_time_ns=197 * MS,
    input_age_ns=2 * MS,
    flags=0,
    position_m=(0.0, 0.0, 0.0),
    force_n=(0.9, 0.0, 0.0),
    force_scale=1.0,
    energy_j=0.0,
    arrival_ns=200 * MS,
)


class Conversation:
    """A contract of a client that holds its tool, fed with commands and ticks of a server one millisecond away."""

    def __init__(self) -> None:
        self.contract = Contract(DESCRIPTION)
        self.contract.acquired(1.0)
        self.sent_ms: dict[int, int] = {}

    def send(self, at_ms: int) -> int:
        sequence = len(self.sent_ms) + 1
        self.sent_ms[sequence] = at_ms
        self.contract.on_sending(sequence, at_ms * MS)
        return sequence

    def tick(
        self,
        at_ms: int,
        newest: int,
        heard_ms: int | None = None,
        force_n: tuple[float, ...] = (0.0, 0.0, 0.0),
    ) -> bool:
        """The tick at a time, whose newest command is `newest` (-1: none), received at once or later; may it be rendered?"""
        age_ms = at_ms - self.sent_ms[newest] - 1 if newest >= 0 else -1
        flags = 0
        if not 0 <= age_ms * MS <= HOLD_NS:
            flags = int(Flags.STALE if newest < 0 or age_ms > FADE_MS else Flags.DECAYING)
        return self.contract.on_force(
            GOOD._replace(
                tick=at_ms,
                sequence=newest,
                client_time_ns=self.sent_ms[newest] * MS if newest >= 0 else -1,
                input_age_ns=age_ms * MS,
                flags=flags,
                force_n=force_n,
                arrival_ns=(at_ms if heard_ms is None else heard_ms) * MS,
            )
        )

    def go_well(self, from_ms: int, to_ms: int) -> int:
        """A command each millisecond, each answered two later; the newest command."""
        first = len(self.sent_ms) + 1
        for now in range(from_ms, to_ms):
            newest = self.send(now)
            if newest > 2:
                self.tick(now, max(newest - 2, first - 1))
        return newest


@pytest.mark.parametrize("force_n", [(math.nan, 0.0, 0.0), (0.0, math.inf, 0.0), (0.0, 0.8, 0.8)])
def test_a_force_that_is_not_finite_or_beyond_the_limit_is_not_to_be_rendered(
    force_n: tuple[float, ...],
) -> None:
    said = Conversation()
    newest = said.go_well(100, 200)
    assert said.tick(200, newest, force_n=(0.0, 0.6, 0.6))
    assert not said.tick(201, newest, force_n=force_n)
    assert "tick 201: the force" in said.contract.broken[0]
    assert said.tick(203, newest)
    assert not said.tick(202, newest)  # from before


@pytest.mark.parametrize(
    ("wrong", "said_of_it"),
    [
        ({"force_n": (1.01, 0.0, 0.0)}, "the limit 1.0 N"),
        ({"force_n": (math.nan, 0.0, 0.0)}, "is not finite"),
        ({"force_n": (-0.9, 0.0, 0.0)}, "jumped by 1.8"),
        ({"flags": int(Flags.STALE)}, "the input is stale"),
        ({"input_age_ns": HOLD_NS + 2 * MS}, "no flag says so"),
        ({"tick": 199}, "it came after tick 200"),
        ({"sequence": 90, "client_time_ns": 189 * MS}, "the tick before answered 98"),
        ({"sequence": 1000}, "we no longer hold the tool: it answers command 1000"),
        ({"client_time_ns": 77}, "we no longer hold the tool: it answers command 98"),
        ({"sequence": -1}, "we no longer hold the tool, our commands are forgotten"),
    ],
)
def test_a_force_that_breaks_the_contract_in_any_way_is_not_to_be_rendered_but_the_next_good_one_is(
    wrong: dict[str, Any], said_of_it: str
) -> None:
    said = Conversation()
    said.go_well(100, 200)
    assert said.contract.on_force(GOOD)
    assert not said.contract.on_force(GOOD._replace(**{"tick": 201, **wrong}))
    (broken,) = said.contract.broken
    assert said_of_it in broken
    assert said.contract.holding is ("no longer" not in broken)
    said.contract.acquired(1.0)
    assert said.contract.on_force(GOOD._replace(tick=202, force_n=(0.05, 0.0, 0.0)))
    assert len(said.contract.broken) == 1


def test_round_trips_are_measured_anew_and_answers_counted_on() -> None:
    said = Conversation()
    said.go_well(100, 200)
    said.contract.measure_anew()
    assert said.contract.round_trip_s(0.5) is None
    said.go_well(200, 250)
    assert said.contract.round_trip_s(0.5) == pytest.approx(2e-3)
    assert said.contract.commands_answered == 98 + 49


def test_a_client_whose_commands_are_forgotten_has_lost_its_tool() -> None:
    said = Conversation()
    said.go_well(100, 200)
    assert said.contract.holding
    assert not said.contract.broken
    said.tick(200, -1)
    said.tick(201, -1)
    assert not said.contract.holding
    (broken,) = said.contract.broken
    assert "tick 200: we no longer hold the tool" in broken


def test_forces_from_before_the_tool_was_acquired_again_may_come_after_the_answer_to_that() -> None:
    said = Conversation()
    newest = said.go_well(100, 200)
    answered = said.contract.commands_answered
    said.contract.released()
    said.contract.acquired(1.0)
    said.tick(200, newest)  # on its way since before
    said.tick(201, -1)  # by now the server has forgotten our commands
    assert said.contract.commands_answered == answered + 1
    first = said.send(202)
    said.tick(203, first)
    assert said.contract.holding
    assert not said.contract.broken
    said.tick(204, -1)
    assert not said.contract.holding


def test_before_the_first_answer_and_after_a_release_no_command_of_ours_is_known_rightly() -> None:
    said = Conversation()
    said.send(100)
    said.tick(100, -1)
    said.go_well(101, 200)
    said.contract.released()
    said.tick(200, -1)
    assert not said.contract.broken


def test_a_client_that_goes_on_sending_longer_than_a_link_may_be_silent_while_its_force_has_faded_is_not_heard() -> (
    None
):
    said = Conversation()
    newest = said.go_well(100, 200)
    for now in range(200, 300 + LEASE_MS):
        if now % 60 > 40:  # with pauses that let no force fade
            said.send(now)
        said.tick(now, newest)
    assert said.contract.holding  # perhaps: nobody has said otherwise
    (broken,) = said.contract.broken
    assert "went on sending" in broken


def test_commands_that_are_held_up_for_longer_than_a_force_takes_to_fade_break_no_promise() -> None:
    said = Conversation()
    newest = said.go_well(100, 200)
    for now in range(200, 400):
        said.send(now)
        said.tick(now, newest)
    said.go_well(400, 500)
    assert Flags.STALE.name in said.contract.summary()["flags"]
    assert not said.contract.broken


def test_a_client_that_was_silent_itself_finds_nothing_wrong_with_a_faded_force() -> None:
    said = Conversation()
    newest = said.go_well(100, 200)
    for now in range(200, 300 + LEASE_MS):  # it sends nothing, but receives
        said.tick(now, newest)
    said.go_well(300 + LEASE_MS, 400 + LEASE_MS)
    assert not said.contract.broken


@pytest.mark.parametrize("sent_first", [1, 2000])
def test_a_client_that_was_paused_finds_nothing_wrong_with_what_it_missed(sent_first: int) -> None:
    """What came during the pause is received afterwards, when commands have been sent again."""
    said = Conversation()
    newest = said.go_well(100, 200)
    for now in range(2000, 2000 + sent_first):
        said.send(now)
    for now in range(200, 2001):
        said.tick(now, newest, heard_ms=2000 + sent_first)
    assert not said.contract.broken
