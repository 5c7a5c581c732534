"""The host check: how verdicts are made, and that it ends with one on this machine, whatever it is."""

from __future__ import annotations

import json

import pytest

from palpate_server import check_host
from palpate_server.check_host import GOOD, MARGINAL, NOT_SUFFICIENT, Bounds


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


def test_a_check_ends_with_a_verdict_and_says_what_it_measured(capsys: pytest.CaptureFixture[str]) -> None:
    code = check_host.main(["--seconds", "1", "--json"])
    report = json.loads(capsys.readouterr().out)
    assert code == (1 if report["verdict"] == NOT_SUFFICIENT else 0)
    names = {finding["name"] for finding in report["findings"]}
    assert {"timer lateness", "Zenoh round trip", "command to force", "late ticks", "skipped ticks"} <= names
    for finding in report["findings"]:
        assert finding["value"]
