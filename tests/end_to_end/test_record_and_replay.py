"""Recordings: complete after a signal, readable after a full disk, and repeatable bit for bit."""

from __future__ import annotations

import resource
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from mcap.reader import make_reader

from palpate.model import load_model
from palpate_server import replay


@pytest.fixture
def start_recorder() -> Iterator[Callable[..., subprocess.Popen[str]]]:
    processes: list[subprocess.Popen[str]] = []

    def start(out: Path, endpoint: str, largest_file: int | None = None) -> subprocess.Popen[str]:
        def limit() -> None:
            if largest_file is not None:
                signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
                resource.setrlimit(resource.RLIMIT_FSIZE, (largest_file, largest_file))

        options = (str(out), "--connect", endpoint, "--session", "test")
        process = subprocess.Popen(
            [sys.executable, "-m", "palpate_server.record", *options],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            preexec_fn=limit,
        )
        processes.append(process)
        assert process.stdout is not None
        assert process.stdout.readline().startswith("recording")
        time.sleep(0.5)  # until the server knows that it listens
        return process

    yield start
    for process in processes:
        process.kill()
        process.communicate()


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
        client = run_example("headless_client.py", served.endpoint, "--duration-s", "2")
        _, err = client.communicate(timeout=60)
        assert client.returncode == 0, err
        recorder.terminate()
        message, err = recorder.communicate(timeout=20)
        assert recorder.returncode == 0, err
        assert "messages in" in message

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
        result = replay.compare(session, model)
        assert result.difference is None
        if any(message["force_scale"][0] > 0 for message in session.forces[: max(0, result.ticks - 100)]):
            break
        served.stop()
    else:
        raise AssertionError("forces were lost before the first movement in every one of 5 recordings")

    changed = [dict(message) for message in session.forces]
    victim = next(i for i, m in enumerate(changed) if m["force_scale"][0] > 0)
    force = changed[victim]["force_n"][0]
    changed[victim]["force_n"] = [[force[0], force[1], force[2] + 1e-12]]
    session.forces = changed
    difference = replay.compare(session, model).difference
    assert difference is not None
    assert f"tick {changed[victim]['tick']}: force_n" in difference


def test_a_full_disk_ends_the_recording_not_the_server_and_what_was_written_is_readable(
    serve: Callable[..., Any], connect: Callable[..., Any], start_recorder: Callable[..., Any], tmp_path: Path
) -> None:
    served = serve()
    out = tmp_path / "full.mcap"
    recorder = start_recorder(out, served.endpoint, largest_file=100_000)
    _, err = recorder.communicate(timeout=60)
    assert recorder.returncode == 1
    assert "it ends here" in err
    assert "Traceback" not in err
    session = replay.read_session(out)
    assert len(session.forces) > 100
    with connect(served.endpoint) as client:
        assert client.query("describe")[0]
        ticks = client.statuses[-1]["ticks"]
        assert client.next_status()["ticks"] > ticks


def test_what_is_no_recording_or_not_of_this_model_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "no.mcap"
    path.write_bytes(b"nothing of the kind")
    with pytest.raises(replay.ReplayError, match=r"no\.mcap"):
        replay.read_session(path)
    with pytest.raises(replay.ReplayError, match=r"missing\.mcap"):
        replay.read_session(tmp_path / "missing.mcap")
