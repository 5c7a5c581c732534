"""Loads the surface of a body from a file, and checks that it bounds one body."""

from __future__ import annotations

import shlex
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from palpate.geometry.cloud import TriangleSurface
from palpate.geometry.readers import Polygons, ReadError, read_polygons
from palpate.geometry.soundness import Naming, SurfaceError, check_surface
from palpate.geometry.triangulation import MERGE_TOLERANCE, triangulate, weld
from palpate.scene.quantities import LONGEST_M, SHORTEST_M, UNITS_M, LengthUnit


@dataclass(frozen=True)
class LoadedSurface:
    """A closed surface, and the changes that were made to the file's.

    notes  a sentence each, for the user
    """

    surface: TriangleSurface
    notes: tuple[str, ...]


def load_surface(path: Path, unit: LengthUnit = "m") -> LoadedSurface:
    """Read a closed surface from a file (STL, OBJ, PLY, OFF, VTK, VTP) whose coordinates are in the unit.

    Polygons are split into triangles. Vertices no further apart than `MERGE_TOLERANCE` of the body's diagonal are merged
    and unused ones dropped. Raises FileNotFoundError, and SurfaceError when the file can't be read, or with all that
    `check_surface` finds.
    """
    mended = f"{path.with_suffix('')}-mended.ply"
    mend = f"To mend: palpate repair {shlex.quote(str(path))} -o {shlex.quote(mended)}"
    try:
        loaded = from_polygons(read_polygons(path), unit, mend)
    except (ReadError, SurfaceError) as error:
        raise SurfaceError("\n".join(f"{path}: {line}" for line in str(error).splitlines())) from error
    return LoadedSurface(loaded.surface, tuple(f"{path}: {note}" for note in loaded.notes))


def from_polygons(polygons: Polygons, unit: LengthUnit, mend: str) -> LoadedSurface:
    """The closed surface of polygons whose coordinates are in the unit.

    mend  what to do about faults that `check_surface` finds: the end of their messages

    Raises ReadError, SurfaceError.
    """
    extent = _extent(polygons, unit)
    triangles, owner = triangulate(polygons)
    tolerance = MERGE_TOLERANCE * float(np.linalg.norm(extent))
    welded = weld(polygons.vertices, triangles, owner, tolerance)
    surface = TriangleSurface(welded.vertices * UNITS_M[unit], welded.triangles.astype(np.int32))
    naming = Naming(
        unit=unit,
        unit_m=UNITS_M[unit],
        vertices=welded.original + polygons.first if polygons.indexed else None,
        triangles=welded.owner + polygons.first,
        mend=mend,
    )
    check_surface(surface, naming)
    notes = []
    if welded.n_merged:
        notes.append(
            f"merged {welded.n_merged:,} vertices with others within {tolerance:.2g} {unit}, {MERGE_TOLERANCE:g} of "
            "the body's diagonal"
        )
    if welded.n_dropped:
        notes.append(f"left out {welded.n_dropped:,} triangles that had two corners at one place")
    return LoadedSurface(surface, tuple(notes))


def _extent(polygons: Polygons, unit: LengthUnit) -> NDArray[np.float64]:
    """(3,), in the file's unit. Raises ReadError unless it is that of a body: triangles of other sizes underflow."""
    if len(polygons.sizes) == 0:
        raise ReadError("the surface is empty: expected faces")
    extent = np.ptp(polygons.vertices[polygons.corners], axis=0)
    size_m = float(extent.max()) * UNITS_M[unit]
    if not SHORTEST_M <= size_m <= LONGEST_M:
        raise ReadError(
            f"the surface is {size_m:.3g} m across: expected {SHORTEST_M:g} to {LONGEST_M:g} m; check its unit, here {unit}"
        )
    return extent
