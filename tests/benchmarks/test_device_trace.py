"""What came when: a trace is made of messages as they are sent and heard."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from device_trace import trace_of, trace_through_a_model
from palpate.model_file import save_model
from palpate_server.diagnostics.round_trips import ReceivedForce
from palpate_server.diagnostics.sample_model import spring_mass_model

MS = 1_000_000


def test_a_trace_tells_late_superseded_held_and_lost_messages_from_each_other() -> None:
    sent = [MS * k for k in range(1, 9)]  # commands 1 to 8
    heard = [
        ReceivedForce(
            arrival_ns=1_500_000, tick=70, server_time_ns=1_300_000, sequence=1, input_age_ns=100_000
        ),
        ReceivedForce(
            arrival_ns=3_200_000, tick=71, server_time_ns=2_300_000, sequence=2, input_age_ns=0
        ),  # late
        ReceivedForce(
            arrival_ns=3_600_000, tick=72, server_time_ns=3_300_000, sequence=2, input_age_ns=MS
        ),  # held
        ReceivedForce(
            arrival_ns=4_500_000, tick=73, server_time_ns=4_300_000, sequence=4, input_age_ns=0
        ),  # 3 superseded
        ReceivedForce(
            arrival_ns=6_500_000, tick=75, server_time_ns=6_300_000, sequence=6, input_age_ns=0
        ),  # 74 lost
    ]
    trace = trace_of(sent, heard)
    np.testing.assert_array_equal(trace.device_ns, sent)
    np.testing.assert_array_equal(trace.rendered, [-1, 0, 0, 2, 3, 3, 5, 5])
    np.testing.assert_array_equal(trace.used, [0, 1, 1, 3, 3, 5])
    np.testing.assert_array_equal(trace.server_ns, MS * np.array([1.3, 2.3, 3.3, 4.3, 4.3, 6.3]))
    np.testing.assert_array_equal(trace.arrival_ns, MS * np.array([1.2, 2.3, 2.3, 4.3, 4.3, 6.3]))
    np.testing.assert_array_equal(trace.ages_ns(), MS * np.array([1, 2, 2, 1, 2, 1, 2]))


def test_without_a_force_there_is_no_trace() -> None:
    with pytest.raises(ValueError, match="no force was heard"):
        trace_of([1, 2], [])


def test_the_trace_of_a_served_model_never_answers_what_was_not_yet_asked(tmp_path: Path) -> None:
    path = tmp_path / "sample.npz"
    save_model(spring_mass_model(), path)
    trips, trace = trace_through_a_model(path, "tip", 1.0)
    assert 0 < trips.p50_s <= trips.p99_s
    assert len(trace.device_ns) == 999
    assert np.all(np.diff(trace.device_ns) > 0)
    assert np.all(np.diff(trace.server_ns) >= 0)
    assert np.all(np.diff(trace.used) >= 0)
    assert np.all(trace.arrival_ns <= trace.server_ns)
    asked = trace.used >= 0
    assert np.all(trace.device_ns[trace.used[asked]] < trace.arrival_ns[asked])
    ages = trace.ages_ns()
    assert len(ages) > 500
    assert ages.min() > 0
