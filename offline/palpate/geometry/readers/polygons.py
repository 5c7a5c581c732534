"""What every reader of a surface file returns, and the words they share."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

LARGEST_COORDINATE = 1e30
"""Beyond it, in whatever unit, a file is damaged; squares and cubes of what is below it are still finite."""


class ReadError(ValueError):
    """A surface file can't be read; the message says what is wrong and in which line, or after how many faces."""


@dataclass(frozen=True)
class Polygons:
    """Faces as a file holds them.

    vertices  (n_vertices, 3), in the file's unit
    corners   (sum of sizes,), indices of the vertices of all faces, one face after the other, from 0
    sizes     (n_faces,), corners of each face, each at least 3
    first     the number that the format gives the first vertex and face: 0 (PLY) or 1 (OBJ); STL numbers nothing, its
              triangles are counted from 1
    indexed   whether vertices have numbers in the file (OBJ, PLY) or are repeated by every triangle (STL)
    """

    vertices: NDArray[np.float64]
    corners: NDArray[np.int64]
    sizes: NDArray[np.int64]
    first: int
    indexed: bool


def numbered_lines(data: bytes) -> Iterator[tuple[int, str]]:
    """The lines of a text file that are not empty, stripped, with their numbers from 1; LF, CRLF or CR.

    A name in the file may be in any encoding: bytes that are not ASCII are kept as Latin-1. Raises ReadError for UTF-16.
    """
    if data[:2] in (b"\xff\xfe", b"\xfe\xff"):
        raise ReadError("the text is UTF-16: save it as UTF-8 or ASCII")
    text = data.removeprefix(b"\xef\xbb\xbf").decode("latin-1")
    for number, line in enumerate(re.split(r"\r\n|\r|\n", text), start=1):
        if line := line.strip():
            yield number, line


def parse_point(words: Sequence[str], line: int) -> tuple[float, float, float]:
    """Three coordinates. Raises ReadError naming the line and what is wrong with them."""
    if len(words) != 3:
        raise ReadError(f"line {line}: a vertex with {len(words)} coordinates, expected 3")
    x, y, z = (parse_number(w, line) for w in words)
    return x, y, z


def parse_number(word: str, line: int) -> float:
    """A coordinate. Raises ReadError naming the line and the word."""
    try:
        value = float(word)
    except ValueError:
        if "," in word:
            raise ReadError(
                f"line {line}: {word!r} has a decimal comma: write decimal points, by `sed 's/,/./g' OLD > NEW` or by "
                "exporting the file again with an English locale"
            ) from None
        raise ReadError(f"line {line}: {word!r} is not a number") from None
    if not abs(value) <= LARGEST_COORDINATE:  # not a number compares false
        raise ReadError(f"line {line}: {word!r}: expected a finite coordinate below {LARGEST_COORDINATE:g}")
    return value


def parse_index(word: str, line: int) -> int:
    """A whole number. Raises ReadError naming the line and the word."""
    try:
        return int(word)
    except ValueError:
        raise ReadError(f"line {line}: {word!r} is not a whole number") from None


def check_finite(vertices: NDArray[np.float64], describe: str) -> None:
    """Raise ReadError unless all coordinates of vertices (n, 3) are usable; `describe` has a place for the row."""
    bad = np.flatnonzero(~np.all(np.abs(vertices) <= LARGEST_COORDINATE, axis=1))
    if len(bad):
        raise ReadError(
            f"{describe.format(bad[0])} is at {vertices[bad[0]].tolist()}: expected finite coordinates below "
            f"{LARGEST_COORDINATE:g} ({len(bad)} vertices like it)"
        )
