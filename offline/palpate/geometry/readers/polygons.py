"""What every reader of a surface file returns, and the parsing and checks that they share."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

LARGEST_COORDINATE = 1e30
"""Above it, in any unit, a file is damaged. Squares and cubes of smaller coordinates are finite."""


class ReadError(ValueError):
    """A surface file can't be read; the message says what is wrong and in which line, or after how many faces."""


@dataclass(frozen=True)
class Polygons:
    """Faces as a file holds them.

    vertices  (n_vertices, 3), in the file's unit
    corners   (sum of sizes,), indices from 0 of the vertices of all faces, face after face
    sizes     (n_faces,), corners of each face, at least 3
    first     the number that the format gives the first vertex and face: 0 (PLY) or 1 (OBJ); STL has no numbers, its
              triangles are counted from 1
    indexed   whether vertices have numbers in the file (OBJ, PLY) or are repeated by every triangle (STL)
    """

    vertices: NDArray[np.float64]
    corners: NDArray[np.int64]
    sizes: NDArray[np.int64]
    first: int
    indexed: bool


def indexed_polygons(
    vertices: ArrayLike, faces: Sequence[Sequence[float]], first: int, name: Callable[[int], str]
) -> Polygons:
    """Polygons of a format whose faces name vertices.

    vertices  (n_vertices, 3)
    faces     the vertices of each face, counted from 0
    name      what to call the face of an index in a message

    Raises ReadError unless coordinates are finite and each face has at least three vertices, all of which exist.
    """
    points = np.array(vertices, dtype=np.float64).reshape(-1, 3)
    check_finite(points, "vertex {}, counted from 0,")
    sizes = np.array([len(face) for face in faces], dtype=np.int64)
    corners = np.array([corner for face in faces for corner in face], dtype=np.int64)
    small = np.flatnonzero(sizes < 3)
    if len(small):
        raise ReadError(f"{name(small[0])} with {sizes[small[0]]} vertices, expected at least 3")
    wrong = np.flatnonzero((corners < 0) | (corners >= len(points)))
    if len(wrong):
        face = int(np.searchsorted(np.cumsum(sizes), wrong[0], side="right"))
        raise ReadError(
            f"{name(face)} names vertex {corners[wrong[0]] + first:,}, but the file has {len(points):,} vertices, counted "
            f"from {first}"
        )
    return Polygons(points, corners, sizes, first, indexed=True)


def numbered_lines(data: bytes) -> Iterator[tuple[int, str]]:
    """The non-empty lines of a text file, stripped, with their numbers from 1; LF, CRLF or CR.

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
    if not abs(value) <= LARGEST_COORDINATE:  # also where it is not a number
        raise ReadError(f"line {line}: {word!r}: expected a finite coordinate below {LARGEST_COORDINATE:g}")
    return value


def parse_index(word: str, line: int) -> int:
    """An integer. Raises ReadError naming the line and the word."""
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
