"""STL, binary and ASCII. Normals are ignored: the order of a triangle's vertices says which side is outside."""

from __future__ import annotations

import re

import numpy as np
from numpy.typing import NDArray

from palpate.geometry.readers.polygons import Polygons, ReadError, check_finite, numbered_lines, parse_point

_HEADER_BYTES = 84  # 80 of text and the count of triangles
_RECORD = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])  # 50 bytes
_TEXT = re.compile(rb"\s*solid\b[^\0]*?\b(facet|endsolid)\b", re.IGNORECASE)
_UTF_MARKS = (b"\xef\xbb\xbf", b"\xff\xfe", b"\xfe\xff")


def read_stl(data: bytes) -> Polygons:
    """The triangles of an STL file. Raises ReadError."""
    # A binary file may begin with "solid" too, so its size decides first.
    if len(data) >= _HEADER_BYTES and len(data) == _HEADER_BYTES + _RECORD.itemsize * _stated_count(data):
        corners = np.frombuffer(data, _RECORD, offset=_HEADER_BYTES)["corners"].astype(np.float64)
    elif data.startswith(_UTF_MARKS) or _TEXT.match(data[:4096]):
        corners = _read_text(data)
    else:
        raise ReadError(_what_is_wrong(data))
    vertices = corners.reshape(-1, 3)
    check_finite(vertices, "corner {} of the triangles, counted from 0,")
    return Polygons(
        vertices, np.arange(len(vertices)), np.full(len(corners), 3, np.int64), first=1, indexed=False
    )


def _stated_count(data: bytes) -> int:
    return int.from_bytes(data[_HEADER_BYTES - 4 : _HEADER_BYTES], "little")


def _what_is_wrong(data: bytes) -> str:
    """Why neither the size of a binary file nor the first words of an ASCII file fit."""
    if len(data) < _HEADER_BYTES:
        return f"not an STL file: {len(data)} bytes, and it doesn't begin with 'solid' and a 'facet'"
    stated, held = _stated_count(data), (len(data) - _HEADER_BYTES) / _RECORD.itemsize
    if held < stated:
        return (
            f"truncated, or not an STL file: its header states {stated:,} triangles, it holds {int(held):,}: copy or export "
            "it again"
        )
    return f"damaged, or not an STL file: its header states {stated:,} triangles, there is room for {held:,.6g}: export it again"


def _read_text(data: bytes) -> NDArray[np.float64]:
    """Corners (n_triangles, 3, 3) of an ASCII file; it may hold several solids, and its last line may be missing."""
    corners: list[tuple[float, float, float]] = []
    number, start, inside = 0, 0, False  # start: the first corner of the last facet
    for number, line in numbered_lines(data):
        words = re.sub(r"^end\s+", "end", line.lower()).split()  # some programs write "end facet"
        match words[0]:
            case "vertex" if inside:
                corners.append(parse_point(words[1:], number))
            case "facet" if not inside:
                inside, start = True, len(corners)
            case "endfacet" if inside:
                if len(corners) != start + 3:
                    raise ReadError(
                        f"line {number}: a facet with {len(corners) - start} vertices, expected 3"
                    )
                inside = False
            case "outer" | "endloop":
                pass
            case "solid" | "endsolid" if not inside:
                pass
            case _:
                where = "inside" if inside else "outside"
                raise ReadError(f"line {number}: {line[:40]!r} does not belong {where} a facet")
    if inside:
        raise ReadError(
            f"truncated: line {number}, the last one, is within triangle {start // 3 + 1}: copy or export it again"
        )
    return np.array(corners, dtype=np.float64).reshape(-1, 3, 3)
