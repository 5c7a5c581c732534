"""Reads a CSV of named columns of numbers."""

from __future__ import annotations

import csv
import math
from collections.abc import Collection
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from palpate.files import printable

MOST_ROWS = 200_000

_LARGEST = 1e15  # SI units; its square is far from the largest number


def read_columns(path: Path, allowed: Collection[frozenset[str]]) -> dict[str, NDArray[np.float64]]:
    """The columns of a CSV by name, (n_rows,) each.

    allowed  sets of column names; the file has exactly one of them, in any order

    Raises FileNotFoundError, or ValueError that names the columns or the line and what was expected.
    """
    shown = printable(path)
    if not path.is_file():
        raise FileNotFoundError(f"{shown}: no such record")
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            lines = csv.reader(file)
            names = [name.strip() for name in next(lines, [])]
            _check_names(names, allowed, shown)
            rows: list[list[float]] = []
            for cells in lines:
                if cells:
                    rows.append(_numbers(cells, names, f"{shown}, line {lines.line_num}"))
                if len(rows) > MOST_ROWS:
                    raise ValueError(
                        f"{shown}: expected at most {MOST_ROWS:,} rows; average or thin the record"
                    )
    except UnicodeDecodeError as error:
        raise ValueError(f"{shown}: expected a CSV in UTF-8") from error
    except csv.Error as error:
        raise ValueError(f"{shown}: not a CSV ({error})") from error
    table = np.array(rows, dtype=float).reshape(-1, len(names))
    return {name: np.ascontiguousarray(table[:, i]) for i, name in enumerate(names)}


def _check_names(names: list[str], allowed: Collection[frozenset[str]], shown: str) -> None:
    if len(set(names)) == len(names) and frozenset(names) in allowed:
        return
    found = ", ".join(printable(name, 40) or "(no name)" for name in names) or "none"
    expected = "; or ".join(", ".join(sorted(names, key=_usual_place)) for names in allowed)
    raise ValueError(
        f"{shown}: found the columns {found}. Expected, separated by commas: {expected}. "
        "The name of a column states its unit"
    )


def _usual_place(name: str) -> int:
    order = ("time_s", "frequency_hz", "strain", "displacement_m", "storage_pa")
    return order.index(name) if name in order else len(order)


def _numbers(cells: list[str], names: list[str], where: str) -> list[float]:
    if len(cells) != len(names):
        raise ValueError(f"{where}: {len(cells)} values: expected {len(names)}")
    numbers = []
    for name, cell in zip(names, cells, strict=True):
        try:
            number = float(cell)
        except ValueError:
            number = math.nan
        if not abs(number) <= _LARGEST:
            expected = "a number" if math.isnan(number) else f"a number up to {_LARGEST:g}"
            raise ValueError(f"{where}: {name} is {printable(cell.strip(), 40)!r}: expected {expected}")
        numbers.append(number)
    return numbers
