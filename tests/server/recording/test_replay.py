"""Replay: which ticks of a recording can be repeated, and that these are repeated bit for bit."""

from __future__ import annotations

import io
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest

from palpate.model_file import ReducedModel, save_model
from palpate_server import wire
from palpate_server.realtime import scheduler, shared_memory
from palpate_server.realtime.frames import IDENTITY, Frame
from palpate_server.realtime.native_image import make_image
from palpate_server.realtime.safety import HOLD_NS, Flags, Limits
from palpate_server.recording import replay
from palpate_server.recording.mcap_file import Recording

CEILING = Limits(10.0, 2000.0, 1.0, 0.1, 5.0)
OBSERVED = CEILING._replace(max_damping_n_s_per_m=0.0)  # no passivity control
SHIFTED = Frame(((0.0, -1.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, 1.0)), 2.0, (0.01, -0.02, 0.03))


class Recorded:
    """A loop without a clock or a network, and the recording of it, from tick 0 on; 100 ticks long until now, at rest."""

    def __init__(self, model: ReducedModel) -> None:
        self.model = model
        self.memory = shared_memory.make_memory(model.discrete, model.period_s, [CEILING], 1.0)
        self.image = make_image(self.memory)
        self.encoder = wire.ForceEncoder(1)
        self.random = np.random.default_rng(1)
        self.sequence = 0
        self.constant_time = False  # of the client
        self.undisturbed_since = 0
        self.statuses = 0
        self.terms: dict[str, Any] = {
            "limits": CEILING,
            "frame": IDENTITY,
            "since_tick": 0,
            "held_since_tick": 0,
            "holder": "surgeon",
        }
        self.told = {"config_sha256": model.config_sha256, "order": model.order, "name": model.name}
        self.session = replay.Session(
            {"contacts": [{"name": "tip"}], "limits": CEILING._asdict(), "model": self.told}
        )
        self.run(100)

    @property
    def tick(self) -> int:
        return int(self.memory.counters[shared_memory.TICKS])

    @property
    def at_rest_since(self) -> int:
        return int(self.memory.counters[shared_memory.AT_REST_SINCE])

    def run(
        self,
        ticks: int,
        commanded: bool = False,
        rendered_tick: int = -1,
        by_m: float = 1e-3,
        to_m: Sequence[float] | None = None,
    ) -> None:
        """Some ticks, each with a new command of its own to a place, or to somewhere, or without."""
        for _ in range(ticks):
            now = (self.tick + 1) * 1_000_000
            if commanded:
                self.sequence += 1
                away = self.random.normal(size=3) * by_m if to_m is None else np.array(to_m)
                x, y, z = (np.array(self.terms["frame"].origin_m) + away).tolist()
                client_time_ns = 0 if self.constant_time else now
                command = wire.Command(
                    self.sequence,
                    client_time_ns,
                    {"tip": (x, y, z)},
                    {"tip": (0.01, 0.0, 0.0)},
                    rendered_tick,
                )
                self.hear("surgeon", command)
                scheduler.write_command(
                    self.memory.commands,
                    0,
                    self.sequence,
                    client_time_ns,
                    now,
                    rendered_tick,
                    int(self.memory.commands.lease[0]),
                    (x, y, z),
                    (0.01, 0.0, 0.0),
                )
            scheduler.repeat_tick(self.image, now)
            row = (self.tick - 1) % shared_memory.RECORDS
            payload = self.encoder.encode(
                self.tick - 1, now, self.memory.record_inputs[row], self.memory.record_motion[row]
            )
            self.session.forces.append(msgpack.unpackb(payload))
            if self.tick % 100 == 0:
                self.say_status()

    def hear(self, client: str, command: wire.Command) -> None:
        """Have a command in the recording, whether it was accepted or not."""
        key = client, command.sequence, command.client_time_ns
        heard = replay.Heard(command, self.tick - 1)
        self.session.commands.setdefault(key, []).append(heard)

    def lose_command_of(self, message: dict[str, Any]) -> None:
        """Have the command that a tick used no more in the recording."""
        del self.session.commands["surgeon", message["sequence"][0], message["client_time_ns"][0]]

    def come_to_rest(self) -> None:
        scheduler.forget_command(self.memory.commands, 0)
        self.run(1)
        for _ in range(200):
            self.run(100)
            if self.at_rest_since >= 0:
                self.say_status()
                return
        raise AssertionError("it does not come to rest")

    def agree(self, limits: Limits | None = None, frame: Frame | None = None) -> None:
        if limits is not None:
            scheduler.set_limits(self.image, 0, np.array(limits))
            scheduler.take_up_change(self.image)
            self.terms |= {"limits": limits, "since_tick": self.tick}
        if frame is not None:
            rotation, origin = np.array(frame.rotation), np.array(frame.origin_m)
            scheduler.set_frame(self.image, 0, rotation, frame.scale, origin)
            scheduler.take_up_change(self.image)
            self.terms |= {"frame": frame, "since_tick": self.tick, "held_since_tick": self.tick}

    def reset(self) -> None:
        scheduler.reset(self.image)
        scheduler.take_up_change(self.image)
        self.undisturbed_since = self.tick

    def say_status(self) -> None:
        told = {"limits": self.terms["limits"]._asdict(), "frame": asdict(self.terms["frame"])}
        self.statuses += 1
        self.session.statuses.append(
            {
                "number": self.statuses,
                "ticks": self.tick,
                "at_rest_since_tick": self.at_rest_since,
                "undisturbed_since_tick": self.undisturbed_since,
                "model": self.told,
                "contacts": {"tip": self.terms | told},
            }
        )

    def write(self, recording: Recording) -> None:
        """The session as messages of an MCAP file."""
        session = self.session
        recording.add("describe", "palpate/test/describe", 0, wire.pack(session.description))
        behind: dict[int, list[tuple[str, wire.Command]]] = {}
        for (client, *_), all_heard in session.commands.items():
            for command, after_tick in all_heard:
                behind.setdefault(after_tick, []).append((client, command))
        for count, message in enumerate(session.forces):
            for client, command in behind.get(message["tick"] - 1, ()):
                content = command._asdict()
                if command.rendered_tick < 0:
                    del content["rendered_tick"]
                recording.add("command", f"palpate/test/command/{client}", count, wire.pack(content))
            recording.add("force", "palpate/test/force", count, wire.pack(message))
        for status in session.statuses:
            recording.add("status", "palpate/test/status", len(session.forces), wire.pack(status))
        recording.finish()

    def only(self, first: int, last: int | None = None) -> replay.Session:
        """The recording as if it had been made of these ticks alone."""
        end = self.tick if last is None else last
        session = self.session
        return replay.Session(
            session.description,
            {key: heard for key, heard in session.commands.items() if heard[0].after_tick >= first - 1},
            [message for message in session.forces if first <= message["tick"] < end],
            [status for status in session.statuses if first <= status["ticks"] <= end],
        )


def repeated(
    session: replay.Session, *stretches: range, of: int | None = None, lost: int = 0
) -> replay.Comparison:
    """Nothing but these ticks, of so many (or of no others), each with the same force."""
    ticks = [tick for stretch in stretches for tick in stretch]
    forces = {message["tick"]: message["force_n"][0] for message in session.forces}
    with_force = sum(any(forces[tick]) for tick in ticks)
    return replay.Comparison(len(ticks), of or len(ticks), with_force, len(stretches), None, lost)


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
    result = replay.compare(recorded.session, recorded.model)
    assert result == repeated(recorded.session, range(1100))
    assert result.with_force > 400


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
    expected = repeated(session, range(rest, recorded.tick), of=recorded.tick - 150)
    assert replay.compare(session, recorded.model) == expected


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
    expected = repeated(recorded.session, range(200), range(rest, recorded.tick), of=recorded.tick)
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
    expected = repeated(recorded.session, range(350), of=600)
    assert replay.compare(recorded.session, recorded.model) == expected
    recorded.come_to_rest()
    rest = recorded.at_rest_since
    recorded.run(400 - recorded.tick % 100, commanded=True)
    expected = repeated(recorded.session, range(350), range(rest, recorded.tick), of=recorded.tick)
    assert replay.compare(recorded.session, recorded.model) == expected


@pytest.mark.parametrize("lost", [0, 1])
def test_where_a_missing_status_may_have_told_of_other_limits_nothing_is_repeated(
    recorded: Recorded, lost: int
) -> None:
    tighter = [OBSERVED._replace(max_force_n=largest) for largest in (0.02, 0.01)]
    recorded.agree(OBSERVED)
    recorded.run(450, commanded=True)
    for limits in tighter:
        recorded.agree(limits)
        recorded.run(30, commanded=True)
        recorded.say_status()
    recorded.run(390, commanded=True)
    statuses = recorded.session.statuses
    if lost:
        (first_of_them,) = [status for status in statuses if status["ticks"] == 580]
        statuses.remove(first_of_them)
        expected = repeated(recorded.session, range(300), of=1000)
    else:
        expected = repeated(recorded.session, range(1000))
    assert replay.compare(recorded.session, recorded.model) == expected


def test_a_missing_status_with_nothing_new_breaks_nothing_off(recorded: Recorded) -> None:
    recorded.run(900, commanded=True)
    del recorded.session.statuses[3:6]
    assert replay.compare(recorded.session, recorded.model) == repeated(recorded.session, range(1000))


def test_a_reset_that_a_missing_status_told_of_may_not_have_been_the_only_one(recorded: Recorded) -> None:
    recorded.run(600, commanded=True)
    recorded.reset()
    recorded.run(50, commanded=True)
    recorded.say_status()
    recorded.reset()
    recorded.run(50, commanded=True)
    recorded.come_to_rest()
    rest = recorded.at_rest_since
    recorded.run(400 - recorded.tick % 100, commanded=True)
    told = [status["number"] for status in recorded.session.statuses if status["ticks"] == 750]
    recorded.session.statuses = [s for s in recorded.session.statuses if s["number"] not in told]
    expected = repeated(recorded.session, range(500), range(rest, recorded.tick), of=recorded.tick)
    assert replay.compare(recorded.session, recorded.model) == expected


def test_the_ticks_of_another_model_are_left_out(recorded: Recorded) -> None:
    recorded.run(300, commanded=True)
    recorded.come_to_rest()
    recorded.undisturbed_since = changed = recorded.tick
    recorded.told = recorded.told | {"order": recorded.model.order + 2}
    recorded.run(1000, commanded=False)
    recorded.say_status()
    expected = repeated(recorded.session, range(changed), of=recorded.tick)
    assert replay.compare(recorded.session, recorded.model) == expected


def test_a_force_that_the_device_was_rendering_before_the_stretch_counts_in_its_energy(
    recorded: Recorded,
) -> None:
    recorded.run(300, commanded=True)
    pressed = recorded.tick - 1
    recorded.come_to_rest()
    while (
        recorded.tick - pressed > shared_memory.RECORDS - 300
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
    assert replay.compare(recorded.session, recorded.model) == repeated(recorded.session, range(300))


def test_a_missing_command_is_counted_only_while_it_was_in_use(recorded: Recorded) -> None:
    recorded.agree(OBSERVED)
    recorded.run(300, commanded=True, by_m=1e-4)
    recorded.run(700)  # silence: its last command is known, and too old
    message = recorded.session.forces[-1]
    assert message["sequence"] == [300]
    recorded.lose_command_of(message)
    expected = repeated(recorded.session, range(1100), lost=1 + HOLD_NS // 1_000_000)
    assert replay.compare(recorded.session, recorded.model) == expected


def test_a_missing_command_that_met_a_limit_breaks_it_off(recorded: Recorded) -> None:
    recorded.agree(OBSERVED)
    recorded.run(300, commanded=True)
    limited = int(Flags.SPEED_LIMITED)
    victim = next(m for m in recorded.session.forces[200:] if m["flags"][0] & limited)
    recorded.lose_command_of(victim)
    expected = repeated(recorded.session, range(victim["tick"]), of=400)
    assert replay.compare(recorded.session, recorded.model) == expected


def give_out_energy(recorded: Recorded, ticks: int) -> None:
    """In and out, slowly enough for every limit, as if the device felt nothing on its way in, and then the largest force."""
    for i in range(ticks):
        depth = min(i % 40, 40 - i % 40)
        rendered_tick = 0 if i % 40 < 20 else recorded.tick - i % 40 + 20
        recorded.run(1, commanded=True, rendered_tick=rendered_tick, to_m=(0.0, 0.0, -1e-4 * depth))


def test_a_missing_command_breaks_it_off_where_the_force_goes_by_the_energy(recorded: Recorded) -> None:
    give_out_energy(recorded, 200)
    flags = [message["flags"][0] for message in recorded.session.forces]
    assert not np.bitwise_or.reduce(flags[150:]) & int(Flags.SPEED_LIMITED | Flags.WORKSPACE_CLAMPED)
    assert np.count_nonzero(np.array(flags[250:]) & int(Flags.PASSIVITY_LIMITED)) > 10
    for victim in recorded.session.forces[200:250:10]:
        kept = dict(recorded.session.commands)
        recorded.lose_command_of(victim)
        expected = repeated(recorded.session, range(victim["tick"]), of=300)
        assert replay.compare(recorded.session, recorded.model) == expected
        recorded.session.commands = kept


def test_after_a_missing_command_the_energy_is_known_to_a_passivity_control_that_comes_later(
    recorded: Recorded,
) -> None:
    recorded.agree(OBSERVED)
    give_out_energy(recorded, 200)
    recorded.agree(
        CEILING._replace(max_damping_n_s_per_m=1e4)
    )  # so much that the energy decides how much of it
    give_out_energy(recorded, 200)
    flags = [message["flags"][0] for message in recorded.session.forces[300:]]
    assert np.count_nonzero(np.array(flags) & int(Flags.PASSIVITY_LIMITED)) > 10
    for victim in recorded.session.forces[200:300:10]:
        recorded.lose_command_of(victim)
    assert replay.compare(recorded.session, recorded.model) == repeated(recorded.session, range(500), lost=10)


def test_a_rendered_force_that_is_not_recorded_breaks_it_off_where_the_force_goes_by_the_energy(
    recorded: Recorded,
) -> None:
    recorded.run(300, commanded=True)
    pressed = recorded.tick - 1
    recorded.reset()
    recorded.come_to_rest()
    rest = recorded.at_rest_since
    assert recorded.tick - pressed < shared_memory.RECORDS - 300
    recorded.run(300 - recorded.tick % 100, commanded=True)
    told = recorded.tick
    recorded.run(100, commanded=True, rendered_tick=pressed)
    session = recorded.only(pressed + 1)
    expected = repeated(session, range(rest, told), of=recorded.tick - pressed - 1)
    assert replay.compare(session, recorded.model) == expected


# Commands that could be mistaken for one another


def duplicate(recorded: Recorded, client: str, tick: int) -> None:
    """Have in the recording, right behind the command of a tick, one to elsewhere with its sequence and client time."""
    message = recorded.session.forces[tick]
    key = "surgeon", message["sequence"][0], message["client_time_ns"][0]
    command, after_tick = recorded.session.commands[key][0]
    elsewhere = replay.Heard(command._replace(displacement_m={"tip": (0.0, 0.0, 3e-3)}), after_tick)
    recorded.session.commands.setdefault((client, *key[1:]), []).append(elsewhere)


def test_a_refused_command_is_not_taken_for_the_one_that_a_tick_used(recorded: Recorded) -> None:
    recorded.run(400, commanded=True)
    duplicate(recorded, "somebody", 150)  # who holds nothing
    duplicate(recorded, "surgeon", 350)  # the same number again
    assert replay.compare(recorded.session, recorded.model) == repeated(recorded.session, range(500))


def test_what_somebody_else_sends_does_not_stand_in_for_a_missing_command(recorded: Recorded) -> None:
    recorded.run(400, commanded=True)
    duplicate(recorded, "somebody", 350)
    recorded.lose_command_of(recorded.session.forces[350])
    expected = repeated(recorded.session, range(350), of=500)
    assert replay.compare(recorded.session, recorded.model) == expected


def test_a_command_that_may_have_been_refused_before_the_hold_counts_as_missing(recorded: Recorded) -> None:
    recorded.agree(frame=IDENTITY)  # the hold begins here
    recorded.run(400, commanded=True)
    duplicate(recorded, "surgeon", 150)
    expected = repeated(recorded.session, range(150), of=500)
    assert replay.compare(recorded.session, recorded.model) == expected


def test_a_command_that_may_have_been_refused_for_another_contact_counts_as_missing(
    recorded: Recorded,
) -> None:
    recorded.run(400, commanded=True)
    heard = recorded.session.commands["surgeon", 251, 351_000_000]
    command, after_tick = heard[0]
    more = {"tip": (0.0, 0.0, 3e-3), "somebody's": wire.STILL}
    heard.insert(0, replay.Heard(command._replace(displacement_m=more), after_tick))
    expected = repeated(recorded.session, range(350), of=500)
    assert replay.compare(recorded.session, recorded.model) == expected


def test_a_client_that_begins_to_count_anew_in_its_next_hold_is_understood(recorded: Recorded) -> None:
    recorded.constant_time = True
    recorded.run(400, commanded=True)
    recorded.come_to_rest()
    recorded.agree(frame=SHIFTED)
    recorded.sequence = 0
    recorded.run(400 + 100 - recorded.tick % 100, commanded=True)
    heard = recorded.session.commands["surgeon", 400, 0]
    assert len(heard) == 2
    result = replay.compare(recorded.session, recorded.model)
    assert result == repeated(recorded.session, range(recorded.tick))


def test_whose_command_a_tick_used_is_not_known_when_no_status_tells(recorded: Recorded) -> None:
    recorded.agree(OBSERVED)
    recorded.terms["holder"] = None
    recorded.run(300, commanded=True, by_m=1e-4)
    for status in recorded.session.statuses:
        status["contacts"]["tip"]["holder"] = None
    assert replay.compare(recorded.session, recorded.model) == repeated(
        recorded.session, range(400), lost=300
    )


# What the command line says of it


def exit_code(recorded: Recorded, path: Path) -> int:
    """Of a replay of the session, written to a file and read again."""
    with (path / "a.mcap").open("wb") as stream:
        recorded.write(Recording(stream))
    save_model(recorded.model, path / "model.npz")
    return replay.main([str(path / "a.mcap"), str(path / "model.npz")])


def test_exit_code_0_is_for_a_recording_of_which_every_tick_was_repeated(
    recorded: Recorded, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    recorded.run(300, commanded=True)
    with_force = sum(any(message["force_n"][0]) for message in recorded.session.forces)
    assert exit_code(recorded, tmp_path) == 0
    said = f"400 of 400 ticks repeated, {with_force} with a force: every force is the same, bit for bit\n"
    assert capsys.readouterr().out == said


def test_a_command_that_was_refused_for_its_numbers_is_as_good_as_not_recorded(
    recorded: Recorded, tmp_path: Path
) -> None:
    recorded.run(400, commanded=True)
    heard = recorded.session.commands["surgeon", 251, 351_000_000]
    command, after_tick = heard[0]
    for number in (2000.0, float("nan")):
        refused = command._replace(displacement_m={"tip": (number, 0.0, 0.0)})
        heard.insert(0, replay.Heard(refused, after_tick))
    assert exit_code(recorded, tmp_path) == 0


def test_exit_code_3_is_for_a_recording_of_which_a_part_could_not_be_compared(
    recorded: Recorded, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    recorded.run(300, commanded=True, by_m=0.1)
    recorded.lose_command_of(recorded.session.forces[100])
    assert exit_code(recorded, tmp_path) == 3
    said = "100 of 400 ticks repeated, 0 with a force: these forces are the same, bit for bit; the others could not be"
    assert said in capsys.readouterr().out


def test_exit_code_1_is_for_a_recording_with_a_force_that_is_another(
    recorded: Recorded, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    recorded.run(300, commanded=True)
    recorded.session.forces[350]["force_n"][0][0] += 1e-12
    assert exit_code(recorded, tmp_path) == 1
    assert "tick 350: force_n was" in capsys.readouterr().out


def test_exit_code_2_is_for_a_recording_that_can_not_be_repeated_at_all(
    recorded: Recorded, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    recorded.run(300, commanded=True)
    recorded.session = recorded.only(100)
    assert exit_code(recorded, tmp_path) == 2
    assert "never at rest" in capsys.readouterr().err


def test_help_tells_the_exit_codes(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        replay.main(["--help"])
    told = capsys.readouterr().out
    for code in ("0:", "1:", "2:", "3:"):
        assert code in told


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
