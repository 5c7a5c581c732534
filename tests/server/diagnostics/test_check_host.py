"""The host check: its verdicts, its exit codes, and what it measures on this machine."""

from __future__ import annotations

import contextlib
import json
import os
import threading
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import zenoh

from palpate.model_file import SurfaceModel, save_model
from palpate_client import Connection
from palpate_client.wire import Keys
from palpate_server.diagnostics import check_host
from palpate_server.diagnostics.check_host import GOOD, MARGINAL, NOT_SUFFICIENT, Bounds, Finding
from palpate_server.diagnostics.round_trips import RoundTrips
from palpate_server.session import transport


def test_a_value_is_judged_by_its_bounds() -> None:
    bounds = Bounds(1.0, 2.0)
    assert [bounds.judge(v) for v in (0.0, 1.0, 1.5, 2.0, 2.1)] == [
        GOOD,
        GOOD,
        MARGINAL,
        MARGINAL,
        NOT_SUFFICIENT,
    ]


def test_the_worst_measurement_is_the_verdict() -> None:
    assert check_host.worst([GOOD, GOOD]) == GOOD
    assert check_host.worst([GOOD, MARGINAL, GOOD]) == MARGINAL
    assert check_host.worst([NOT_SUFFICIENT, MARGINAL]) == NOT_SUFFICIENT


def test_settings_alone_never_make_a_machine_insufficient() -> None:
    findings = check_host.settings()
    assert {finding.verdict for finding in findings} <= {GOOD, MARGINAL}
    assert all(finding.advice for finding in findings if finding.verdict != GOOD)


@pytest.mark.parametrize("refusal", [None, "no real-time scheduling"])
def test_what_is_allowed_is_not_advised(
    refusal: str | None,
    tmp_path: Path,
    make_surface_model: Callable[..., SurfaceModel],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    status = {
        "timer_lateness_s": {"p50": 1.0, "p99": 1.0},
        "compute_time_s": {"p50": 0.0, "p99": 0.0},
        "ticks": 1,
        "late_ticks": 1,
        "skipped_ticks": 0,
    }
    monkeypatch.setattr(check_host, "through_a_model", lambda *_, **__: (RoundTrips(0.0, 0.0, 0.0), status))
    monkeypatch.setattr(check_host, "_try_priority", lambda: refusal)
    save_model(make_surface_model(), tmp_path / "model.npz")
    advice = {f.name: f.advice for f in check_host.tick_run(tmp_path / "model.npz", 1.0)}
    for name in ("timer lateness", "late ticks"):
        assert ("allow real-time priority" in advice[name]) == (refusal is not None)
        assert "stop other programs" in advice[name]


@pytest.mark.parametrize(
    ("unanswered", "verdict"), [(0.0, GOOD), (0.01, GOOD), (0.05, MARGINAL), (0.5, NOT_SUFFICIENT)]
)
def test_messages_that_get_no_answer_count_however_fast_the_others_are(
    unanswered: float, verdict: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(check_host, "ping_pong", lambda *_: RoundTrips(1e-4, 2e-4, unanswered))
    findings = check_host.transport_round_trip()
    assert check_host.worst([finding.verdict for finding in findings]) == verdict
    assert {"share": unanswered} in [finding.values for finding in findings]


def test_a_check_ends_with_a_verdict_and_says_what_it_measured(
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    make_surface_model: Callable[..., SurfaceModel],
) -> None:
    """Of a surface model with two tools."""
    save_model(make_surface_model(2), tmp_path / "model.npz")
    for name in ("transport_round_trip", "under_load"):
        monkeypatch.setattr(check_host, name, partial(getattr(check_host, name), seconds=1.0))
    code = check_host.main([str(tmp_path / "model.npz"), "--seconds", "1", "--json"])
    report = json.loads(capsys.readouterr().out)
    findings = {finding["name"]: finding for finding in report["findings"]}
    measured = {
        "timer lateness": {"p50_s", "p99_s"},
        "Zenoh round trip": {"p50_s", "p99_s"},
        "unanswered pings": {"share"},
        "tick computation": {"p50_s", "p99_s"},
        "command to force": {"p50_s", "p99_s"},
        "unanswered commands": {"share"},
        "late ticks": {"share"},
        "skipped ticks": {"share"},
        "link under load": {"lost", "longest_silence_s", "lease_s"},
    }
    verdicts = [findings[name]["verdict"] for name in measured]
    assert report["verdict"] == max(verdicts, key=[GOOD, MARGINAL, NOT_SUFFICIENT].index)
    assert code == (NOT_SUFFICIENT in verdicts)
    for name, keys in measured.items():
        values = findings[name]["values"]
        assert values.keys() == keys
        assert all(isinstance(value, float | bool) for value in values.values())
        # Each is a time of this machine, or a share: neither 0 nor more than the check itself took.
        assert all(0 < value < 60 for key, value in values.items() if key.endswith("_s"))
        assert 0 <= values.get("share", 0) <= 1


@pytest.mark.parametrize(
    ("worst_share", "code"), [(0.0, 0), (check_host.UNANSWERED_SHARE.marginal, 0), (0.5, 1)]
)
def test_the_exit_code_says_whether_the_machine_is_sufficient(
    worst_share: float, code: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    finding = Finding("share", "", {}, check_host.UNANSWERED_SHARE.judge(worst_share))
    monkeypatch.setattr(check_host, "transport_round_trip", lambda: [finding])
    monkeypatch.setattr(check_host, "tick_run", lambda path, seconds: [finding])
    monkeypatch.setattr(check_host, "under_load", lambda path: finding)
    assert check_host.main([]) == code


def test_a_link_that_is_lost_under_load_is_not_sufficient(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    servers: list[zenoh.Session] = []

    @contextlib.contextmanager
    def a_token_without_a_server(command: list[str], ready: str) -> Iterator[None]:
        with transport.open_session(command[command.index("--listen") + 1], None) as session:
            token = session.liveliness().declare_token(Keys("check-host").server)
            servers.append(session)
            yield
            del token

    @contextlib.contextmanager
    def load_that_ends_the_server(number: int, longest_s: float) -> Iterator[None]:
        servers[0].close()  # type: ignore[no-untyped-call]
        yield

    monkeypatch.setattr(check_host, "running", a_token_without_a_server)
    monkeypatch.setattr(check_host, "busy_loops", load_that_ends_the_server)
    finding = check_host.under_load(tmp_path / "model.npz", 1.0)
    assert finding.values["lost"] is True
    assert finding.verdict == NOT_SUFFICIENT


def test_all_tools_press_while_ticks_are_measured(
    tmp_path: Path, make_surface_model: Callable[..., SurfaceModel], monkeypatch: pytest.MonkeyPatch
) -> None:
    save_model(make_surface_model(2), tmp_path / "model.npz")
    seen: list[dict[str, Any]] = []
    original = Connection.on_status

    def on_status(self: Connection, receive: Callable[[dict[str, Any]], None]) -> object:
        self.on_force(lambda message, arrival_ns: seen.append(message))
        return original(self, receive)

    monkeypatch.setattr(Connection, "on_status", on_status)
    check_host.tick_run(tmp_path / "model.npz", 1.0)
    assert any(min(message["n_contact_points"]) > 2 for message in seen)


def test_what_is_no_model_is_refused_before_anything_is_measured(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert check_host.main([str(tmp_path / "missing.npz")]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert "missing.npz: no such model file" in err


def test_busy_loops_run_in_sessions_of_their_own_and_end_with_the_block() -> None:
    def children() -> set[int]:
        return {int(pid) for pid in Path(f"/proc/self/task/{os.getpid()}/children").read_text().split()}

    before = children()
    with check_host.busy_loops(2, 60.0):
        loops = children() - before
        sessions = {os.getsid(pid) for pid in loops}
    assert len(loops) == 2
    assert sessions == loops
    assert not children() & loops


def test_ctrl_c_ends_a_check_and_the_threads_it_has_started(monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(seconds: float) -> None:
        raise KeyboardInterrupt

    before = threading.active_count()
    monkeypatch.setattr(check_host.time, "sleep", interrupted)
    assert check_host.main([]) == 130
    monkeypatch.undo()
    give_up = time.monotonic() + 30
    while threading.active_count() > before:  # those of Zenoh's callbacks end after their session
        assert time.monotonic() < give_up, threading.enumerate()
        time.sleep(0.01)
