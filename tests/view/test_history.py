"""What the charts show."""

from __future__ import annotations

import numpy as np
import pytest

from palpate_client import Force
from palpate_client.messages import Touch
from palpate_view.history import BIN_TICKS, SHOWN_S, History

PERIOD_S = 1e-3
TOUCH = Touch((0.0, 0.0, 1.0), 0.003, 0.0, 4, 5e-3, 1e-3, 2e-3, 1e-4)


def force(tick: int, late_s: float = 0.0, age_s: float = 2e-4) -> Force:
    began_ns = round((tick * PERIOD_S + late_s) * 1e9)
    return Force(
        tick, began_ns, 1, 0, round(age_s * 1e9), 0, (0.0, 0.0, 0.0), (0.0, 3.0, 4.0), 1.0, 0.0, 0, TOUCH
    )


def test_the_charts_show_the_last_seconds() -> None:
    history = History(PERIOD_S)
    n = round((SHOWN_S + 1) / PERIOD_S)
    for tick in range(n):
        history.add(force(tick), 3e-3, 1e-3)
    columns = history.columns()
    assert len(columns["tick"]) == SHOWN_S / (BIN_TICKS * PERIOD_S)
    assert columns["time_s"][-1] == 0.0
    assert columns["time_s"][0] == pytest.approx(-SHOWN_S + BIN_TICKS * PERIOD_S)
    assert (columns["force_n"] == 5.0).all() and (columns["depth_m"] == 0.003).all()
    assert columns["lost_j"][-1] == pytest.approx(3e-3)  # of the tissue and of the contact
    assert columns["work_j"][-1] == 5e-3 and columns["tissue_j"][-1] == 3e-3


def test_one_late_tick_is_seen_and_a_lost_message_is_none() -> None:
    history = History(PERIOD_S)
    for tick in range(1, 4 * BIN_TICKS):
        if tick == 30:
            continue  # lost
        history.add(
            force(tick, late_s=7e-4 if tick == 60 else 0.0, age_s=3e-3 if tick == 60 else 2e-4), 0.0, 0.0
        )
    columns = history.columns()
    np.testing.assert_allclose(columns["lateness_s"], [0.0, 0.0, 7e-4], atol=1e-9)
    np.testing.assert_allclose(columns["input_age_s"], [2e-4, 2e-4, 3e-3])


def test_the_input_age_of_a_tool_without_commands_is_zero() -> None:
    history = History(PERIOD_S)
    history.add(force(BIN_TICKS)._replace(input_age_ns=-1), 0.0, 0.0)
    assert (history.columns()["input_age_s"] == 0.0).all()


def test_another_tool_begins_with_an_empty_chart() -> None:
    history = History(PERIOD_S)
    history.add(force(BIN_TICKS), 0.0, 0.0)
    history.forget()
    assert len(history.columns()["time_s"]) == 0
