"""Wavefront OBJ: vertices and faces. Everything else (normals, textures, groups, materials, curves) is skipped."""

from __future__ import annotations

from collections.abc import Iterator

from palpate.geometry.readers.polygons import (
    Polygons,
    ReadError,
    indexed_polygons,
    numbered_lines,
    parse_index,
    parse_point,
)


def read_obj(data: bytes) -> Polygons:
    """The faces of an OBJ file. Raises ReadError."""
    vertices: list[tuple[float, float, float]] = []
    faces: list[list[int]] = []
    lines: list[int] = []  # of each face
    for number, words in _statements(data):
        if words[0] == "v":
            # A weight or a color may follow the three coordinates.
            vertices.append(parse_point(words[1:4], number))
        elif words[0] in ("f", "fo"):
            faces.append([_vertex(word, len(vertices), number) for word in words[1:]])
            lines.append(number)
    return indexed_polygons(vertices, faces, first=1, name=lambda face: f"line {lines[face]}: a face")


def _statements(data: bytes) -> Iterator[tuple[int, list[str]]]:
    """The words of each statement without its comment, with the number of its first line; `\\` continues a line."""
    start, pending = 0, ""
    for number, line in numbered_lines(data):
        line = line.split("#", 1)[0].rstrip()
        start = start if pending else number
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
    if index < -n_vertices:
        raise ReadError(
            f"line {line}: a face names vertex {index}, but {n_vertices:,} vertices come before it"
        )
    return n_vertices + index if index < 0 else index - 1
