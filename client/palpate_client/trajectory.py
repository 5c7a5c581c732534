"""A tip's trajectory from a CSV file: positions over time, with straight lines between them."""

from __future__ import annotations

import csv
import math
from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from palpate_client.errors import ConfigurationError
from palpate_client.messages import Vector

COLUMNS = ("t_s", "x_m", "y_m", "z_m")
LARGEST_FILE_BYTES = 2**28


@dataclass(frozen=True)
class Trajectory:
    """times_s: at least two, from 0 on, rising. positions_m: as many points of the model's frame."""

    times_s: Sequence[float]
    positions_m: Sequence[Vector]

    @property
    def duration_s(self) -> float:
        return self.times_s[-1]

    def at(self, time_s: float) -> tuple[Vector, Vector]:
        """Position, m, and velocity, m/s, at a time; after the end it stands where it ended."""
        if time_s >= self.duration_s:
            return self.positions_m[-1], (0.0, 0.0, 0.0)
        i = bisect_right(self.times_s, time_s) - 1
        start, end = self.positions_m[i], self.positions_m[i + 1]
        seconds = self.times_s[i + 1] - self.times_s[i]
        vx, vy, vz = ((b - a) / seconds for a, b in zip(start, end, strict=True))
        since = time_s - self.times_s[i]
        return (start[0] + vx * since, start[1] + vy * since, start[2] + vz * since), (vx, vy, vz)


def read_trajectory(path: Path) -> Trajectory:
    """Read a CSV with the columns of COLUMNS, in any order; others are ignored.

    Raises ConfigurationError, which names line and column, unless every value is a finite number and the times rise from 0.
    """
    try:
        if path.stat().st_size > LARGEST_FILE_BYTES:
            raise ConfigurationError(f"{path}: larger than {LARGEST_FILE_BYTES >> 20} MiB")
        with path.open(newline="", encoding="utf-8-sig") as file:
            return _read(path, csv.reader(file))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        reason = error.strerror if isinstance(error, OSError) else str(error)
        raise ConfigurationError(f"{path}: {reason}") from error


def _read(path: Path, rows: Any) -> Trajectory:
    header = [name.strip() for name in next(rows, [])]
    if missing := [name for name in COLUMNS if header.count(name) != 1]:
        raise ConfigurationError(f"{path}: line 1: expected one column {', one '.join(missing)}")
    places = [header.index(name) for name in COLUMNS]
    times: list[float] = []
    positions: list[Vector] = []
    for row in rows:
        if not any(cell.strip() for cell in row):
            continue
        line = f"{path}: line {rows.line_num}"
        if len(row) != len(header):
            raise ConfigurationError(f"{line}: {len(row)} fields, expected {len(header)} as in the header")
        t, x, y, z = (
            _number(f"{line}, {name}", row[place]) for name, place in zip(COLUMNS, places, strict=True)
        )
        if not times and t != 0:
            raise ConfigurationError(f"{line}, t_s: {t:g}, expected 0 in the first row")
        if times and t <= times[-1]:
            raise ConfigurationError(
                f"{line}, t_s: {t:g}, expected more than {times[-1]:g} of the row before"
            )
        times.append(t)
        positions.append((x, y, z))
    if len(times) < 2:
        raise ConfigurationError(f"{path}: {len(times)} rows of numbers, expected two at least")
    return Trajectory(times, positions)


def _number(where: str, text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise ConfigurationError(f"{where}: {text!r}, expected a finite number")
    return value
