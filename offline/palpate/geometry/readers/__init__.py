"""Surface files: STL, OBJ, PLY, OFF, VTK and VTP as polygons, each checked against the counts that the file itself states.

Raises `ReadError`, with the line or the count that is wrong. No library with a permissive license reads STL, OBJ, PLY
and OFF in double precision and says where a file is wrong, so these readers are ours. VTK and VTP are read by VTK.
"""

from __future__ import annotations

from pathlib import Path

from palpate.geometry.readers.obj import read_obj
from palpate.geometry.readers.off import read_off
from palpate.geometry.readers.ply import read_ply
from palpate.geometry.readers.polygons import Polygons, ReadError
from palpate.geometry.readers.stl import read_stl
from palpate.geometry.readers.vtk_legacy import read_vtk
from palpate.geometry.readers.vtp import read_vtp

__all__ = ["READERS", "Polygons", "ReadError", "read_polygons"]

READERS = {
    ".stl": read_stl,
    ".obj": read_obj,
    ".ply": read_ply,
    ".off": read_off,
    ".vtk": read_vtk,
    ".vtp": read_vtp,
}


def read_polygons(path: Path) -> Polygons:
    """The polygons of a surface file. Raises FileNotFoundError, ReadError."""
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such surface file")
    reader = READERS.get(path.suffix.lower())
    if reader is None:
        raise ReadError(
            f"expected a file that ends in {', '.join(READERS)}, got {path.suffix or 'no ending'!r}"
        )
    return reader(path.read_bytes())
