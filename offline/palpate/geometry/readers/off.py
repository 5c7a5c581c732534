"""OFF, ASCII: vertices and faces. Normals, colors and texture coordinates are skipped.

Format: Geomview's manual, section "OFF Files".
"""

from __future__ import annotations

import re
from itertools import islice

from palpate.geometry.readers.polygons import (
    Polygons,
    ReadError,
    indexed_polygons,
    numbered_lines,
    parse_index,
    parse_point,
)

_HEADER = re.compile(rb"\s*(#[^\r\n]*\s*)*(ST)?C?N?OFF\b(?![^\r\n]*BINARY)")


def read_off(data: bytes) -> Polygons:
    """The faces of an OFF file. Raises ReadError."""
    if not _HEADER.match(data.removeprefix(b"\xef\xbb\xbf")):
        raise ReadError("not an ASCII OFF file with three coordinates: expected 'OFF' in the first line")
    lines = (
        (number, words)
        for number, line in numbered_lines(data)
        if (words := line.split("#", 1)[0].removeprefix("\xef\xbb\xbf").split())
    )
    number, words = next(lines)
    if len(words) == 1:
        number, words = next(lines, (number, words))
    else:
        words = words[1:]
    if len(words) not in (2, 3):  # of vertices, faces and, mostly, edges
        raise ReadError(f"line {number}: expected the counts of vertices, faces and edges")
    n_vertices, n_faces = (parse_index(word, number) for word in words[:2])

    points = [parse_point(words[:3], number) for number, words in islice(lines, max(n_vertices, 0))]
    face_lines = list(islice(lines, max(n_faces, 0)))
    for what, stated, found in (("vertices", n_vertices, points), ("faces", n_faces, face_lines)):
        if len(found) != stated:
            raise ReadError(
                f"truncated: the header states {stated:,} {what}, the file has {len(found):,}: copy or export it again"
            )
    for number, _ in lines:
        raise ReadError(f"line {number}: more lines than the header states vertices and faces")
    faces = [_face(words, number) for number, words in face_lines]
    return indexed_polygons(points, faces, first=0, name=lambda face: f"line {face_lines[face][0]}: a face")


def _face(words: list[str], line: int) -> list[int]:
    """The vertices of a face; a color may follow them."""
    count = parse_index(words[0], line)
    if not 0 <= count < len(words):
        raise ReadError(f"line {line}: a face of {count} vertices, but {len(words) - 1} numbers follow")
    return [parse_index(word, line) for word in words[1 : 1 + count]]
