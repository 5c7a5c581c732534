"""Recordings of a running server: complete after a signal, readable after a full disk, repeatable bit for bit."""

from __future__ import annotations

import math
import resource
import signal
import subprocess
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.exceptions import McapError
from mcap.reader import make_reader

from palpate.model_file import ReducedModel, save_model
from palpate_client.wire import RECORDER
from palpate_server.recording import replay


def limit_files(process: subprocess.Popen[bytes], largest: int | None = None) -> None:
    """Let a process write no file beyond this, bytes: to it, the disk is full. None: as far as the system allows."""
    _, most = resource.prlimit(process.pid, resource.RLIMIT_FSIZE)
    resource.prlimit(process.pid, resource.RLIMIT_FSIZE, (most if largest is None else largest, most))


def message_count(path: Path) -> int | None:
    """How many messages a file says that it holds; None without its end, which viewers seek by."""
    try:
        with path.open("rb") as stream:
            summary = make_reader(stream).get_summary()
    except McapError:
        return None
    return None if summary is None or summary.statistics is None else summary.statistics.message_count


def assert_all_is_repeated(path: Path, *models: ReducedModel) -> replay.Recorded:
    recorded = replay.read_recording(path)
    ticks = recorded.ticks["tick"]
    np.testing.assert_array_equal(ticks, np.arange(ticks[0], ticks[0] + len(ticks)))
    comparison = replay.compare(recorded, models)
    assert comparison.difference is None
    assert (comparison.ticks, comparison.of, comparison.stretches) == (len(ticks), len(ticks), 1)
    assert comparison.with_force > 0
    return recorded


def test_palpate_record_has_the_server_record_until_a_signal(
    serve: Callable[..., Any],
    start: Callable[..., Any],
    run_example: Callable[..., Any],
    tmp_path: Path,
) -> None:
    served = serve("--recordings", str(tmp_path / "new"))
    options = ("--connect", served.endpoint, "--session", "test")
    recorder = start("-m", "palpate_server.recording.record", "a.mcap", *options, ready="recording")
    code, _, err = run_example("palpate_client.poke", served.endpoint, "--duration-s", "1").finish()
    assert code == 0, err
    assert recorder.stop(signal.SIGINT) == 0
    path = tmp_path / "new" / "a.mcap"
    assert f"{message_count(path)} messages in a.mcap" in recorder.printed()
    recorded = assert_all_is_repeated(path, served.model)
    assert recorded.ports["force_scale"].max() == 1.0

    code, out, err = start(
        "-m", "palpate_server.recording.record", "b.mcap", *options, "--duration-s", "0.5"
    ).finish()
    assert code == 0, err
    assert "messages in b.mcap" in out

    recorder = start("-m", "palpate_server.recording.record", "c.mcap", *options, ready="recording")
    assert recorder.stop(signal.SIGHUP) == 0
    assert "messages in c.mcap" in recorder.printed()


def test_palpate_record_does_not_end_a_recording_of_somebody_else(
    serve: Callable[..., Any], start: Callable[..., Any], connect: Callable[..., Any], tmp_path: Path
) -> None:
    served = serve("--recordings", str(tmp_path))
    options = ("--connect", served.endpoint, "--session", "test")
    with connect(served.endpoint) as client:
        assert client.acquire("tip")[0]
        recorder = start("-m", "palpate_server.recording.record", "a.mcap", *options, ready="recording")
        client.next_status()
        client.next_status()
        assert client.control("record", file=None)[0]
        assert client.control("record", file="b.mcap")[0]
        code, _, err = recorder.finish()
        assert (code, "another client has ended the recording a.mcap" in err) == (2, True)
        granted, answer = client.control("record", file=None)
        assert granted
        assert (answer["recording"]["file"], answer["recording"]["error"]) == ("b.mcap", None)


def test_palpate_record_says_why_a_recording_ended_early(
    serve: Callable[..., Any], start: Callable[..., Any], tmp_path: Path
) -> None:
    served = serve("--recordings", str(tmp_path))
    limit_files(served.process, 200_000)  # the process that writes inherits it
    options = ("--connect", served.endpoint, "--session", "test")
    code, _, err = start("-m", "palpate_server.recording.record", "full.mcap", *options).finish()
    assert code == 1
    assert err.splitlines() == ["palpate record: full.mcap: File too large; it ends here"]


def test_whatever_a_client_has_changed_meanwhile_is_repeated_too(
    serve: Callable[..., Any],
    connect: Callable[..., Any],
    make_spring_mass_model: Callable[..., ReducedModel],
    tmp_path: Path,
) -> None:
    served = serve("--recordings", str(tmp_path))
    other = make_spring_mass_model(1, 22)
    save_model(other, tmp_path / "other.npz")
    frame = {
        "rotation": [[0, 1, 0], [-1, 0, 0], [0, 0, 1]],
        "scale": 0.5,
        "client_origin_m": [0.1, 0.2, 0.3],
    }

    def poke(client: Any, ticks: int, home: Sequence[float]) -> None:
        for i in range(ticks):
            client.command({"tip": [home[0] + 1e-3 * math.sin(0.5 * i), home[1], home[2] - 2e-3]})
            time.sleep(1e-3)

    with connect(served.endpoint) as client:
        client.next_status()
        assert client.acquire("tip")[0]
        poke(client, 100, (0, 0, 0))
        client.record("a.mcap")  # while the tissue moves
        poke(client, 300, (0, 0, 0))
        for speed in (0.05, 0.02, 0.01, 0.1, 0.03):
            assert client.control("limits", limits={"max_speed_m_per_s": speed})[0]
            poke(client, 10, (0, 0, 0))
        # Taken over in another frame and for a device while the tip is still on its way back.
        granted, answer = client.acquire("tip", frame=frame, device="touch")
        assert granted
        poke(client, 300, answer["tools"]["tip"]["home_m"])
        assert client.control("load", file="other.npz")[0]
        poke(client, 100, answer["tools"]["tip"]["home_m"])
        assert client.control("reset")[0]
        poke(client, 100, answer["tools"]["tip"]["home_m"])
        assert client.control("record", file=None)[1]["recording"]["error"] is None
    recorded = assert_all_is_repeated(tmp_path / "a.mcap", served.model, other)
    changes = [settings["change"] for settings in recorded.settings.values()]
    assert changes == ["save", *["limits"] * 5, "frame", "limits", "exchange", "exchange", "reset"]
    with_one = replay.compare(recorded, [served.model])
    assert with_one.difference is None
    assert 0 < with_one.ticks < len(recorded.ticks)
    assert with_one.missing_models


def test_recordings_are_refused_with_a_reason(
    serve: Callable[..., Any], connect: Callable[..., Any], tmp_path: Path
) -> None:
    def refusal(client: Any, **fields: Any) -> str:
        granted, answer = client.control("record", **fields)
        assert not granted
        return str(answer["reason"])

    served = serve("--recordings", str(tmp_path / "new"), "--max-recordings-gb", "0.003")
    with connect(served.endpoint) as client:
        for file in ("a.mcap", None):
            assert refusal(client, file=file) == "not_holder"
        assert client.acquire("tip")[0]
        client.record("a.mcap")
        assert refusal(client, file="b.mcap") == "busy"
        client.status_when(lambda status: status["recording"]["messages"] > 100, "some messages")
        granted, answer = client.control("record", file=None)
        assert granted
        assert answer["recording"]["error"] is None
        assert answer["recording"]["messages"] == message_count(tmp_path / "new" / "a.mcap")
        assert client.next_status()["recording"] is None
        assert refusal(client, file="a.mcap") == "exists"
        for name in ("../b.mcap", 1, "a\n.mcap", "\x1b[2J.mcap", "a\u202e.mcap"):
            assert refusal(client, file=name) == "bad_file"
        assert refusal(client) == "missing_field"
        assert refusal(client, file=None) == "not_recording"
        (tmp_path / "new" / "much").write_bytes(bytes(2_900_000))
        assert refusal(client, file="c.mcap") == "full"
    assert {file.name for file in (tmp_path / "new").iterdir()} == {"a.mcap", "much"}

    served = serve()
    with connect(served.endpoint) as client:
        for file in ("a.mcap", None):
            assert refusal(client, file=file) == "no_recordings"


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
    with connect(served.endpoint, name=RECORDER) as client:
        client.record("a.mcap")
        run_example("palpate_client.poke", served.endpoint, "--duration-s", "60")
        client.force_when(lambda force: force["force_scale"][0] == 1.0, "the force in full")
        told = client.next_status()["recording"]["messages"]
        client.status_when(lambda s: s["recording"]["messages"] > told + 500, "more in the file")
        code = served.stop(number)
    if number == signal.SIGTERM:
        assert code == 0
        assert message_count(path) is not None
    else:  # the process that writes finds the end of its pipe
        wait_for(lambda: message_count(path), "the end of the file", lambda count: count is not None)
    assert_all_is_repeated(path, served.model)


def test_a_full_disk_ends_a_recording_not_the_server(
    serve: Callable[..., Any], connect: Callable[..., Any], tmp_path: Path
) -> None:
    served = serve("--recordings", str(tmp_path))
    with connect(served.endpoint, name=RECORDER) as client:
        limit_files(served.process, 200_000)  # the process that writes inherits it
        assert client.control("record", file="full.mcap")[0]
        limit_files(served.process)
        ended = client.status_when(lambda status: status["recording"]["error"], "the end of the recording")
        assert ended["recording"]["error"] == "File too large"
        recorded = replay.read_recording(tmp_path / "full.mcap")
        assert len(recorded.ticks) > 300

        # A failed one is in nobody's way, and can be ended as well as replaced.
        client.record("next.mcap")
        client.status_when(lambda status: status["recording"]["messages"] > 500, "some messages")
        granted, answer = client.control("record", file=None)
        assert granted
        assert answer["recording"]["error"] is None
    assert message_count(tmp_path / "next.mcap") == answer["recording"]["messages"]
