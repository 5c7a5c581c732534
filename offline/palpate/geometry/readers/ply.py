"""PLY, ASCII and binary of either byte order: positions and faces. Other properties and elements are skipped.

Format: G. Turk, The PLY Polygon File Format, 1994.
"""

from __future__ import annotations

import io
import re
import struct
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, BinaryIO

from palpate.geometry.readers.polygons import (
    Polygons,
    ReadError,
    indexed_polygons,
    numbered_lines,
    parse_index,
    parse_number,
)

_CODES = {
    "char": "b", "uchar": "B", "short": "h", "ushort": "H", "int": "i", "uint": "I", "float": "f", "double": "d",
    "int8": "b", "uint8": "B", "int16": "h", "uint16": "H", "int32": "i", "uint32": "I", "float32": "f", "float64": "d",
}  # fmt: skip
"""From the names of types to the codes of `struct`."""
_COUNTS = {name for name, code in _CODES.items() if code not in "fd"}
_BYTE_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_FACE_LISTS = ("vertex_indices", "vertex_index")

Row = list[tuple[float, ...]]
"""One element: the numbers of each of its properties."""


@dataclass(frozen=True)
class _Property:
    """A number, or a list of numbers with a count before it."""

    name: str
    code: str
    count_code: str | None = None


@dataclass(frozen=True)
class _Element:
    name: str
    count: int
    properties: list[_Property] = field(default_factory=list)

    def index(self, *names: str) -> int | None:
        """Position of the first property that has one of the names."""
        return next((i for i, p in enumerate(self.properties) if p.name in names), None)


def read_ply(data: bytes) -> Polygons:
    """The faces of a PLY file. Raises ReadError."""
    end = re.search(rb"[\r\n]end_header[ \t]*(\r\n|\n|\r)", data)
    if not re.match(rb"ply\s", data) or not end:
        raise ReadError("not a PLY file: expected 'ply' in the first line, and a line 'end_header'")
    header, body = data[: end.end()], data[end.end() :]
    order, elements = _header(header)
    if order:
        stream = io.BytesIO(body)
        rows = _rows(elements, lambda element: _binary_row(stream, order, element))
        if surplus := stream.read().strip():
            raise ReadError(f"{len(surplus):,} bytes more than the header states")
    else:
        n_header_lines = len(re.findall(rb"\r\n|\r|\n", header))
        lines = ((number + n_header_lines, line.split()) for number, line in numbered_lines(body))
        rows = _rows(elements, lambda element: _text_row(*next(lines), element))
        for number, _ in lines:
            raise ReadError(f"line {number}: more lines than the header states elements")

    vertex, face = (next((e for e in elements if e.name == name), None) for name in ("vertex", "face"))
    axes = [] if vertex is None else [vertex.index(axis) for axis in "xyz"]
    if vertex is None or None in axes:
        raise ReadError("the header has no element 'vertex' with the properties x, y and z")
    column = None if face is None else face.index(*_FACE_LISTS)
    if face is None or column is None or face.properties[column].code in "fd":
        raise ReadError(
            "the header has no element 'face' with a list of whole numbers 'vertex_indices': expected a surface with "
            "faces, not points or strips"
        )
    points = [[row[axis][0] for axis in axes if axis is not None] for row in rows["vertex"]]
    return indexed_polygons(
        points, [row[column] for row in rows["face"]], first=0, name=lambda i: f"face {i}"
    )


def _header(header: bytes) -> tuple[str, list[_Element]]:
    """Byte order ("" for ASCII, else that of `struct`) and the elements, in the order of the file."""
    order: str | None = None
    elements: list[_Element] = []
    for number, line in numbered_lines(header):
        match line.split():
            case ["ply"] | ["end_header"] | ["comment" | "obj_info", *_]:
                pass
            case ["format", name, "1.0"] if name in _BYTE_ORDERS:
                order = _BYTE_ORDERS[name]
            case ["element", name, count] if count.isdecimal():
                elements.append(_Element(name, int(count)))
            case ["property", "list", count, code, name] if elements and count in _COUNTS and code in _CODES:
                elements[-1].properties.append(_Property(name, _CODES[code], _CODES[count]))
            case ["property", code, name] if elements and code in _CODES:
                elements[-1].properties.append(_Property(name, _CODES[code]))
            case _:
                raise ReadError(f"line {number}: {line[:60]!r} does not belong in a PLY header")
    if order is None:
        raise ReadError(f"the header states no format, expected one of {', '.join(_BYTE_ORDERS)} and 1.0")
    return order, elements


def _rows(elements: list[_Element], read_row: Callable[[_Element], Row]) -> dict[str, list[Row]]:
    """All rows of each element. Raises ReadError where the file ends too early."""
    rows: dict[str, list[Row]] = {}
    for element in elements:
        rows[element.name] = []
        for done in range(element.count):
            try:
                rows[element.name].append(read_row(element))
            except (StopIteration, struct.error):  # the end of the file, or a negative count
                raise ReadError(
                    f"truncated: the header states {element.count:,} of '{element.name}', the file ends after {done:,}: copy "
                    "or export it again"
                ) from None
    return rows


def _text_row(line: int, words: list[str], element: _Element) -> Row:
    """An element from the words of its line. Raises ReadError."""
    row: Row = []
    used = 0
    for p in element.properties:
        count = 1
        if p.count_code is not None and used < len(words):
            count = parse_index(words[used], line)
            used += 1
        parse = parse_number if p.code in "fd" else parse_index
        row.append(tuple(parse(word, line) for word in words[used : used + max(count, 0)]))
        used += count
    if used != len(words):
        raise ReadError(f"line {line}: {len(words)} numbers, expected {used} of a {element.name}")
    return row


def _binary_row(stream: BinaryIO, order: str, element: _Element) -> Row:
    """The element that follows in the stream. Raises struct.error at its end."""

    def take(code: str, count: int) -> tuple[Any, ...]:
        layout = f"{order}{count}{code}"
        return struct.unpack(layout, stream.read(struct.calcsize(layout)))

    return [take(p.code, 1 if p.count_code is None else take(p.count_code, 1)[0]) for p in element.properties]
