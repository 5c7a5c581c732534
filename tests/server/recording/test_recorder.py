"""Recordings that the server makes of itself: complete and in order, and over, with a reason, when the disk is full."""

from __future__ import annotations

import resource
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader

from palpate_client.wire import Keys
from palpate_server.errors import Refused
from palpate_server.realtime.records import RECORDS
from palpate_server.recording import recorder, replay
from palpate_server.recording.recorder import Recorder

Loop = Any


def wait_for(condition: Callable[[], Any]) -> None:
    give_up = time.monotonic() + 120.0
    while not condition():
        assert time.monotonic() < give_up
        time.sleep(0.02)


def run_until_an_error(loop: Loop) -> None:
    give_up = time.monotonic() + 120.0
    while loop.recorder.report()["error"] is None:
        assert time.monotonic() < give_up
        loop.run(100)
        time.sleep(0.01)


def message_count(path: Path) -> int:
    with path.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    assert summary.statistics is not None
    return summary.statistics.message_count


@pytest.mark.usefixtures("patiently")
def test_every_tick_is_in_the_file_and_the_report_counts_its_messages(loop: Loop, tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    loop.run(10)
    recording = loop.record(path)
    for _ in range(10):
        loop.run(100)
        loop.status()
        time.sleep(0.02)  # so that it is written in several portions
    recording.stop()
    # A description, the state at the beginning, ten statuses and the ticks.
    report = {"file": "a.mcap", "messages": 1012, "missing_ticks": 0, "error": None}
    assert recording.report() == report
    assert message_count(path) == 1012
    recorded = replay.read_recording(path)
    np.testing.assert_array_equal(recorded.ticks["tick"], np.arange(10, 1010))
    assert recorded.ports.tobytes() == loop.memory.ring.ports[10:1010].tobytes()
    assert list(recorded.settings) == [10]


@pytest.mark.usefixtures("patiently")
def test_what_is_recorded_is_soon_in_the_file(loop: Loop, tmp_path: Path) -> None:
    """A crash of the machine would lose the rest."""
    recording = loop.record(tmp_path / "a.mcap")
    loop.run(500)
    wait_for(lambda: recording.report()["messages"] > 100)
    assert len(replay.read_recording(tmp_path / "a.mcap").ticks) > 100
    recording.stop()


@pytest.mark.usefixtures("patiently")
def test_ticks_that_were_overwritten_before_they_were_taken_are_counted_and_a_new_state_follows(
    loop: Loop, tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(recorder, "PERIOD_S", 1e6)  # it looks once, at the end
    recording = loop.record(tmp_path / "a.mcap")
    recording.collect()  # the first state
    loop.run(RECORDS + 99)
    recording.collect()
    loop.run(10)
    recording.stop()
    # One more than the 99: the oldest row is the one that the next tick writes to.
    assert recording.report()["missing_ticks"] == 100
    assert "100 ticks" in caplog.text
    recorded = replay.read_recording(tmp_path / "a.mcap")
    assert recorded.ticks["tick"].tolist() == list(range(100, RECORDS + 109))
    assert list(recorded.settings) == [RECORDS + 99]


@pytest.fixture
def small_files() -> Iterator[Callable[[int], None]]:
    """Limits the size of files of the processes that are started from now on: to them, the disk is full."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    yield lambda size: resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    resource.setrlimit(resource.RLIMIT_FSIZE, before)


@pytest.mark.usefixtures("patiently")
def test_a_full_disk_ends_the_recording_and_the_report_counts_what_is_in_the_file(
    loop: Loop, tmp_path: Path, caplog: pytest.LogCaptureFixture, small_files: Callable[[int], None]
) -> None:
    path = tmp_path / "a.mcap"
    small_files(200_000)
    recording = loop.record(path)
    run_until_an_error(loop)
    assert recording.report()["error"] == "File too large"
    assert "a.mcap has ended: File too large" in caplog.text
    loop.run(10)  # the server goes on
    recording.stop()
    assert path.stat().st_size <= 200_000
    recorded = replay.read_recording(path)
    assert recording.report()["messages"] == len(recorded.ticks) + len(recorded.settings) + 1
    assert len(recorded.ticks) > 300
    assert replay.compare(recorded, [loop.model]).difference is None


@pytest.mark.usefixtures("patiently")
def test_a_recording_ends_complete_where_its_folder_is_full(loop: Loop, tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    recording = loop.record(path, 600_000)
    run_until_an_error(loop)
    recording.stop()
    assert "has reached its size limit" in str(recording.report()["error"])
    assert path.stat().st_size <= 600_000
    assert message_count(path) == recording.report()["messages"]


def test_a_folder_that_is_full_takes_no_more_recordings(tmp_path: Path) -> None:
    (tmp_path / "old.mcap").write_bytes(bytes(10))
    assert recorder.room_in(tmp_path, 2 * recorder.LEAST_BYTES) == 2 * recorder.LEAST_BYTES - 10
    with pytest.raises(Refused, match="remove old recordings") as refusal:
        recorder.room_in(tmp_path, recorder.LEAST_BYTES)
    assert refusal.value.reason == "full"


def fake_process(monkeypatch: pytest.MonkeyPatch, folder: Path, line: str) -> None:
    script = folder / "script"
    script.write_text(f"#!/bin/sh\n{line}\n")
    script.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(script))


def test_a_process_that_no_longer_takes_anything_ends_the_recording_and_nobody_waits_for_it(
    loop: Loop, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(recorder, "MAX_UNWRITTEN_BYTES", 100_000)
    fake_process(monkeypatch, tmp_path, "exec sleep 30")
    recording = loop.record(tmp_path / "a.mcap")
    run_until_an_error(loop)
    assert recording.report()["error"] == "it can't be written as fast as it comes"


def test_what_is_not_taken_in_time_at_the_end_is_an_error(
    loop: Loop, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(recorder, "END_S", 0.3)
    fake_process(monkeypatch, tmp_path, "exec sleep 30")
    recording = loop.record(tmp_path / "a.mcap")
    loop.run(1000)
    recording.stop()
    assert recording.report()["error"] == "it can't be written as fast as it comes"


def test_a_process_that_dies_is_named_with_how_it_ended(
    loop: Loop, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fake_process(monkeypatch, tmp_path, "exit 3")
    recording = loop.record(tmp_path / "a.mcap")
    run_until_an_error(loop)
    recording.stop()
    assert recording.report()["error"] == "its process ended with code 3"
    assert recording.report()["messages"] == 0


def test_an_existing_file_is_left_alone(loop: Loop, tmp_path: Path) -> None:
    def refusal_of(path: Path) -> Refused:
        with pytest.raises(Refused) as refusal:
            Recorder(path, 10**9, Keys("test"), {}, loop.memory, lambda: None)
        return refusal.value

    (tmp_path / "a.mcap").write_text("kept")
    refused = refusal_of(tmp_path / "a.mcap")
    assert (refused.reason, str(refused)) == ("exists", "a.mcap exists: expected the name of a new file")
    assert (tmp_path / "a.mcap").read_text() == "kept"
    (tmp_path / "link.mcap").symlink_to(tmp_path / "elsewhere")
    assert refusal_of(tmp_path / "link.mcap").reason == "exists"  # a link that leads nowhere is not followed
    assert not (tmp_path / "elsewhere").exists()
    assert refusal_of(tmp_path / "missing" / "a.mcap").reason == "bad_file"


@pytest.mark.parametrize(
    "name",
    [
        *(
            None,
            7,
            ["a.mcap"],
            "",
            ".",
            "..",
            ".mcap",
            ".mcap/..",
            "a",
            "a.mcap/",
            "/tmp/a.mcap",
            "../a.mcap",
        ),
        *("b/a.mcap", "a\0.mcap", "ä" * 126 + ".mcap", "a" * 10_000 + ".mcap"),
        *("a\n.mcap", "\x1b[2J.mcap", "a\u202e.mcap", "a\u2066.mcap", "a\x7f.mcap", "a\udc80.mcap"),
    ],
)
def test_what_is_no_plain_printable_name_is_refused(name: object, tmp_path: Path) -> None:
    with pytest.raises(Refused) as refusal:
        recorder.file_in(tmp_path, name)
    assert refusal.value.reason == "bad_file"
    assert len(str(refusal.value)) < 1000
    assert str(refusal.value).isprintable()


def test_a_plain_file_name_is_one_in_the_folder(tmp_path: Path) -> None:
    for name in ("a.mcap", "a b.mcap", "ä" * 125 + ".mcap"):
        assert recorder.file_in(tmp_path, name) == tmp_path / name
