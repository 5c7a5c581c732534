"""Replay: a recording repeats bit for bit whatever happened in it, and a damaged one is refused with one line."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from palpate.model_file import ReducedModel, save_model
from palpate_server.realtime import scheduler
from palpate_server.realtime.records import RECORDS
from palpate_server.recording import replay
from palpate_server.recording.replay import Comparison, Recorded

Loop = Any
ROTATION = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])


def finished(loop: Loop, path: Path) -> Recorded:
    loop.recorder.stop()
    assert loop.recorder.report()["error"] is None
    return replay.read_recording(path)


def everything(recorded: Recorded) -> Comparison:
    """What a comparison gives when all ticks are the same."""
    n = len(recorded.ticks)
    return Comparison(n, n, int(np.any(recorded.ports["force_n"], axis=(1, 2)).sum()), 1, None, ())


@pytest.fixture
def eventful(
    make_loop: Callable[..., Loop],
    make_spring_mass_model: Callable[..., ReducedModel],
    tmp_path: Path,
    patiently: None,
) -> tuple[Path, list[ReducedModel]]:
    """A recording of two tools that begins while the tissue moves, with every kind of change in it, and its models."""
    loop, other = make_loop(2), make_spring_mass_model(2, 7)
    models = [loop.model, other]
    path = tmp_path / "a.mcap"
    loop.run(300)
    loop.record(path)
    loop.run(100)
    loop.run(5, told=200)  # rendered before the recording began
    loop.change(scheduler.set_limits, 1, np.array([2.0, 500.0, 0.1, 0.01, 2.0]))
    loop.run(50, by_m=3e-3)
    scheduler.forget_command(loop.memory.commands, 0)
    loop.run(1, commanded=False)
    loop.change(scheduler.set_frame, 0, ROTATION, 0.5, np.array([0.1, 0.2, 0.3]))
    loop.run(50)
    loop.run(120, commanded=False)  # silence: held, then faded
    loop.run(50)
    loop.load(other)
    loop.run(50)
    loop.change(scheduler.reset)
    loop.run(50)
    loop.status()
    loop.recorder.stop()
    return path, models


def test_whatever_happened_is_repeated_from_the_first_tick_to_the_last(
    eventful: tuple[Path, list[ReducedModel]], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path, models = eventful
    recorded = replay.read_recording(path)
    assert [settings["change"] for settings in recorded.settings.values()] == [
        *("save", "limits", "frame", "exchange", "exchange", "reset")
    ]
    assert recorded.ticks["tick"][0] == 300
    assert np.any(recorded.ports["force_n"][:100])
    assert replay.compare(recorded, models) == everything(recorded)

    files = [tmp_path / "one.npz", tmp_path / "other.npz"]
    for model, file in zip(models, files, strict=True):
        save_model(model, file)
    assert replay.main([str(path), *map(str, files)]) == 0
    assert "every one is the same, bit for bit" in capsys.readouterr().out
    assert replay.main([str(path), str(files[0])]) == 3
    out = capsys.readouterr().out
    assert "the others could not be compared" in out
    assert "models that are needed too" in out
    assert replay.main([str(path), str(files[1])]) == 3


def test_a_bit_that_is_another_is_found_and_named(
    eventful: tuple[Path, list[ReducedModel]], capsys: pytest.CaptureFixture[str]
) -> None:
    path, models = eventful
    recorded = replay.read_recording(path)
    for name, index in (("force_n", (200, 1, 2)), ("position_m", (3, 0, 0)), ("energy_j", (150, 0))):
        changed = dataclasses.replace(recorded, ports=recorded.ports.copy())
        changed.ports[name][index] = np.nextafter(changed.ports[name][index], np.inf)
        difference = replay.compare(changed, models).difference
        assert difference is not None
        assert difference.startswith(f"tick {300 + index[0]}: {name} was")


@pytest.mark.usefixtures("patiently")
def test_missing_ticks_end_a_stretch_and_the_next_state_begins_another(loop: Loop, tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    loop.record(path)
    loop.run(200)
    loop.change(scheduler.save)
    loop.run(100)
    recorded = finished(loop, path)
    kept = np.delete(np.arange(300), 100)
    gap = Recorded(recorded.settings, recorded.ticks[kept], recorded.ports[kept])
    comparison = replay.compare(gap, [loop.model])
    assert (comparison.ticks, comparison.of, comparison.stretches) == (200, 300, 2)
    assert comparison.difference is None
    # Nor is a change repeated that the recording does not tell: here the file ended before it was written.
    untold = Recorded({0: recorded.settings[0]}, recorded.ticks, recorded.ports)
    assert replay.compare(untold, [loop.model]).ticks == 200


@pytest.mark.usefixtures("patiently")
def test_a_recording_longer_than_the_ring_repeats(loop: Loop, tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    recording = loop.record(path)
    for _ in range(3):
        loop.run(RECORDS // 2)
        recording.collect()  # in time, however busy the machine
    recorded = finished(loop, path)
    assert replay.compare(recorded, [loop.model]) == everything(recorded)


def test_models_that_the_recording_is_not_of_are_refused(
    eventful: tuple[Path, list[ReducedModel]], make_spring_mass_model: Callable[..., ReducedModel]
) -> None:
    with pytest.raises(replay.ReplayError, match="is of other models"):
        replay.compare(replay.read_recording(eventful[0]), [make_spring_mass_model(2, 3)])


@pytest.mark.parametrize(
    "content", [b"nothing of the kind", b"PK\x03\x04" + bytes(1000), b"", b"\x89MCAP0\r\n"]
)
def test_what_is_no_recording_is_refused(
    content: bytes, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "no.mcap").write_bytes(content)
    for name in ("no.mcap", "missing.mcap"):
        assert replay.main([str(tmp_path / name), "model.npz"]) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert name in line


def test_a_recording_can_be_read_wherever_it_breaks_off(eventful: tuple[Path, list[ReducedModel]]) -> None:
    path, models = eventful
    data = path.read_bytes()
    short = path.with_name("short.mcap")
    counts = []
    for size in np.linspace(len(data) // 4, len(data) - 1, 12).astype(int).tolist():
        short.write_bytes(data[:size])
        try:
            recorded = replay.read_recording(short)
        except replay.ReplayError as error:
            assert "holds no ticks" in str(error)
            continue
        assert replay.compare(recorded, models).difference is None
        counts.append(len(recorded.ticks))
    assert counts == sorted(counts)
    assert counts[-1] > 100


def test_no_damage_is_taken_for_a_difference_and_each_gives_one_line(
    eventful: tuple[Path, list[ReducedModel]], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A fuzzer: bits flipped, pieces cut out, doubled or zeroed, anywhere."""
    path, models = eventful
    files = [tmp_path / "one.npz", tmp_path / "other.npz"]
    for model, file in zip(models, files, strict=True):
        save_model(model, file)
    data = path.read_bytes()
    random = np.random.default_rng(7)
    damaged = tmp_path / "damaged.mcap"
    refused = 0
    for attempt in range(120):
        place, length = int(random.integers(len(data))), int(random.integers(1, 400))
        broken = bytearray(data)
        match attempt % 4:
            case 0:
                broken[place] ^= 1 << int(random.integers(8))
            case 1:
                del broken[place : place + length]
            case 2:
                broken[place:place] = broken[place : place + length]
            case 3:
                broken[place : place + length] = bytes(len(broken[place : place + length]))
        if broken == data:
            continue
        damaged.write_bytes(broken)
        code = replay.main([str(damaged), *map(str, files)])
        out, err = capsys.readouterr()
        if code == 2:
            refused += 1
            assert len(err.splitlines()) == 1
            assert err.startswith("palpate replay: ")
        else:  # what was damaged is nothing that a replay reads
            assert code == 0, (attempt, place, out, err)
    assert refused > 80


def test_a_pipe_is_refused_and_not_waited_for(tmp_path: Path) -> None:
    pipe = tmp_path / "pipe.mcap"
    os.mkfifo(pipe)
    with pytest.raises(replay.ReplayError, match=r"pipe\.mcap: not a plain file"):
        replay.read_recording(pipe)


def test_help_tells_the_exit_codes(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        replay.main(["--help"])
    text = " ".join(capsys.readouterr().out.split())
    assert "Exit code 0:" in text
    assert "2: the file is damaged" in text
