"""Recordings that the server makes of itself: complete and in order, and over, with a reason, when the disk is full."""

from __future__ import annotations

import resource
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest
from mcap.reader import NonSeekingReader, make_reader

from palpate.model_file import ReducedModel
from palpate_server import wire
from palpate_server.realtime import scheduler, shared_memory
from palpate_server.realtime.native_image import make_image
from palpate_server.realtime.safety import Limits
from palpate_server.recording import recorder, replay
from palpate_server.recording.mcap_file import from_json
from palpate_server.recording.recorder import Recorder
from palpate_server.session.leases import Refused

KEYS = wire.Keys("test")
DESCRIPTION = {"session": "test", "period_s": 1e-3}


@pytest.fixture
def memory(make_spring_mass_model: Callable[..., ReducedModel]) -> shared_memory.Memory:
    model = make_spring_mass_model()
    return shared_memory.make_memory(
        model.discrete, model.period_s, [Limits(1.0, 1e9, 1e6, 1.0, 0.0)], 1 / 30
    )


def command(sequence: int) -> bytes:
    return msgpack.packb(
        {"sequence": sequence, "client_time_ns": 7, "displacement_m": {"tip": [0.0, 0.0, 1e-4]}}
    )


def run(recording: Recorder, memory: shared_memory.Memory, ticks: int) -> None:
    """Ticks with a command before each, as fast as they come."""
    image = make_image(memory)
    for _ in range(ticks):
        tick = int(memory.counters[shared_memory.TICKS])
        recording.command(KEYS.command("c"), command(tick))
        now = time.monotonic_ns()
        scheduler.write_command(memory.commands, 0, tick, 7, now, -1, 0, (0.0, 0.0, 1e-4), (0.0, 0.0, 0.0))
        scheduler.repeat_tick(image, now)


def run_until_an_error(recording: Recorder, memory: shared_memory.Memory) -> None:
    give_up = time.monotonic() + 60.0
    while recording.report()["error"] is None:
        assert time.monotonic() < give_up
        run(recording, memory, 100)
        time.sleep(0.01)


@pytest.fixture
def patiently(monkeypatch: pytest.MonkeyPatch) -> None:
    """At the end of a recording the process that writes may still be starting, on a busy machine."""
    monkeypatch.setattr(recorder, "_END_S", 60.0)


def messages(path: Path) -> list[tuple[str, int, dict[str, Any]]]:
    with path.open("rb") as stream:
        return [
            (kind, message.log_time, from_json(kind, message.data))
            for schema, _, message in NonSeekingReader(stream).iter_messages(log_time_order=False)
            if schema is not None and (kind := schema.name.removeprefix("palpate."))
        ]


@pytest.mark.usefixtures("patiently")
def test_commands_and_ticks_are_all_in_the_file_each_command_before_its_tick(
    memory: shared_memory.Memory, tmp_path: Path
) -> None:
    path = tmp_path / "a.mcap"
    began_ns = time.time_ns()
    recording = Recorder(path, KEYS, DESCRIPTION, memory)
    for _ in range(10):
        run(recording, memory, 100)
        recording.status(wire.pack({"state": "running", "ticks": int(memory.counters[shared_memory.TICKS])}))
        time.sleep(0.02)  # so that it is written in several portions
    recording.stop()
    assert recording.report() == {"file": "a.mcap", "messages": 2011, "missing_ticks": 0, "error": None}

    with path.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    assert summary.statistics is not None
    assert summary.statistics.message_count == 2011
    written = messages(path)
    assert [kind for kind, _, _ in written].count("status") == 10
    assert written[0][0] == "describe"
    times = [time_ns for _, time_ns, _ in written]
    assert times == sorted(times)
    assert began_ns - 10**9 < times[0] <= times[-1] < time.time_ns() + 10**9
    order = [
        (kind, message["sequence"])
        for kind, _, message in written
        if kind in ("command", "force") and (kind == "command" or message["sequence"][0] >= 0)
    ]
    assert order == [step for i in range(1000) for step in (("command", i), ("force", [i]))]
    ticks = {m["tick"]: m for kind, _, m in written if kind == "force"}
    assert list(ticks) == list(range(1000))
    for tick in (0, 500, 999):
        np.testing.assert_array_equal(ticks[tick]["force_n"], memory.record_motion[tick, :, 3:6])


@pytest.mark.usefixtures("patiently")
def test_what_is_recorded_is_soon_in_the_file(memory: shared_memory.Memory, tmp_path: Path) -> None:
    """A crash of the machine would lose the rest."""

    def forces() -> int:
        try:
            return len(replay.read_session(tmp_path / "a.mcap").forces)
        except replay.ReplayError:  # nothing yet
            return 0

    recording = Recorder(tmp_path / "a.mcap", KEYS, DESCRIPTION, memory)
    run(recording, memory, 300)
    give_up = time.monotonic() + 60.0
    while forces() < 100:
        assert time.monotonic() < give_up
        time.sleep(0.05)
    recording.stop()


@pytest.mark.usefixtures("patiently")
def test_ticks_that_were_overwritten_before_they_were_taken_are_counted(
    memory: shared_memory.Memory,
    tmp_path: Path,
    caplog: pytest.LogCaptureFixture,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(recorder, "_PERIOD_S", 60.0)  # it looks once, at the end
    recording = Recorder(tmp_path / "a.mcap", KEYS, DESCRIPTION, memory)
    run(recording, memory, shared_memory.RECORDS + 99)
    recording.stop()
    # One more than the 99: the oldest row is the one that the next tick writes to.
    assert recording.report()["missing_ticks"] == 100
    assert "100 ticks" in caplog.text
    ticks = [m["tick"] for kind, _, m in messages(tmp_path / "a.mcap") if kind == "force"]
    assert ticks == list(range(100, shared_memory.RECORDS + 99))


@pytest.mark.usefixtures("patiently")
def test_a_full_disk_ends_the_recording_with_its_reason_and_what_was_written_is_readable(
    memory: shared_memory.Memory, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "a.mcap"
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (200_000, before[1]))  # the process inherits it
        recording = Recorder(path, KEYS, DESCRIPTION, memory)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    run_until_an_error(recording, memory)
    assert recording.report()["error"] == "File too large"
    assert "a.mcap has ended: File too large" in caplog.text
    counted = recording.messages
    run(recording, memory, 10)  # the server goes on
    recording.stop()
    assert recording.messages == counted
    assert path.stat().st_size <= 200_000
    assert len(replay.read_session(path).forces) > 1000


def test_a_process_that_no_longer_takes_anything_ends_the_recording_and_nobody_waits_for_it(
    memory: shared_memory.Memory, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(recorder, "_MAX_UNWRITTEN", 100_000)
    monkeypatch.setattr(sys, "executable", str(_script(tmp_path, "exec sleep 30")))
    recording = Recorder(tmp_path / "a.mcap", KEYS, DESCRIPTION, memory)
    run_until_an_error(recording, memory)
    assert recording.report()["error"] == "it can't be written as fast as it comes"
    recording._process.kill()
    recording._process.wait()


def test_what_is_not_taken_in_time_at_the_end_is_an_error(
    memory: shared_memory.Memory, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(recorder, "_END_S", 0.3)
    monkeypatch.setattr(sys, "executable", str(_script(tmp_path, "exec sleep 30")))
    recording = Recorder(tmp_path / "a.mcap", KEYS, DESCRIPTION, memory)
    run(recording, memory, 1000)
    recording.stop()
    assert recording.report()["error"] == "it can't be written as fast as it comes"
    recording._process.kill()
    recording._process.wait()


def test_a_process_that_dies_is_named_with_how_it_ended(
    memory: shared_memory.Memory, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "executable", str(_script(tmp_path, "exit 3")))
    recording = Recorder(tmp_path / "a.mcap", KEYS, DESCRIPTION, memory)
    recording._process.wait()
    run(recording, memory, 10)
    recording.stop()
    assert recording.report()["error"] == "its process ended with code 3"


def _script(folder: Path, line: str) -> Path:
    script = folder / "script"
    script.write_text(f"#!/bin/sh\n{line}\n")
    script.chmod(0o755)
    return script


def test_an_existing_file_is_left_alone(memory: shared_memory.Memory, tmp_path: Path) -> None:
    (tmp_path / "a.mcap").write_text("kept")
    with pytest.raises(Refused, match=r"a\.mcap exists") as refusal:
        Recorder(tmp_path / "a.mcap", KEYS, DESCRIPTION, memory)
    assert refusal.value.reason == "exists"
    assert (tmp_path / "a.mcap").read_text() == "kept"
    (tmp_path / "link.mcap").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(Refused, match="exists"):  # a link that leads nowhere yet is not followed
        Recorder(tmp_path / "link.mcap", KEYS, DESCRIPTION, memory)
    assert not (tmp_path / "elsewhere").exists()
    with pytest.raises(Refused, match="No such file") as refusal:
        Recorder(tmp_path / "missing" / "a.mcap", KEYS, DESCRIPTION, memory)
    assert refusal.value.reason == "bad_file"


@pytest.mark.parametrize(
    "name",
    [
        *(None, 7, ["a.mcap"], "", ".", "..", ".mcap/..", "a", "a.mcap/", "/tmp/a.mcap", "../a.mcap"),
        *("b/a.mcap", "a\0.mcap", "ä" * 126 + ".mcap", "a" * 10_000 + ".mcap"),
    ],
)
def test_what_is_no_plain_file_name_is_refused(name: object, tmp_path: Path) -> None:
    with pytest.raises(Refused) as refusal:
        recorder.file_in(tmp_path, name)
    assert refusal.value.reason == "bad_file"
    assert len(str(refusal.value)) < 1000


def test_a_plain_file_name_is_one_in_the_folder(tmp_path: Path) -> None:
    for name in ("a.mcap", ".mcap", "a b.mcap", "ä" * 125 + ".mcap"):
        assert recorder.file_in(tmp_path, name) == tmp_path / name


def test_a_device_that_is_full_ends_the_process_with_one_line() -> None:
    forces = [msgpack.packb(("status", "k", i, msgpack.packb({"filler": i}))) for i in range(2000)]
    with Path("/dev/full").open("wb") as full:
        done = subprocess.run(
            [sys.executable, "-m", "palpate_server.recording.mcap_file"],
            input=b"".join(forces),
            stdout=full,
            stderr=subprocess.PIPE,
            timeout=60,
            check=False,
        )
    assert done.returncode == 1
    assert done.stderr.decode().splitlines() == ["No space left on device"]
