"""Surface files: STL, OBJ and PLY as polygons, each checked against the counts that the file itself states.

Raises `ReadError`, with the line or the count that is wrong. No library with a permissive license reads these formats
in double precision and says where a file is wrong, so the three readers are ours.
"""

from __future__ import annotations

from pathlib import Path

from palpate.geometry.readers.obj import read_obj
from palpate.geometry.readers.ply import read_ply
from palpate.geometry.readers.polygons import Polygons, ReadError
from palpate.geometry.readers.stl import read_stl

__all__ = ["READERS", "Polygons", "ReadError", "read_polygons"]

READERS = {".stl": read_stl, ".obj": read_obj, ".ply": read_ply}


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
