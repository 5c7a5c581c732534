"""Legacy VTK files, versions 1 to 5, ASCII and binary: the points and polygons of a PolyData. Attributes are skipped.

Format: The VTK User's Guide, "VTK File Formats", and VTK's documentation of version 5.1.
"""

from __future__ import annotations

import re
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.geometry.readers.polygons import Polygons, ReadError, indexed_polygons, parse_index, parse_number

_TYPES = {
    "unsigned_char": "u1", "char": "i1", "unsigned_short": "u2", "short": "i2", "unsigned_int": "u4", "int": "i4",
    "unsigned_long": "u8", "long": "i8", "vtktypeint64": "i8", "vtktypeint32": "i4", "vtkidtype": "i4",
    "float": "f4", "double": "f8",
}  # fmt: skip
_SKIPPED = ("vertices", "lines")
_ATTRIBUTES = ("point_data", "cell_data")


def read_vtk(data: bytes) -> Polygons:
    """The polygons of a legacy file with DATASET POLYDATA. Raises ReadError."""
    lines = _Lines(data)
    version = re.match(r"# vtk DataFile Version (\d+)\.\d", lines.next())
    title = lines.next(skip_empty=False)
    encoding, dataset = lines.next().strip().upper(), lines.next().upper().split()
    if not version or encoding not in ("ASCII", "BINARY") or dataset[:1] != ["DATASET"]:
        raise ReadError(
            "not a legacy VTK file: expected '# vtk DataFile Version', a title, ASCII or BINARY, and 'DATASET POLYDATA' "
            f"(title: {title[:40]!r})"
        )
    if dataset[1:] != ["POLYDATA"]:
        raise ReadError(
            f"line {lines.number}: {' '.join(dataset)[:60]}: expected DATASET POLYDATA, a surface. To mend: ParaView: "
            "Filters > Extract Surface, then save it as PLY"
        )
    lines.binary = encoding == "BINARY"
    points, faces = _polydata(lines, offsets=int(version[1]) >= 5)
    if not faces:
        raise ReadError("it has no POLYGONS: expected a surface")
    return indexed_polygons(points, faces, first=0, name=lambda face: f"polygon {face}")


class _Lines:
    """Reads the lines and the numbers of a file one after the other.

    number  of the last line, from 1; of a binary file, of the last line of text
    """

    def __init__(self, data: bytes) -> None:
        self.data, self.position, self.number, self.binary = data, 0, 0, False

    def next(self, skip_empty: bool = True) -> str:
        """The next line; empty at the end of the file."""
        while self.position < len(self.data):
            end = self.data.find(b"\n", self.position)
            end = len(self.data) if end < 0 else end
            line = self.data[self.position : end].decode("latin-1").strip()
            self.position, self.number = end + 1, self.number + 1
            if line or not skip_empty:
                return line
        return ""

    def numbers(self, count: int, type_name: str) -> NDArray[Any]:
        """(count,) numbers of a type in the file. Raises ReadError."""
        code = _TYPES.get(type_name.lower())
        if code is None:
            raise ReadError(f"line {self.number}: {type_name[:40]!r} is no type of VTK that holds numbers")
        real = code.startswith("f")
        if self.binary:
            end = self.position + count * int(code[1])
            if count < 0 or end > len(self.data):
                raise self._truncated(count, (len(self.data) - self.position) // int(code[1]))
            values = np.frombuffer(self.data[self.position : end], f">{code}")
            self.position = end
            return values.astype(np.float64 if real else np.int64)
        found: list[float] = []
        start = self.number
        while len(found) < count:
            words = self.next().split()
            if not words:
                raise self._truncated(count, len(found))
            found += [parse_number(w, self.number) if real else parse_index(w, self.number) for w in words]
        if len(found) > max(count, 0):
            raise ReadError(f"line {self.number}: {len(found):,} numbers, line {start} states {count:,}")
        return np.array(found, np.float64 if real else np.int64)

    def _truncated(self, stated: int, found: int) -> ReadError:
        return ReadError(
            f"truncated: line {self.number} states {stated:,} numbers, the file ends after {found:,}: copy or export it again"
        )


def _polydata(lines: _Lines, offsets: bool) -> tuple[NDArray[np.float64], list[list[float]]]:
    """Points (n, 3) and the vertices of each polygon."""
    points, faces = np.empty((0, 3)), []
    while line := lines.next():
        match line.lower().split():
            case ["metadata"]:
                while lines.next(skip_empty=False):
                    pass
            case ["points", count, type_name]:
                values = lines.numbers(3 * parse_index(count, lines.number), type_name)
                points = values.astype(np.float64).reshape(-1, 3)
            case ["polygons" | "vertices" | "lines" as kind, count, size]:
                n, total = parse_index(count, lines.number), parse_index(size, lines.number)
                cells = _cells_by_offset(lines, n, total) if offsets else _cells_by_size(lines, n, total)
                faces += [] if kind in _SKIPPED else cells
            case ["triangle_strips", *_]:
                raise ReadError(
                    f"line {lines.number}: triangle strips, expected polygons. To mend: ParaView: Filters > Triangulate, "
                    "then save it as PLY"
                )
            case ["field", _, count]:
                for _ in range(parse_index(count, lines.number)):
                    _skip_array(lines)
            case [word, *_] if word in _ATTRIBUTES:
                break
            case _:
                raise ReadError(f"line {lines.number}: {line[:60]!r} does not belong in a PolyData")
    return points, faces


def _cells_by_size(lines: _Lines, n: int, total: int) -> list[list[float]]:
    """n cells, each with its size before its vertices; `total` numbers in all."""
    line = lines.number
    values = lines.numbers(total, "int").tolist()
    cells, at = [], 0
    while at < len(values):
        size = int(values[at])
        if not 0 <= size < len(values) - at:
            break
        cells.append(values[at + 1 : at + 1 + size])
        at += 1 + size
    if at != len(values) or len(cells) != n:
        raise ReadError(
            f"line {line} states {n:,} cells of {total:,} numbers in all, {len(cells):,} fit into them"
        )
    return cells


def _cells_by_offset(lines: _Lines, n_offsets: int, n_corners: int) -> list[list[float]]:
    """The cells of version 5: where each begins and where the last one ends, then their vertices."""
    arrays = []
    for name, count in (("OFFSETS", n_offsets), ("CONNECTIVITY", n_corners)):
        match lines.next().split():
            case [word, type_name] if word.upper() == name:
                arrays.append(lines.numbers(count, type_name).astype(np.int64))
            case _:
                raise ReadError(f"line {lines.number}: expected {name} and a type")
    return split_cells(arrays[1], arrays[0])


def split_cells(corners: NDArray[np.int64], offsets: NDArray[np.int64]) -> list[list[float]]:
    """The vertices of each cell; offsets (n_cells + 1,) into corners, or empty. Raises ReadError."""
    if len(offsets) == 0 and len(corners) == 0:
        return []
    if len(offsets) == 0 or offsets[0] != 0 or offsets[-1] != len(corners) or np.any(np.diff(offsets) < 0):
        raise ReadError("damaged: the offsets of the cells do not run from 0 to the number of their vertices")
    values, ends = corners.tolist(), offsets.tolist()
    return [values[a:b] for a, b in pairwise(ends)]


def _skip_array(lines: _Lines) -> None:
    match lines.next().split():
        case [_, width, count, type_name]:
            lines.numbers(parse_index(width, lines.number) * parse_index(count, lines.number), type_name)
        case _:
            raise ReadError(f"line {lines.number}: expected name, width, count and type of an array")
