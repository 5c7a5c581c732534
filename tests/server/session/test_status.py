"""Percentiles from histograms, against numpy's on the same durations."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from palpate.model_file import ReducedModel
from palpate_client.wire import Flags, Keys, Kind, pack, unpack
from palpate_server.coupling.models import make_running
from palpate_server.realtime import shared_memory
from palpate_server.realtime.safety import Limits
from palpate_server.session import status
from palpate_server.session.state import SessionState


@pytest.mark.parametrize("scale_ns", [3e3, 5e4, 1e6])
def test_percentiles_are_right_to_a_bin(scale_ns: float) -> None:
    durations = np.random.default_rng(0).exponential(scale_ns, 20_001).astype(np.int64)
    bins = np.minimum(durations // 1000, shared_memory.HISTOGRAM_BINS - 1)
    counts = np.bincount(bins, minlength=shared_memory.HISTOGRAM_BINS)
    result = status.percentiles(counts, int(durations.max()))
    for name, share in (("p50", 50), ("p99", 99), ("p99_9", 99.9)):
        expected = np.percentile(durations, share, method="inverted_cdf") * 1e-9
        value = result[name]
        assert value is not None
        if expected < (shared_memory.HISTOGRAM_BINS - 1) * 1e-6:
            assert 0 <= value - expected <= 1.001e-6
        else:
            assert value == durations.max() * 1e-9  # beyond the bins only the maximum is known
    assert result["max"] == durations.max() * 1e-9


def test_an_empty_histogram_has_no_percentiles() -> None:
    counts = np.zeros(shared_memory.HISTOGRAM_BINS, np.int64)
    assert status.percentiles(counts, 0) == {"p50": None, "p99": None, "p99_9": None, "max": None}


def test_success_rate_is_the_share_of_recent_ticks_with_a_new_command(
    make_spring_mass_model: Callable[..., ReducedModel],
) -> None:
    model = make_spring_mass_model()
    limits = Limits(1.0, 1.0, 1.0, 1.0, 0.0)
    memory = shared_memory.make_memory(make_running(model), model.period_s, [limits], 1 / 30)
    assert status.success_rate(memory, 0) == 0
    memory.shared[shared_memory.HEAD] = 500
    memory.ring.ports["flags"][:500] = int(Flags.STALE)
    memory.ring.ports["flags"][400:480] = int(Flags.SOFT_START)
    memory.ring.ports["flags"][480:490] = int(Flags.HELD)
    assert status.success_rate(memory, 0) == 0.8


def test_the_status_message_is_plain_data(make_spring_mass_model: Callable[..., ReducedModel]) -> None:
    limits = Limits(1.0, 1.0, 1.0, 1.0, 0.0)
    state = SessionState(make_spring_mass_model(2), limits, Keys("test"), 1 / 30)
    message = unpack(pack(status.status(state, 1)), Kind.STATUS)
    assert message["tools"]["tip1"]["holder"] is None
    assert message["tools"]["tip1"]["home_m"] == list(state.model.contacts[1].center_m)
