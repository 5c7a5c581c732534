"""Wavefront OBJ: vertices and faces. Everything else (normals, textures, groups, materials, curves) is skipped."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from palpate.geometry.readers.polygons import (
    Polygons,
    ReadError,
    numbered_lines,
    parse_index,
    parse_point,
)


def read_obj(data: bytes) -> Polygons:
    """The faces of an OBJ file. Raises ReadError."""
    vertices: list[tuple[float, float, float]] = []
    corners: list[int] = []
    sizes: list[int] = []
    lines: list[int] = []  # of each face
    for number, words in _statements(data):
        if words[0] == "v":
            # A weight or a color may follow the three coordinates.
            vertices.append(parse_point(words[1:4], number))
        elif words[0] in ("f", "fo"):
            if len(words) < 4:
                raise ReadError(f"line {number}: a face with {len(words) - 1} vertices, expected at least 3")
            corners += [_vertex(word, len(vertices), number) for word in words[1:]]
            sizes.append(len(words) - 1)
            lines.append(number)
    index = np.array(corners, dtype=np.int64)
    beyond = np.flatnonzero(index >= len(vertices))
    if len(beyond):
        face = int(np.searchsorted(np.cumsum(sizes), beyond[0], side="right"))
        raise ReadError(
            f"line {lines[face]}: a face names vertex {index[beyond[0]] + 1:,}, but the file has {len(vertices):,} vertices"
        )
    points = np.array(vertices, dtype=np.float64).reshape(-1, 3)
    return Polygons(points, index, np.array(sizes, dtype=np.int64), first=1, indexed=True)


def _statements(data: bytes) -> Iterator[tuple[int, list[str]]]:
    """The words of each statement without its comment, with the number of its first line; `\\` continues a line."""
    start, pending = 0, ""
    for number, line in numbered_lines(data):
        line = line.split("#", 1)[0].rstrip()
        if not pending:
            start = number
        pending += line.removesuffix("\\") + " "
        if not line.endswith("\\"):
            if words := pending.split():
                yield start, words
            pending = ""
    if words := pending.split():
        yield start, words


def _vertex(word: str, n_vertices: int, line: int) -> int:
    """Index from 0 of the vertex that `v`, `v/vt`, `v//vn` or `v/vt/vn` names; negative numbers count from the last."""
    index = parse_index(word.split("/", 1)[0], line)
    if index > 0:
        return index - 1
    if index == 0 or -index > n_vertices:
        raise ReadError(
            f"line {line}: a face names vertex {index}, expected from 1, or from -1 down to -{n_vertices:,}"
        )
    return n_vertices + index
