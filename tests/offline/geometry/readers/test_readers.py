"""Dialects of surface files that real programs write, each holding the same tetrahedron; and what damaged files get."""

from __future__ import annotations

import random
import struct
from pathlib import Path

import numpy as np
import pytest

from palpate.geometry.readers import READERS, Polygons, ReadError, read_polygons

CORNERS = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], float)
FACES = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
POINTS = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\n"


def ascii_stl(name: str = "organ", end: str = "endsolid") -> str:
    lines = [f"solid {name}"]
    for face in FACES:
        lines += ["  facet normal 0 0 nan", "    outer loop"]
        lines += ["      vertex {:e} {:e} {:e}".format(*CORNERS[c]) for c in face]
        lines += ["    endloop", "  endfacet"]
    return "\n".join([*lines, end, ""])


def binary_stl(header: bytes = b"made by a scanner") -> bytes:
    records = b"".join(
        struct.pack("<12fH", 0, 0, 0, *CORNERS[face].ravel(), 0xFFFF) for face in FACES.tolist()
    )
    return header.ljust(80, b"\0") + struct.pack("<I", len(FACES)) + records


def ply_header(format_: str, vertex: str = "", face: str = "property list uchar int vertex_indices") -> str:
    return (
        f"ply\nformat {format_} 1.0\ncomment é by hand\nobj_info x\nelement vertex 4\nproperty float x\nproperty float y\n"
        f"property float z\n{vertex}element face 4\n{face}\nend_header\n"
    )


def ascii_ply(name: str = "vertex_indices") -> str:
    rows = [" ".join(str(x) for x in p) for p in CORNERS] + ["3 {} {} {}".format(*f) for f in FACES]
    header = ply_header("ascii", face=f"property list uchar int {name}")
    return header + "\n".join(rows) + "\n"


def binary_ply(order: str) -> bytes:
    """With a color and a quality, a list before the indices and counts of another type, as scanners write them."""
    name = {"<": "binary_little_endian", ">": "binary_big_endian"}[order]
    header = ply_header(
        name,
        vertex="property uchar red\nproperty double quality\n",
        face="property list uchar float texcoord\nproperty list int uint vertex_index\nproperty short label",
    )
    vertices = b"".join(struct.pack(order + "3fBd", *p, 7, 0.5) for p in CORNERS)
    faces = b"".join(struct.pack(order + "B2fi3Ih", 2, 0.1, 0.2, 3, *f, -1) for f in FACES.tolist())
    return header.encode("latin-1") + vertices + faces


OFF = "0 0 0\n1 0 0\n0 1 0\n0 0 1\n3 0 2 1\n3 0 1 3\n3 0 3 2\n3 1 2 3\n"
LEGACY = (
    "# vtk DataFile Version 3.0\nby hand\nASCII\nDATASET POLYDATA\nPOINTS 4 float\n0 0 0 1 0 0\n0 1 0 0 0 1\n"
    "POLYGONS 4 16\n3 0 2 1\n3 0 1 3\n3 0 3 2\n3 1 2 3\n"
)


WRITTEN_BY_VTK = Path(__file__).parents[3] / "data" / "vtk"
"""The tetrahedron as VTK 9.7 writes it."""


def vtp(name: str) -> bytes:
    return (WRITTEN_BY_VTK / f"{name}.vtp").read_bytes()


TWO_PIECES = b"""<VTKFile type="PolyData" version="1.0" byte_order="LittleEndian"><PolyData>
<Piece NumberOfPoints="4" NumberOfPolys="3"><Points>
<DataArray type="Float64" NumberOfComponents="3" format="ascii">0 0 0 1 0 0 0 1 0 0 0 1</DataArray></Points><Polys>
<DataArray type="Int32" Name="connectivity" format="ascii">0 2 1 0 1 3 0 3 2</DataArray>
<DataArray type="UInt8" Name="offsets" format="ascii">3 6 9</DataArray></Polys></Piece>
<Piece NumberOfPoints="3" NumberOfPolys="1"><Points>
<DataArray type="Float32" NumberOfComponents="3" format="ascii">1 0 0 0 1 0 0 0 1</DataArray></Points><Polys>
<DataArray type="Int32" Name="connectivity" format="ascii">0 1 2</DataArray>
<DataArray type="UInt8" Name="offsets" format="ascii">3</DataArray></Polys></Piece>
</PolyData></VTKFile>"""

DIALECTS: dict[str, bytes] = {
    "ascii.stl": ascii_stl().encode(),
    "name in Latin-1.stl": ascii_stl("Stra\u00dfe").encode("latin-1"),
    "name in UTF-8 with mark.stl": ascii_stl("Stra\u00dfe").encode("utf-8-sig"),
    "no name.stl": ascii_stl("").encode(),
    "no endsolid.stl": ascii_stl(end="").encode(),
    "end solid.stl": ascii_stl(end="end solid").replace("endfacet", "end facet").encode(),
    "capitals.stl": ascii_stl().upper().encode(),
    "CRLF.stl": ascii_stl().replace("\n", "\r\n").encode(),
    "CR.stl": ascii_stl().replace("\n", "\r").encode(),
    "binary.stl": binary_stl(),
    "binary, header begins with solid.stl": binary_stl(b"solid facet exported by a program\n"),
    "two solids.stl": "\n".join(
        [*ascii_stl().splitlines()[:15], "endsolid", "solid b", *ascii_stl().splitlines()[15:]]
    ).encode(),
    "plain.obj": (POINTS + "f 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n").encode(),
    "negative.obj": (POINTS + "f -4 -2 -3\nf -4 -3 -1\nf -4 -1 -2\nf -3 -2 -1\n").encode(),
    "textures and normals.obj": (
        "mtllib a.mtl\no Liver\u00df\n" + POINTS + "vt 0 0\nvn 0 0 1\ng left\nusemtl red\ns off\n"
        "f 1/1/1 3/1/1 2/1/1\nf 1//1 2//1 4//1\nf 1/1 4/1 3/1\nf 2 3 4\nl 1 2\np 1\n"
    ).encode("latin-1"),
    "continued lines, comments, CRLF.obj": (
        "# Blender\n" + POINTS + "f 1 \\\n3 \\\n2 # first\nf 1 2 4\n\nf 1 4 3\n  f 2 3 4\n"
    ).replace("\n", "\r\n").encode(),
    "colors and weights.obj": (
        b"v 0 0 0 1 0 0\nv 1 0 0 1.0\nv 0 1 0 0.5 0.5 0.5\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4"
    ),
    "faces before their vertices.obj": ("f 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n" + POINTS).encode(),
    "ascii.ply": ascii_ply().encode("latin-1"),
    "vertex_index.ply": ascii_ply("vertex_index").encode("latin-1"),
    "CRLF.ply": ascii_ply().replace("\n", "\r\n").encode("latin-1"),
    "little endian.ply": binary_ply("<"),
    "big endian.ply": binary_ply(">"),
    "plain.off": f"OFF\n4 4 6\n{OFF}".encode(),
    "counts in the first line, no edges.off": f"OFF 4 4\n{OFF}".encode(),
    "comments, CRLF.off": f"# by hand\nOFF # here\n\n4 4 0 # counts\n{OFF}".replace("\n", "\r\n").encode(),
    "colors.off": f"COFF\n4 4 6\n{OFF}".replace("0 0 1\n", "0 0 1 0.5 0.5 0.5 1\n").replace("3\n", "3 255 0 0\n").encode(),
    "by hand.vtk": LEGACY.encode(),
    "two pieces.vtp": TWO_PIECES,
    **{path.name: path.read_bytes() for path in sorted(WRITTEN_BY_VTK.iterdir())},
}  # fmt: skip


@pytest.mark.parametrize("name", DIALECTS)
def test_each_dialect_gives_the_same_faces(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    path.write_bytes(DIALECTS[name])
    polygons = read_polygons(path)
    np.testing.assert_array_equal(polygons.sizes, [3, 3, 3, 3])
    np.testing.assert_array_equal(polygons.vertices[polygons.corners].reshape(4, 3, 3), CORNERS[FACES])
    assert polygons.first == (1 if name.endswith(("stl", "obj")) else 0)
    assert polygons.indexed == (not name.endswith("stl"))


REFUSED: dict[str, tuple[bytes, str]] = {
    "short.stl": (binary_stl()[:-20], "its header states 4 triangles, it holds 3"),
    "long.stl": (binary_stl() + b"12345", "its header states 4 triangles, there is room for 4.1"),
    "cut.stl": ("\n".join(ascii_stl().splitlines()[:19]).encode(), "truncated: line 19, .* triangle 3"),
    "comma.stl": (ascii_stl().replace("1.0", "1,0").encode(), "line 5: '1,0.*' has a decimal comma: .*sed"),
    "word.stl": (ascii_stl().replace("vertex 0.0", "vertex zero", 1).encode(), "line 4: .* is not a number"),
    "infinite.stl": (ascii_stl().replace("vertex 0.000000e+00", "vertex inf", 1).encode(), "line 4: .* finite coordinate"),
    "quads.stl": (
        ascii_stl().replace("endloop", "vertex 1 1 1\nendloop", 1).encode(),
        "line 9: a facet with 4 vertices",
    ),
    "utf16.stl": (ascii_stl().encode("utf-16"), "UTF-16"),
    "beyond.obj": ((POINTS + "f 1 3 2\n\nf 1 2 9\n").encode(), "line 7: a face names vertex 9, .* 4 vertices"),
    "zero.obj": ((POINTS + "f 0 1 2\n").encode(), "line 5: a face names vertex 0, .* counted from 1"),
    "before.obj": ((POINTS + "f -5 1 2\n").encode(), "line 5: a face names vertex -5"),
    "two.obj": ((POINTS + "f 1 2\n").encode(), "line 5: a face with 2 vertices"),
    "flat.obj": (b"v 0 0\n", "line 1: a vertex with 2 coordinates"),
    "fraction.obj": ((POINTS + "f 1 2 3.5\n").encode(), "line 5: '3.5' is not a whole number"),
    "huge.obj": (b"v 0 0 1e300\n", "line 1: .* finite coordinate"),
    "points.ply": (
        b"ply\nformat ascii 1.0\nelement vertex 0\nproperty float x\nproperty float y\nproperty float z\nend_header\n",
        "no element 'face'",
    ),
    "short.ply": (ascii_ply().rsplit("3 1", 1)[0].encode("latin-1"), "states 4 of 'face', the file ends after 3"),
    "long.ply": ((ascii_ply() + "3 0 1 2\n").encode("latin-1"), "line 20: more lines"),
    "word.ply": (ascii_ply().replace("3 0 2 1", "3 0 2 x").encode("latin-1"), "line 16: 'x'"),
    "count.ply": (ascii_ply().replace("3 0 2 1", "4 0 2 1").encode("latin-1"), "line 16: 4 numbers, expected 5"),
    "beyond.ply": (ascii_ply().replace("3 0 2 1", "3 0 2 4").encode("latin-1"), "face 0 names vertex 4"),
    "type.ply": (ascii_ply().replace("float y", "quad y").encode("latin-1"), "line 7: 'property quad y'"),
    "counts.ply": (
        ply_header("binary_little_endian", face="property list float int vertex_indices").encode("latin-1"),
        "line 10: 'property list float int vertex_indices'",
    ),
    "binary.ply": (binary_ply(">")[:-3], "states 4 of 'face', the file ends after 3"),
    "surplus.ply": (binary_ply("<") + b"xx", "2 bytes more"),
    "none.off": (OFF.encode(), "expected 'OFF' in the first line"),
    "four.off": (b"4OFF\n", "expected 'OFF' in the first line"),
    "short.off": (f"OFF\n4 4 6\n{OFF[:-8]}".encode(), "states 4 faces, the file has 3"),
    "long.off": (f"OFF\n4 3 6\n{OFF}".encode(), "line 10: more lines"),
    "beyond.off": (f"OFF\n4 4 6\n{OFF}".replace("3 1 2 3", "3 1 2 4").encode(), "line 10: a face names vertex 4"),
    "count.off": (f"OFF\n4 4 6\n{OFF}".replace("3 1 2 3", "4 1 2 3").encode(), "line 10: a face of 4 vertices"),
    "comma.off": (f"OFF\n4 4 6\n{OFF}".replace("1 0 0", "1,5 0 0").encode(), "line 4: '1,5' has a decimal comma"),
    "short.vtk": (LEGACY[:-8].encode(), "truncated: line 11 states 16 numbers, the file ends after 12"),
    "fewer.vtk": (LEGACY.replace("POLYGONS 4", "POLYGONS 3").encode(), "line 8 states 3 cells .* 4 fit"),
    "beyond.vtk": (LEGACY.replace("3 1 2 3", "3 1 2 4").encode(), "polygon 3 names vertex 4"),
    "count.vtk": (LEGACY.replace("3 1 2 3", "4 1 2 3").encode(), "line 8 states 4 cells .* 3 fit"),
    "comma.vtk": (LEGACY.replace("1 0 0", "1,5 0 0").encode(), "line 6: '1,5' has a decimal comma"),
    "grid.vtk": (LEGACY.replace("POLYDATA", "UNSTRUCTURED_GRID").encode(), "expected DATASET POLYDATA, .*Extract Surface"),
    "strips.vtk": (LEGACY.replace("POLYGONS", "TRIANGLE_STRIPS").encode(), "line 8: triangle strips, .*Triangulate"),
    "short.vtp": (vtp("ascii")[:-300], "truncated or damaged: the XML"),
    "cut.vtp": (vtp("appended")[:-100], "truncated or damaged: array 'connectivity': it ends after 66 of 100 bytes"),
    "more.vtp": (vtp("ascii").replace(b'Polys="4"', b'Polys="5"'), "states 5 polygons, its arrays hold 4"),
    "beyond.vtp": (TWO_PIECES.replace(b">0 1 2<", b">0 1 3<"), "polygon 3 names vertex 7"),
    "lz4.vtp": (vtp("base64, zlib").replace(b"vtkZLibData", b"vtkLZ4Data"), "compressor = 'vtkLZ4DataCompressor'"),
    "image.vtp": (b'<VTKFile type="ImageData"/>', 'expected <VTKFile type="PolyData">'),
    "liver.step": (b"ISO-10303-21;", r"expected a file that ends in \.stl, \.obj, \.ply"),
}  # fmt: skip


@pytest.mark.parametrize("name", REFUSED)
def test_a_damaged_file_is_refused_with_the_line_or_the_count(tmp_path: Path, name: str) -> None:
    data, message = REFUSED[name]
    path = tmp_path / name
    path.write_bytes(data)
    with pytest.raises(ReadError, match=message):
        read_polygons(path)


@pytest.mark.parametrize("name", DIALECTS)
def test_a_damaged_file_never_ends_in_another_error(name: str) -> None:
    data, read = DIALECTS[name], READERS[Path(name).suffix]
    noise = random.Random(name)
    changed = [data[:cut] for cut in range(0, len(data), 3)]
    for _ in range(150):
        damaged = bytearray(data)
        for _ in range(noise.choice((1, 4))):
            damaged[noise.randrange(len(data))] = noise.randrange(256)
        changed.append(bytes(damaged))
    for case in changed:
        try:
            assert isinstance(read(case), Polygons)
        except ReadError as error:
            assert str(error)


@pytest.mark.parametrize("name", ["binary.stl", "little endian.ply", "big endian.ply"])
def test_every_binary_file_that_is_cut_short_is_refused(name: str) -> None:
    data, read = DIALECTS[name], READERS[Path(name).suffix]
    for length in range(len(data)):
        with pytest.raises(ReadError):
            read(data[:length])


@pytest.mark.parametrize("path", sorted(WRITTEN_BY_VTK.iterdir()), ids=lambda path: str(path.name))
def test_a_vtk_file_that_is_cut_short_is_refused_or_has_lost_no_number(path: Path) -> None:
    data, read = path.read_bytes(), READERS[path.suffix]
    whole = read(data)
    for length in range(0, len(data), 5):
        try:
            polygons = read(data[:length])
        except ReadError:
            continue
        np.testing.assert_array_equal(polygons.corners, whole.corners)
        np.testing.assert_array_equal(polygons.vertices, whole.vertices)
