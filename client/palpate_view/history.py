"""The last seconds of a tool, as the charts show them: the ticks of each short time put together."""

from __future__ import annotations

import math
import threading
from collections import deque
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from palpate_client import Force

BIN_TICKS = 25
SHOWN_S = 10.0


class Row(NamedTuple):
    """What one bin of ticks shows: the last values, and of times the largest.

    Forces N, depth m, energies J since the tissue was at rest, times s.
    """

    tick: int
    force_n: float
    depth_m: float
    work_j: float
    tissue_j: float
    lost_j: float
    spring_j: float
    withheld_j: float
    input_age_s: float
    lateness_s: float


class History:
    """Takes the force of every tick, on one thread; another takes the rows of the last SHOWN_S."""

    def __init__(self, period_s: float) -> None:
        self.period_s = period_s
        self._rows: deque[Row] = deque(maxlen=math.ceil(SHOWN_S / (BIN_TICKS * period_s)))
        self._lock = threading.Lock()
        self._last: Force | None = None
        self._age_s = self._late_s = 0.0

    def add(self, force: Force, tissue_stored_j: float, tissue_dissipated_j: float) -> None:
        """One tick. The input age of a tool without commands is 0."""
        last = self._last
        if last is not None:
            elapsed_s = (force.server_time_ns - last.server_time_ns) * 1e-9
            self._late_s = max(self._late_s, elapsed_s - (force.tick - last.tick) * self.period_s)
        self._last = force
        self._age_s = max(self._age_s, force.input_age_ns * 1e-9, 0.0)
        if force.tick % BIN_TICKS:
            return
        touch = force.touch
        row = Row(
            force.tick,
            math.hypot(*force.force_n),
            touch.penetration_m,
            touch.work_j,
            tissue_stored_j,
            tissue_dissipated_j + touch.dissipated_j,
            touch.stored_j,
            touch.withheld_j,
            self._age_s,
            self._late_s,
        )
        self._age_s = self._late_s = 0.0
        with self._lock:
            self._rows.append(row)

    def forget(self) -> None:
        """Start anew, for another tool."""
        self._last = None
        with self._lock:
            self._rows.clear()

    def columns(self) -> dict[str, NDArray[np.float64]]:
        """Each field of `Row` as an array (n_rows,), and `time_s` before the newest row, from -SHOWN_S to 0."""
        with self._lock:
            table = np.array(self._rows, dtype=float).reshape(-1, len(Row._fields))
        columns = dict(zip(Row._fields, table.T, strict=True))
        tick = columns["tick"]
        columns["time_s"] = (tick - tick[-1]) * self.period_s if len(tick) else tick
        return columns
