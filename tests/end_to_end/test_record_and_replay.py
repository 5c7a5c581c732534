"""Recordings, a client's and the server's own: complete after a signal, readable after a full disk, repeatable bit for bit."""

from __future__ import annotations

import math
import resource
import signal
import subprocess
import time
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.exceptions import McapError
from mcap.reader import make_reader

from palpate.model_file import ReducedModel, load_model, save_model
from palpate_server.recording import replay


@pytest.fixture
def start_recorder(start: Callable[..., Any]) -> Callable[..., Any]:
    def start_recorder(out: Path, endpoint: str) -> Any:
        options = ("--connect", endpoint, "--session", "test")
        return start("-m", "palpate_server.recording.record", out, *options, ready="recording")

    return start_recorder


def limit_files(process: subprocess.Popen[bytes], largest: int | None = None) -> None:
    """Let a process write no file beyond this, bytes: to it, the disk is full. None: as far as the system allows."""
    _, most = resource.prlimit(process.pid, resource.RLIMIT_FSIZE)
    resource.prlimit(process.pid, resource.RLIMIT_FSIZE, (most if largest is None else largest, most))


def test_a_recording_is_complete_after_sigterm_and_repeats_bit_for_bit(
    serve: Callable[..., Any],
    run_example: Callable[..., Any],
    start_recorder: Callable[..., Any],
    tmp_path: Path,
) -> None:
    for attempt in range(5):  # forces are best effort: on a busy machine one may be lost early on
        served = serve()
        out = tmp_path / f"{attempt}.mcap"
        recorder = start_recorder(out, served.endpoint)
        code, _, err = run_example("palpate_client.poke", served.endpoint, "--duration-s", "1").finish()
        assert code == 0, err
        assert recorder.stop() == 0
        assert "messages in" in recorder.printed()

        with out.open("rb") as stream:  # has its summary: what viewers seek by
            summary = make_reader(stream).get_summary()
        assert summary is not None
        topics = {
            channel.topic.rpartition("/test/")[2].split("/")[0] for channel in summary.channels.values()
        }
        assert topics == {"command", "describe", "force", "status"}
        assert {schema.encoding for schema in summary.schemas.values()} == {"jsonschema"}

        session = replay.read_session(out)
        model = load_model(tmp_path / "model1.npz")
        assert replay.compare(session, model).difference is None
        victim = next(message for message in session.forces if message["force_scale"][0] > 0)
        x, y, z = victim["force_n"][0]
        victim["force_n"] = [[x, y, z + 1e-12]]
        difference = replay.compare(session, model).difference
        if difference is not None:
            break
        served.stop()
    else:
        raise AssertionError("forces were lost just before the first movement in every one of 5 recordings")
    assert f"tick {victim['tick']}: force_n" in difference


def test_a_full_disk_ends_the_recording_not_the_server_and_what_was_written_is_readable(
    serve: Callable[..., Any], connect: Callable[..., Any], start_recorder: Callable[..., Any], tmp_path: Path
) -> None:
    served = serve()
    out = tmp_path / "full.mcap"
    recorder = start_recorder(out, served.endpoint)
    limit_files(recorder.process, 20_000)
    code, _, err = recorder.finish()
    assert code == 1
    assert err.splitlines() == [f"palpate record: {out}: File too large; it ends here"]
    session = replay.read_session(out)
    assert len(session.forces) > 100
    with connect(served.endpoint) as client:
        assert client.query("describe")[0]
        assert client.next_status()["ticks"] > session.forces[-1]["tick"]


def test_what_is_no_recording_or_not_of_this_model_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "no.mcap"
    with pytest.raises(replay.ReplayError, match=r"missing\.mcap"):
        replay.read_session(tmp_path / "missing.mcap")
    for content in (b"nothing of the kind", b"PK\x03\x04" + bytes(1000), b""):
        path.write_bytes(content)
        with pytest.raises(replay.ReplayError, match=r"no\.mcap: not an MCAP file"):
            replay.read_session(path)


# Recordings that the server makes of itself


def has_summary(path: Path) -> bool:
    """True when the file has its end: what viewers seek by."""
    try:
        with path.open("rb") as stream:
            return make_reader(stream).get_summary() is not None
    except McapError:
        return False


@cache
def ticks_told(path: Path, size: int) -> int:
    """Of how many ticks the statuses tell that are in a file until now, when it has this size."""
    try:
        return max((status["ticks"] for status in replay.read_session(path).statuses), default=0)
    except replay.ReplayError:  # nothing in it yet
        return 0


def is_at_rest(status: dict[str, Any]) -> bool:
    """For a tick at least: a status of the very tick tells of none that began at rest."""
    return bool(0 <= status["at_rest_since_tick"] < status["ticks"])


def assert_all_is_repeated(session: replay.Session, model: ReducedModel, heard: dict[str, Any]) -> None:
    """All ticks that a status tells of, which are those of a status that was heard meanwhile, and more."""
    ticks = [message["tick"] for message in session.forces]
    assert ticks == list(range(ticks[0], ticks[-1] + 1))
    assert session.statuses[-1]["ticks"] >= heard["ticks"] > ticks[0]
    told = sum(tick < session.statuses[-1]["ticks"] for tick in ticks)
    assert_is_repeated(session, model, range(ticks[0], ticks[0] + told), of=told)


def assert_is_repeated(session: replay.Session, model: ReducedModel, ticks: range, of: int) -> None:
    """These ticks and no others, each with the same force, and no command was missing."""
    with_force = sum(
        bool(np.any(message["force_n"])) for message in session.forces if message["tick"] in ticks
    )
    expected = replay.Comparison(len(ticks), of, with_force, 1, None, 0)
    assert replay.compare(session, model) == expected


def test_a_recording_that_a_client_asks_for_has_every_tick_and_command_and_repeats_bit_for_bit(
    serve: Callable[..., Any], connect: Callable[..., Any], run_example: Callable[..., Any], tmp_path: Path
) -> None:
    served = serve("--recordings", str(tmp_path / "new"))
    with connect(served.endpoint) as client:
        assert client.record("a.mcap") == {"file": "a.mcap"}
        assert client.control("record", {"file": "b.mcap"})[1]["reason"] == "busy"
        code, _, err = run_example("palpate_client.poke", served.endpoint, "--duration-s", "1").finish()
        assert code == 0, err
        heard = client.next_status()
        running = heard["recording"]
        assert running["file"] == "a.mcap"
        granted, report = client.control("record", {"file": None})
        assert granted, report
        assert report["messages"] > running["messages"] > 1000
        assert (report["missing_ticks"], report["error"]) == (0, None)
        assert client.next_status()["recording"] is None

        path = tmp_path / "new" / "a.mcap"
        assert has_summary(path)
        session = replay.read_session(path)
        assert max(message["force_scale"][0] for message in session.forces) == 1.0
        assert_all_is_repeated(session, served.model, heard)

        assert client.control("record", {"file": "a.mcap"})[1]["reason"] == "exists"
        assert client.control("record", {"file": "../b.mcap"})[1]["reason"] == "bad_file"
        assert client.control("record", {"file": 1})[1]["reason"] == "bad_file"
        assert client.control("record", {})[1]["reason"] == "missing_field"
        assert client.control("record", {"file": None})[1]["reason"] == "not_recording"
    assert [file.name for file in (tmp_path / "new").iterdir()] == ["a.mcap"]
    assert not (tmp_path / "b.mcap").exists()


def test_whatever_a_client_has_changed_meanwhile_is_repeated_too(
    serve: Callable[..., Any], connect: Callable[..., Any], tmp_path: Path
) -> None:
    served = serve("--recordings", str(tmp_path))
    frame = {"rotation": [[0, 1, 0], [-1, 0, 0], [0, 0, 1]], "scale": 0.5, "origin_m": [0.1, 0.2, 0.3]}

    def poke(client: Any, ticks: int, origin: Sequence[float]) -> None:
        for i in range(ticks):
            client.command({"tip": [origin[0] + 1e-3 * math.sin(0.5 * i), origin[1], origin[2] - 2e-3]})
            time.sleep(1e-3)

    with connect(served.endpoint) as client:
        client.next_status()
        client.record("a.mcap")
        assert client.acquire("tip")[0]
        poke(client, 300, (0, 0, 0))
        for speed in (0.05, 0.02, 0.01, 0.1, 0.03):  # sooner after one another than two usual statuses
            assert client.control("limits", {"limits": {"max_speed_m_per_s": speed}})[0]
            poke(client, 10, (0, 0, 0))
        # Taken over in another frame and for a device while the tip is still on its way back.
        assert client.control("acquire", {"contacts": ["tip"], "frame": frame, "device": "touch"})[0]
        poke(client, 300, frame["origin_m"])
        heard = client.next_status()
        assert client.control("record", {"file": None})[0]
    session = replay.read_session(tmp_path / "a.mcap")
    assert len({status["contacts"]["tip"]["since_tick"] for status in session.statuses}) >= 7
    assert_all_is_repeated(session, served.model, heard)


def test_a_change_of_model_ends_what_can_be_repeated_with_either_until_the_next_rest(
    serve: Callable[..., Any],
    connect: Callable[..., Any],
    make_spring_mass_model: Callable[..., ReducedModel],
    tmp_path: Path,
) -> None:
    served = serve("--recordings", str(tmp_path))
    other = make_spring_mass_model(1, 22)
    save_model(other, tmp_path / "other.npz")
    with connect(served.endpoint) as client:
        client.next_status()
        client.record("a.mcap")
        assert client.acquire("tip")[0]
        client.command({"tip": [0.0, 0.0, -1e-3]})
        client.next_status()
        assert client.control("load", {"model": "other.npz"})[0]
        rest = client.status_when(is_at_rest, "rest")["at_rest_since_tick"]
        client.command({"tip": [0.0, 0.0, -1e-3]})
        client.next_status()
        assert client.control("record", {"file": None})[0]
    session = replay.read_session(tmp_path / "a.mcap")
    first, changed = session.forces[0]["tick"], session.statuses[-1]["undisturbed_since_tick"]
    told = session.statuses[-1]["ticks"]
    assert_is_repeated(session, served.model, range(first, changed), of=told - first)
    assert session.statuses[-1]["model"]["order"] == other.order
    assert_is_repeated(session, other, range(rest, told), of=told - first)


def test_without_a_folder_for_recordings_nothing_is_recorded(
    serve: Callable[..., Any], connect: Callable[..., Any], tmp_path: Path
) -> None:
    served = serve()
    with connect(served.endpoint) as client:
        for file in ("a.mcap", None):
            granted, refusal = client.control("record", {"file": file})
            assert not granted
            assert refusal["reason"] == "no_recordings"
    assert not list(tmp_path.rglob("*.mcap"))


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL])
def test_a_server_that_ends_while_it_records_leaves_a_complete_file(
    serve: Callable[..., Any],
    connect: Callable[..., Any],
    run_example: Callable[..., Any],
    wait_for: Callable[..., Any],
    tmp_path: Path,
    number: signal.Signals,
) -> None:
    served = serve("--recordings", str(tmp_path))
    path = tmp_path / "a.mcap"
    with connect(served.endpoint) as client:
        client.record("a.mcap")
        run_example("palpate_client.poke", served.endpoint, "--duration-s", "60")
        client.force_when(lambda force: force["force_scale"][0] == 1.0, "the force in full")
        heard = client.next_status()
        wait_for(
            lambda: ticks_told(path, path.stat().st_size),
            "that status in the file",
            lambda ticks: ticks >= heard["ticks"],
        )
        code = served.stop(number)
    if number == signal.SIGTERM:
        assert code == 0
        assert has_summary(path)
    else:  # the process that writes finds the end of its pipe
        wait_for(lambda: has_summary(path), "the end of the file")
    session = replay.read_session(path)
    assert session.statuses[-1]["state"] == ("stopping" if number == signal.SIGTERM else "running")
    assert_all_is_repeated(session, served.model, heard)


def test_a_full_disk_ends_a_recording_that_a_client_asked_for_not_the_server(
    serve: Callable[..., Any], connect: Callable[..., Any], tmp_path: Path
) -> None:
    served = serve("--recordings", str(tmp_path))
    with connect(served.endpoint) as client:
        limit_files(served.process, 20_000)  # the process that writes inherits it
        assert client.control("record", {"file": "full.mcap"})[0]
        limit_files(served.process)
        ended = client.status_when(lambda status: status["recording"]["error"], "the end of the recording")
        assert ended["recording"]["error"] == "File too large"
        assert len(replay.read_session(tmp_path / "full.mcap").forces) > 100

        # A failed one is in nobody's way, and can be ended as well as replaced.
        client.record("next.mcap")
        client.status_when(lambda status: status["recording"]["messages"] > 500, "some messages")
        granted, report = client.control("record", {"file": None})
        assert granted
        assert report["error"] is None
    assert has_summary(tmp_path / "next.mcap")


def test_a_recording_that_begins_while_the_tissue_moves_is_repeated_from_rest_or_refused(
    serve: Callable[..., Any], connect: Callable[..., Any], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    served = serve("--recordings", str(tmp_path))
    moving, rested = tmp_path / "moving.mcap", tmp_path / "rested.mcap"

    def poke(client: Any, ticks: int, depth_m: float) -> None:
        for i in range(ticks):
            client.command({"tip": [0.0, 0.0, depth_m * math.sin(0.02 * i)]})
            time.sleep(1e-3)

    with connect(served.endpoint) as client:
        assert client.acquire("tip")[0]
        poke(client, 500, 1e-7)  # so little that the tissue soon comes to rest
        assert client.control("record", {"file": moving.name})[0]
        poke(client, 500, 1e-7)
        assert client.control("record", {"file": None})[0]
        assert client.control("record", {"file": rested.name})[0]
        poke(client, 200, 1e-7)
        rest = client.status_when(is_at_rest, "rest")["at_rest_since_tick"]
        poke(client, 500, 1e-3)
        assert client.control("record", {"file": None})[0]

    model = str(tmp_path / "model1.npz")
    assert replay.main([str(moving), model]) == 2
    assert "was never at rest in this recording" in capsys.readouterr().err
    session = replay.read_session(rested)
    first, told = session.forces[0]["tick"], session.statuses[-1]["ticks"]
    assert first < rest - 500
    assert_is_repeated(session, served.model, range(rest, told), of=told - first)
    assert replay.main([str(rested), model]) == 3  # what came before the rest could not be repeated
    assert "these forces are the same, bit for bit" in capsys.readouterr().out
