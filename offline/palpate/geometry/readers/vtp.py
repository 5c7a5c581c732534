"""VTP, VTK's XML files of PolyData: the points and polygons of all pieces. Attributes are skipped.

ASCII, base64 and appended arrays; uncompressed, or compressed by zlib or LZMA. Format: VTK's documentation, "VTK XML
Formats".
"""

from __future__ import annotations

import base64
import binascii
import lzma
import re
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from palpate.geometry.readers.polygons import Polygons, ReadError, indexed_polygons
from palpate.geometry.readers.vtk_legacy import split_cells

_TYPES = {
    "Int8": "i1", "UInt8": "u1", "Int16": "i2", "UInt16": "u2", "Int32": "i4", "UInt32": "u4", "Int64": "i8",
    "UInt64": "u8", "Float32": "f4", "Float64": "f8",
}  # fmt: skip
_DECOMPRESS: dict[str, Callable[[bytes], bytes]] = {
    "vtkZLibDataCompressor": zlib.decompress,
    "vtkLZMADataCompressor": lzma.decompress,
}
_APPENDED = re.compile(rb"<AppendedData\b[^>]*encoding\s*=\s*[\"'](\w+)[\"'][^>]*>\s*_")


@dataclass(frozen=True)
class _Encoding:
    """How the arrays of a file are written.

    order       byte order, as of `struct`
    header      type of the sizes before each array
    decompress  None where arrays are not compressed
    appended    bytes of the appended arrays, after the underscore
    raw         whether these are bytes, else base64
    """

    order: str
    header: str
    decompress: Callable[[bytes], bytes] | None
    appended: bytes
    raw: bool


def read_vtp(data: bytes) -> Polygons:
    """The polygons of a VTP file. Raises ReadError."""
    appended = _APPENDED.search(data)
    text = data[: appended.start()] + b"</VTKFile>" if appended else data
    try:
        root = ElementTree.fromstring(text)
    except (ElementTree.ParseError, ValueError, LookupError) as error:
        raise ReadError(f"truncated or damaged: the XML can't be read: {error}") from error
    if root.tag != "VTKFile" or root.get("type") != "PolyData":
        raise ReadError(f'expected <VTKFile type="PolyData">, got <{root.tag} type={root.get("type")!r}>')
    if appended:
        encoding = _encoding(root, data[appended.end() :], raw=appended[1] == b"raw")
    else:
        encoding = _encoding(root, b"", raw=False)
    points: list[NDArray[np.float64]] = []
    faces: list[list[float]] = []
    for piece in root.iterfind("PolyData/Piece"):
        before = sum(len(p) for p in points)
        more, cells = _piece(piece, encoding)
        points.append(more)
        faces += [[corner + before for corner in cell] for cell in cells]
    if not points:
        raise ReadError("it has no <Piece>: expected <PolyData> with pieces")
    return indexed_polygons(np.vstack(points), faces, first=0, name=lambda face: f"polygon {face}")


def _encoding(root: ElementTree.Element, appended: bytes, raw: bool) -> _Encoding:
    compressor = root.get("compressor")
    if compressor is not None and compressor not in _DECOMPRESS:
        raise ReadError(
            f"compressor = {compressor[:60]!r}: expected one of {', '.join(_DECOMPRESS)}, or none: save it with another one"
        )
    orders = {"LittleEndian": "<", "BigEndian": ">"}
    order, header = root.get("byte_order", ""), root.get("header_type", "UInt32")
    if order not in orders or header not in ("UInt32", "UInt64"):
        raise ReadError(
            f"byte_order = {order[:40]!r}, header_type = {header[:40]!r}: expected LittleEndian or BigEndian, UInt32 or UInt64"
        )
    decompress = None if compressor is None else _DECOMPRESS[compressor]
    return _Encoding(orders[order], _TYPES[header], decompress, appended, raw)


def _piece(piece: ElementTree.Element, encoding: _Encoding) -> tuple[NDArray[np.float64], list[list[float]]]:
    """Points (n, 3) and the vertices of each polygon of a piece, as many as the piece states."""
    if piece.get("NumberOfStrips", "0").strip() != "0":
        raise ReadError(
            "it holds triangle strips, expected polygons. To mend: ParaView: Filters > Triangulate, then save it as PLY"
        )
    points = _array(piece, "Points/DataArray", encoding)
    if len(points) % 3:
        raise ReadError(f"the points have {len(points):,} coordinates, expected three each")
    corners, ends = (
        _array(piece, f"Polys/DataArray[@Name='{name}']", encoding) for name in ("connectivity", "offsets")
    )
    if corners.dtype.kind == "f" or ends.dtype.kind == "f":
        raise ReadError("the polygons' vertices and offsets are of type float: expected whole numbers")
    for what, key, found in (
        ("points", "NumberOfPoints", len(points) // 3),
        ("polygons", "NumberOfPolys", len(ends)),
    ):
        stated = piece.get(key, "").strip()
        if stated != str(found):
            raise ReadError(
                f"truncated or damaged: it states {stated[:20] or 'no number of'} {what}, its arrays hold {found:,}"
            )
    cells = split_cells(corners.astype(np.int64), np.concatenate([[0], ends]).astype(np.int64))
    return points.astype(np.float64).reshape(-1, 3), cells


def _array(piece: ElementTree.Element, path: str, encoding: _Encoding) -> NDArray[np.generic]:
    """The numbers of a DataArray of the piece; empty where there is none. Raises ReadError."""
    array = piece.find(path)
    if array is None:
        return np.empty(0, np.int64)
    name, form, kind = array.get("Name", "Points"), array.get("format"), _TYPES.get(array.get("type", ""))
    if kind is None:
        raise ReadError(
            f"array {name[:40]!r}: type = {array.get('type')!r}: expected one of {', '.join(_TYPES)}"
        )
    text = (array.text or "").strip()
    try:
        if form == "ascii":
            return np.array(text.split(), dtype=np.float64 if kind.startswith("f") else np.int64)
        if form == "binary":
            data = _decode(text.encode(), encoding, raw=False)
        elif form == "appended":
            start = int(array.get("offset", ""))
            if not 0 <= start < len(encoding.appended):
                raise ValueError(f"it begins at byte {start} of {len(encoding.appended):,} appended")
            data = _decode(encoding.appended[start:], encoding, raw=encoding.raw)
        else:
            raise ValueError(f"format = {form!r}: expected ascii, binary or appended")
        return np.frombuffer(data, encoding.order + kind)
    except (ValueError, OverflowError, binascii.Error, zlib.error, lzma.LZMAError, EOFError) as error:
        raise ReadError(f"truncated or damaged: array {name[:40]!r}: {error}") from error


def _decode(data: bytes, encoding: _Encoding, raw: bool) -> bytes:
    """The bytes of an array that begins `data`: decoded and decompressed. Raises ValueError where it is cut short."""
    size = int(encoding.header[1])

    def take(start: int, n_bytes: int) -> bytes:
        """Bytes of a block, or of the base64 text that begins at `start` of the data."""
        part = data[start : start + (n_bytes if raw else _text_length(n_bytes))]
        part = (part if raw else base64.b64decode(part, validate=True))[:n_bytes]
        if len(part) < n_bytes:
            raise ValueError(f"it ends after {len(part):,} of {n_bytes:,} bytes")
        return part

    def sizes(count: int) -> list[int]:
        header = np.frombuffer(take(0, count * size), encoding.order + encoding.header)
        return [int(value) for value in header]

    if encoding.decompress is None:
        (length,) = sizes(1)
        return take(0, size + length)[size:]
    n_blocks, *_ = sizes(1)
    if n_blocks * size > len(data):
        raise ValueError(f"it states {n_blocks:,} blocks in {len(data):,} bytes")
    lengths = sizes(3 + n_blocks)[3:]
    head = size * (3 + n_blocks)
    blocks = take(head if raw else _text_length(head), sum(lengths))
    ends = np.cumsum([0, *lengths]).tolist()
    return b"".join(encoding.decompress(blocks[a:b]) for a, b in pairwise(ends))


def _text_length(n_bytes: int) -> int:
    """Length of the base64 text of so many bytes."""
    return (n_bytes + 2) // 3 * 4
