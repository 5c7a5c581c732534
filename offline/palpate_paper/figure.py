"""One regenerated figure: its table, its plot and its findings."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from palpate.files import write_atomically

Cell = str | float | int


@dataclass(frozen=True)
class Figure:
    """A figure of the page.

    number    2 to 13 as in BaniHani & De 2009; from 14 on, beyond it
    title     one line
    columns   header of the table, units in the names
    rows      the table: every number that the plot shows
    draw      draws onto an empty matplotlib figure
    findings  what we find and why it differs from the paper, Markdown, computed from the rows
    size      of the plot, inches
    headline  one line of Markdown for the page's summary; may be empty
    """

    number: int
    title: str
    columns: tuple[str, ...]
    rows: Sequence[Sequence[Cell]]
    draw: Callable[[Any], None]
    findings: str
    size: tuple[float, float] = (9.0, 4.0)
    headline: str = ""

    @property
    def stem(self) -> str:
        return f"figure_{self.number:02d}"

    def write(self, folder: Path) -> None:
        """STEM.csv and STEM.png in the folder, which must exist."""
        table = io.StringIO()
        writer = csv.writer(table, lineterminator="\n")
        writer.writerow(self.columns)
        writer.writerows([_text(cell) for cell in row] for row in self.rows)
        write_atomically(folder / f"{self.stem}.csv", table.getvalue().encode())
        from matplotlib.figure import Figure as Canvas

        canvas = Canvas(figsize=self.size, layout="constrained")
        self.draw(canvas)
        picture = io.BytesIO()
        canvas.savefig(picture, format="png", dpi=95)
        write_atomically(folder / f"{self.stem}.png", _with_palette(picture))


def _with_palette(picture: io.BytesIO) -> bytes:
    """The same PNG in 256 colors: enough for lines and text, in half the bytes."""
    from PIL import Image

    with Image.open(picture) as image:
        reduced = image.convert("RGB").quantize(256, dither=Image.Dither.NONE)
    smaller = io.BytesIO()
    reduced.save(smaller, format="png", optimize=True)
    return smaller.getvalue()


def _text(cell: Cell) -> str:
    return f"{cell:.6g}" if isinstance(cell, float) else str(cell)


def tidy(axis: Any) -> None:
    """The style of every panel: light grid, two spines."""
    axis.grid(alpha=0.25, which="both")
    axis.spines[["top", "right"]].set_visible(False)
