"""The host check: how verdicts are made, and that it ends with one on this machine, whatever it is."""

from __future__ import annotations

import json
import threading

import pytest

from palpate_server.diagnostics import check_host
from palpate_server.diagnostics.check_host import GOOD, MARGINAL, NOT_SUFFICIENT, Bounds
from palpate_server.diagnostics.round_trips import RoundTrips


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


def test_a_check_ends_with_a_verdict_and_says_what_it_measured(capsys: pytest.CaptureFixture[str]) -> None:
    code = check_host.main(["--seconds", "1", "--json"])
    report = json.loads(capsys.readouterr().out)
    assert code == (1 if report["verdict"] == NOT_SUFFICIENT else 0)
    names = {finding["name"] for finding in report["findings"]}
    measured = {
        "timer lateness": {"p50_s", "p99_s"},
        "Zenoh round trip": {"p50_s", "p99_s"},
        "unanswered pings": {"share"},
        "command to force": {"p50_s", "p99_s"},
        "unanswered commands": {"share"},
        "late ticks": {"share"},
        "skipped ticks": {"share"},
    }
    assert measured.keys() <= names
    for finding in report["findings"]:
        assert finding["text"]
        if finding["name"] in measured:
            assert finding["values"].keys() == measured[finding["name"]]
            assert all(type(value) is float for value in finding["values"].values())


def test_ctrl_c_ends_a_check_and_the_threads_it_has_started(monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(seconds: float) -> None:
        raise KeyboardInterrupt

    before = threading.active_count()
    monkeypatch.setattr(check_host.time, "sleep", interrupted)
    assert check_host.main([]) == 2
    assert threading.active_count() == before
