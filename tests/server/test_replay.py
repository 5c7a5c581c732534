"""Replay: which ticks of a recording can be repeated, and that these are repeated bit for bit."""

from __future__ import annotations

import io
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest

from palpate.model import ReducedModel
from palpate_server import layout, loop, replay, wire
from palpate_server.frames import IDENTITY, Frame
from palpate_server.image import make_image
from palpate_server.recording import Recording
from palpate_server.safety import HOLD_NS, Flags, Limits

CEILING = Limits(10.0, 2000.0, 1.0, 0.1, 5.0)
SHIFTED = Frame(((0.0, -1.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, 1.0)), 2.0, (0.01, -0.02, 0.03))


class Recorded:
    """A loop without a clock or a network, and the recording of it, from tick 0 on; 100 ticks long until now, at rest."""

    def __init__(self, model: ReducedModel) -> None:
        self.model = model
        self.memory = layout.make_memory(model.discrete, model.period_s, [CEILING], 1.0)
        self.image = make_image(self.memory)
        self.encoder = wire.ForceEncoder(1)
        self.random = np.random.default_rng(1)
        self.sequence = 0
        self.undisturbed_since = 0
        self.terms: dict[str, Any] = {
            "limits": CEILING,
            "frame": IDENTITY,
            "since_tick": 0,
            "held_since_tick": 0,
        }
        self.told = {"config_sha256": model.config_sha256, "order": model.order, "name": model.name}
        self.session = replay.Session(
            {"contacts": [{"name": "tip"}], "limits": CEILING._asdict(), "model": self.told}
        )
        self.run(100)

    @property
    def tick(self) -> int:
        return int(self.memory.counters[layout.TICKS])

    @property
    def at_rest_since(self) -> int:
        return int(self.memory.counters[layout.AT_REST_SINCE])

    def run(self, ticks: int, commanded: bool = False, rendered_tick: int = -1, by_m: float = 1e-3) -> None:
        """Some ticks, each with a new command of its own to somewhere, or without."""
        for _ in range(ticks):
            now = (self.tick + 1) * 1_000_000
            if commanded:
                self.sequence += 1
                x, y, z = (
                    np.array(self.terms["frame"].origin_m) + self.random.normal(size=3) * by_m
                ).tolist()
                command = wire.Command(
                    self.sequence, now, {"tip": (x, y, z)}, {"tip": (0.01, 0.0, 0.0)}, rendered_tick
                )
                self.session.commands[self.sequence, now] = command
                loop.write_command(
                    self.memory.commands,
                    0,
                    self.sequence,
                    now,
                    now,
                    rendered_tick,
                    int(self.memory.commands.lease[0]),
                    (x, y, z),
                    (0.01, 0.0, 0.0),
                )
            loop.repeat_tick(self.image, now)
            row = (self.tick - 1) % layout.RECORDS
            payload = self.encoder.encode(
                self.tick - 1, now, self.memory.record_inputs[row], self.memory.record_motion[row]
            )
            self.session.forces.append(msgpack.unpackb(payload))
            if self.tick % 100 == 0:
                self.say_status()

    def come_to_rest(self) -> None:
        loop.forget_command(self.memory.commands, 0)
        self.run(1)
        for _ in range(200):
            self.run(100)
            if self.at_rest_since >= 0:
                self.say_status()
                return
        raise AssertionError("it does not come to rest")

    def agree(self, limits: Limits | None = None, frame: Frame | None = None) -> None:
        if limits is not None:
            loop.set_limits(self.image, 0, np.array(limits))
            loop.take_up_change(self.image)
            self.terms |= {"limits": limits, "since_tick": self.tick}
        if frame is not None:
            rotation, origin = np.array(frame.rotation), np.array(frame.origin_m)
            loop.set_frame(self.image, 0, rotation, frame.scale, origin)
            loop.take_up_change(self.image)
            self.terms |= {"frame": frame, "since_tick": self.tick, "held_since_tick": self.tick}

    def reset(self) -> None:
        loop.reset(self.image)
        loop.take_up_change(self.image)
        self.undisturbed_since = self.tick

    def say_status(self) -> None:
        told = {"limits": self.terms["limits"]._asdict(), "frame": asdict(self.terms["frame"])}
        self.session.statuses.append(
            {
                "ticks": self.tick,
                "at_rest_since_tick": self.at_rest_since,
                "undisturbed_since_tick": self.undisturbed_since,
                "model": self.told,
                "contacts": {"tip": self.terms | told},
            }
        )

    def only(self, first: int, last: int | None = None) -> replay.Session:
        """The recording as if it had been made of these ticks alone."""
        end = self.tick if last is None else last
        session = self.session
        return replay.Session(
            session.description,
            {key: command for key, command in session.commands.items() if key[1] > first * 1_000_000},
            [message for message in session.forces if first <= message["tick"] < end],
            [status for status in session.statuses if first <= status["ticks"] <= end],
        )


@pytest.fixture
def recorded(make_spring_mass_model: Callable[..., ReducedModel]) -> Recorded:
    return Recorded(make_spring_mass_model())


def test_a_recording_from_the_start_is_repeated_whole(recorded: Recorded) -> None:
    recorded.agree(Limits(2.0, 100.0, 0.3, 0.05, 1.0), SHIFTED)
    recorded.run(50)
    recorded.run(450, commanded=True)
    recorded.agree(Limits(1.0, 50.0, 0.1, 0.02, 0.0))
    recorded.run(500, commanded=True)
    flags = np.bitwise_or.reduce([message["flags"][0] for message in recorded.session.forces])
    assert flags & int(Flags.SPEED_LIMITED) and flags & int(Flags.SLEW_LIMITED)
    assert replay.compare(recorded.session, recorded.model) == replay.Comparison(1100, 1, None, 0)


def test_a_recording_that_begins_while_the_tissue_moves_is_repeated_from_the_first_known_rest_on(
    recorded: Recorded,
) -> None:
    recorded.agree(frame=SHIFTED)
    recorded.run(300, commanded=True)
    recorded.come_to_rest()
    rest = recorded.at_rest_since
    recorded.run(400 - recorded.tick % 100, commanded=True)
    session = recorded.only(150)
    told = min(s["ticks"] for s in session.statuses if s["at_rest_since_tick"] >= 0)
    assert rest <= told < recorded.tick - 300
    assert replay.compare(session, recorded.model) == replay.Comparison(recorded.tick - rest, 1, None, 0)


def test_a_recording_that_is_nowhere_at_rest_is_refused(recorded: Recorded) -> None:
    recorded.run(300, commanded=True)
    with pytest.raises(replay.ReplayError, match="never at rest in this recording: start it before"):
        replay.compare(recorded.only(150), recorded.model)


def test_after_a_lost_message_the_next_rest_begins_another_stretch(recorded: Recorded) -> None:
    recorded.run(300, commanded=True)
    recorded.come_to_rest()
    rest = recorded.at_rest_since
    recorded.run(400 - recorded.tick % 100, commanded=True)
    del recorded.session.forces[200]
    expected = replay.Comparison(200 + recorded.tick - rest, 2, None, 0)
    assert replay.compare(recorded.session, recorded.model) == expected

    last = recorded.session.forces[-1]
    last["force_n"] = [[force + 1e-15 for force in last["force_n"][0]]]
    difference = replay.compare(recorded.session, recorded.model).difference
    assert difference is not None
    assert f"tick {last['tick']}: force_n" in difference


def test_a_reset_breaks_it_off_until_the_next_rest(recorded: Recorded) -> None:
    recorded.run(250, commanded=True)
    recorded.reset()
    recorded.run(250, commanded=True)
    assert replay.compare(recorded.session, recorded.model) == replay.Comparison(350, 1, None, 0)
    recorded.come_to_rest()
    rest = recorded.at_rest_since
    recorded.run(400 - recorded.tick % 100, commanded=True)
    expected = replay.Comparison(350 + recorded.tick - rest, 2, None, 0)
    assert replay.compare(recorded.session, recorded.model) == expected


def test_the_ticks_of_another_model_are_left_out(recorded: Recorded) -> None:
    recorded.run(300, commanded=True)
    recorded.come_to_rest()
    recorded.undisturbed_since = changed = recorded.tick
    recorded.told = recorded.told | {"order": recorded.model.order + 2}
    recorded.run(1000, commanded=False)
    assert replay.compare(recorded.session, recorded.model) == replay.Comparison(changed, 1, None, 0)


def test_a_force_that_the_device_was_rendering_before_the_stretch_counts_in_its_energy(
    recorded: Recorded,
) -> None:
    recorded.run(300, commanded=True)
    pressed = recorded.tick - 1
    recorded.come_to_rest()
    while (
        recorded.tick - pressed > layout.RECORDS - 300
    ):  # so long ago that nobody could still be rendering it
        recorded.run(100, commanded=True)
        pressed = recorded.tick - 1
        recorded.reset()
        recorded.come_to_rest()
    recorded.run(300, commanded=True, rendered_tick=pressed)
    recorded.say_status()
    session = recorded.only(pressed - 100)
    result = replay.compare(session, recorded.model)
    assert result.difference is None
    assert result.stretches == 2
    assert result.ticks > 400


def test_what_was_not_told_any_more_is_not_repeated(recorded: Recorded) -> None:
    recorded.run(250, commanded=True)
    assert replay.compare(recorded.session, recorded.model).ticks == 300


def test_a_missing_command_is_counted_only_while_it_was_in_use(recorded: Recorded) -> None:
    recorded.run(300, commanded=True, by_m=1e-4)
    recorded.run(700)  # silence: its last command is known, and too old
    command = recorded.session.commands.pop((300, 400_000_000))
    assert command.sequence == recorded.session.forces[-1]["sequence"][0]
    expected = replay.Comparison(1100, 1, None, 1 + HOLD_NS // 1_000_000)
    assert replay.compare(recorded.session, recorded.model) == expected


def test_a_missing_command_that_met_a_limit_breaks_it_off(recorded: Recorded) -> None:
    recorded.run(300, commanded=True)
    limited = int(Flags.SPEED_LIMITED)
    victim = next(m for m in recorded.session.forces[200:] if m["flags"][0] & limited)
    del recorded.session.commands[victim["sequence"][0], victim["client_time_ns"][0]]
    assert replay.compare(recorded.session, recorded.model) == replay.Comparison(victim["tick"], 1, None, 0)


def test_another_model_is_refused(
    recorded: Recorded, make_spring_mass_model: Callable[..., ReducedModel]
) -> None:
    recorded.run(100)
    with pytest.raises(replay.ReplayError, match="another configuration"):
        replay.compare(recorded.session, make_spring_mass_model(1, 6))
    with pytest.raises(replay.ReplayError, match="another configuration"):
        replay.compare(recorded.session, make_spring_mass_model(2))


def test_a_recording_can_be_read_wherever_it_breaks_off(tmp_path: Path) -> None:
    stream = io.BytesIO()
    recording = Recording(stream)
    recording.add("describe", "palpate/test/describe", 0, wire.pack({"session": "test"}))
    encoder = wire.ForceEncoder(1)
    for tick in range(600):
        inputs, motion = np.full((1, 4), tick, np.int64), np.random.default_rng(tick).normal(size=(1, 8))
        recording.add("force", "palpate/test/force", tick, encoder.encode(tick, tick, inputs, motion))
    whole = stream.getvalue()  # all but what is still in the writer's hands: at least two chunks
    path = tmp_path / "cut.mcap"
    lengths = []
    half = len(whole) // 2
    for cut in (len(whole), *range(len(whole) - 40, len(whole)), *range(half, half + 40)):
        path.write_bytes(whole[:cut])
        lengths.append(len(replay.read_session(path).forces))
    assert lengths[0] > lengths[-1]
    assert min(lengths) > 0
