"""Mends a triangle surface until it bounds one body, and says what was changed."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import igl
import igl.predicates
import numpy as np
from numpy.typing import NDArray

from palpate.geometry.cloud import TriangleSurface
from palpate.geometry.holes import close, rims
from palpate.geometry.measures import enclosed_volume, triangle_normals
from palpate.geometry.ply import ply_bytes
from palpate.geometry.readers import Polygons, ReadError, read_polygons
from palpate.geometry.readers.ply import read_ply
from palpate.geometry.soundness import SurfaceError, edges_of, flat_triangles
from palpate.geometry.surface import from_polygons
from palpate.geometry.triangulation import MERGE_TOLERANCE, triangulate, weld

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

_CRUMB = 0.1
"""A piece with less than this fraction of the body's area is left out. A larger one may be what was meant."""
_CAVITY = 1e-3
"""A piece inside the body is a cavity if it has this fraction of its volume, else a crumb."""
_LARGEST_HOLES = 0.25
"""Holes with more than this fraction of the surface are not closed: what is there is a sheet, not a body."""
_FLIP_PASSES = 20
_BY_HAND = "To mend it by hand: Blender: the modifier Remesh with mode Voxel makes one closed surface of what is there"


@dataclass
class Repair:
    """A surface while it is mended.

    vertices   (n_vertices, 3), in the file's unit
    triangles  (n_triangles, 3)
    changes    a sentence each, for the user
    """

    vertices: Array
    triangles: Indices
    changes: list[str] = field(default_factory=list)

    @property
    def surface(self) -> TriangleSurface:
        return TriangleSurface(self.vertices, self.triangles.astype(np.int32))

    @property
    def volume(self) -> float:
        """Of the file's unit cubed; about that where the surface is open."""
        return enclosed_volume(self.surface)

    def largest_piece(self) -> Repair:
        """The piece with the largest volume."""
        n_pieces, piece = igl.facet_components(self.triangles)
        parts = [Repair(self.vertices, self.triangles[piece == p]) for p in range(n_pieces)]
        return max(parts, key=lambda part: part.volume)

    def keep(self, kept: NDArray[np.bool_]) -> None:
        self.triangles = self.triangles[kept]


def repair_surface(path: Path) -> tuple[bytes, list[str]]:
    """A PLY file, in the unit of the given one, of a surface that `load_surface` accepts; and what was changed.

    Raises FileNotFoundError, and SurfaceError with what could not be mended.
    """
    try:
        polygons = read_polygons(path)
        if len(polygons.sizes) == 0:
            raise ReadError("the surface is empty: expected faces")
        mended = _welded(polygons)
    except ReadError as error:
        raise SurfaceError(f"{path}: {error}") from error
    before = f"{len(mended.triangles):,} triangles that enclose {mended.volume:.6g} of the file's unit cubed"
    try:
        mend(mended)
        data = ply_bytes(mended.vertices, mended.triangles)
        from_polygons(read_ply(data), "m", _BY_HAND)
    except (SurfaceError, ReadError, ValueError) as error:
        lines = [f"{path}: could not be mended: {line}" for line in str(error).splitlines()]
        raise SurfaceError("\n".join(lines)) from error
    after = f"{len(mended.triangles):,} triangles that enclose {mended.volume:.6g}"
    return data, [*(mended.changes or ["nothing to mend"]), f"from {before} to {after}"]


def _welded(polygons: Polygons) -> Repair:
    """The triangles, with vertices merged within the least tolerance that closes the most edges."""
    triangles, owner = triangulate(polygons)
    diagonal = float(np.linalg.norm(np.ptp(polygons.vertices[polygons.corners], axis=0)))
    best, fewest, used = None, np.inf, 0.0
    for tolerance in (MERGE_TOLERANCE, 10 * MERGE_TOLERANCE, 100 * MERGE_TOLERANCE):
        welded = weld(polygons.vertices, triangles, owner, tolerance * diagonal)
        n_open = np.sum(edges_of(welded.triangles)[1] == 1)
        if n_open < fewest:
            best, fewest, used = welded, n_open, tolerance * diagonal
    assert best is not None
    changes = []
    if best.n_merged:
        changes.append(f"merged {best.n_merged:,} vertices with others within {used:.2g} of the file's unit")
    if best.n_dropped:
        changes.append(f"left out {best.n_dropped:,} triangles that had two corners at one place")
    return Repair(best.vertices, best.triangles, changes)


def mend(mended: Repair) -> None:
    """Mend all that can be mended. Raises ValueError naming what can't."""
    _drop_duplicates(mended)
    _orient(mended)
    _flip_flat(mended)
    for n_rings in range(4):
        _keep_body(mended)
        _close_holes(mended)
        _turn_outward(mended)
        crossing = _crossing(mended, n_rings)
        if not crossing.any():
            return
        mended.keep(~crossing)
        mended.changes.append(
            f"cut out {crossing.sum():,} triangles that intersect others, with {n_rings} rings of neighbors"
        )


def _drop_duplicates(mended: Repair) -> None:
    _, first = np.unique(np.sort(mended.triangles, axis=1), axis=0, return_index=True)
    if dropped := len(mended.triangles) - len(first):
        mended.triangles = mended.triangles[np.sort(first)]
        mended.changes.append(f"left out {dropped:,} triangles with the vertices of another one")


def _orient(mended: Repair) -> None:
    """Separate what hangs together by edges of more than two triangles, and orient each piece."""
    _, counts, _ = edges_of(mended.triangles)
    if n_edges := int(np.sum(counts > 2)):
        mended.changes.append(f"cut the surface at {n_edges:,} edges with more than two triangles")
    # Edges that two triangles run alike count as not manifold for the split, so it comes second.
    oriented, _ = igl.bfs_orient(np.ascontiguousarray(mended.triangles))
    if turned := _count_turned(mended.triangles, oriented):
        mended.changes.append(f"turned {turned:,} triangles against their neighbors")
    mended.triangles = oriented
    _split(mended)
    mended.triangles, _ = igl.bfs_orient(mended.triangles)


def _split(mended: Repair) -> None:
    """Give each sheet its own vertices where sheets meet in an edge or in a point."""
    vertices, triangles, _ = igl.split_nonmanifold(mended.vertices, np.ascontiguousarray(mended.triangles))
    mended.vertices, mended.triangles = vertices, triangles


def _count_turned(before: Indices, after: Indices) -> int:
    """How many triangles run the other way; the fewer of the turned and the others, as all may be turned back."""
    position = np.argmax(after == before[:, :1], axis=1)
    following = np.take_along_axis(after, ((position + 1) % 3)[:, None], axis=1)[:, 0]
    turned = int(np.sum(following != before[:, 1]))
    return min(turned, len(before) - turned)


def _flip_flat(mended: Repair) -> None:
    """Exchange the longest edge of each triangle without area for the other diagonal of the two triangles on it."""
    n_flipped = n_dropped = 0
    for _ in range(_FLIP_PASSES):
        flat = np.flatnonzero(flat_triangles(mended.surface))
        if len(flat) == 0:
            break
        triangles = mended.triangles
        owners: dict[tuple[int, int], int] = {}
        for t, (a, b, c) in enumerate(triangles.tolist()):
            owners |= {(a, b): t, (b, c): t, (c, a): t}
        changed: set[int] = set()
        dropped: list[int] = []
        for t in flat.tolist():
            corners = triangles[t]
            lengths = np.linalg.norm(mended.vertices[np.roll(corners, -1)] - mended.vertices[corners], axis=1)
            a, b, c = np.roll(corners, -int(np.argmax(lengths))).tolist()
            other = owners.get((b, a))
            if other is None:
                dropped.append(t)
            elif not changed & {t, other}:
                (d,) = set(triangles[other].tolist()) - {a, b}
                if (c, d) in owners or (d, c) in owners:
                    continue
                triangles[t], triangles[other] = (a, d, c), (d, b, c)
                changed |= {t, other}
                n_flipped += 1
        n_dropped += len(dropped)
        mended.triangles = np.delete(triangles, dropped, axis=0)
        if not changed and not dropped:
            break
    if n_flipped or n_dropped:
        mended.changes.append(
            f"removed triangles without area: {n_flipped:,} by exchanging an edge, {n_dropped:,} left out"
        )


def _keep_body(mended: Repair) -> None:
    """Leave out crumbs: all pieces but the largest and its cavities. Raises ValueError if another one is large."""
    _split(mended)
    if len(mended.triangles) == 0:
        raise ValueError("no triangle is left: the surface encloses no body")
    n_pieces, piece = igl.facet_components(mended.triangles)
    if n_pieces == 1:
        return
    _, areas = triangle_normals(mended.surface)
    area = np.bincount(piece, areas)
    body = int(np.argmax(area))
    shell = mended.triangles[piece == body]
    volume = abs(enclosed_volume(TriangleSurface(mended.vertices, shell.astype(np.int32))))
    kept = piece == body
    crumbs = []
    for other in np.flatnonzero(np.arange(n_pieces) != body).tolist():
        part = mended.triangles[piece == other]
        held = abs(enclosed_volume(TriangleSurface(mended.vertices, part.astype(np.int32))))
        inside = _is_inside(mended.vertices, part, shell)
        if inside and held > _CAVITY * volume:
            kept |= piece == other
        elif area[other] > _CRUMB * area[body]:
            size = f"{len(part):,} triangles and {100 * area[other] / area[body]:.3g} % of the area of the largest"
            raise ValueError(
                f"a sheet inside the body encloses nothing: it has {size}. Remove it, or close it into a cavity"
                if inside
                else f"the file holds more than one body: the second has {size}. Export the one that is meant"
            )
        else:
            crumbs.append(len(part))
    if crumbs:
        mended.changes.append(
            f"left out pieces apart from the body: {len(crumbs):,}, of {sum(crumbs):,} triangles in all"
        )
    mended.keep(kept)


def _is_inside(vertices: Array, part: Indices, shell: Indices) -> bool:
    places = np.ascontiguousarray(vertices[part].mean(axis=1)[:100])
    return bool(
        np.median(np.abs(igl.fast_winding_number(vertices, np.ascontiguousarray(shell), places))) > 0.5
    )


def _close_holes(mended: Repair) -> None:
    found = rims(mended.triangles)
    if not found:
        return
    _, areas = triangle_normals(mended.surface)
    caps = [close(mended.vertices, rim) for rim in found]
    _, new = triangle_normals(TriangleSurface(mended.vertices, np.vstack(caps).astype(np.int32)))
    if new.sum() > _LARGEST_HOLES * areas.sum():
        raise ValueError(
            f"the surface is open: its {len(found):,} holes have {100 * new.sum() / areas.sum():.3g} % of its area, expected "
            f"at most {100 * _LARGEST_HOLES:g} % of a body with holes"
        )
    mended.triangles = np.vstack([mended.triangles, *caps])
    mended.changes.append(
        f"closed holes: {len(found):,}, of {sum(map(len, found)):,} edges and an area of "
        f"{new.sum():.4g} of the file's unit squared in all, {100 * new.sum() / areas.sum():.2g} % of the surface"
    )


def _turn_outward(mended: Repair) -> None:
    """The body outward, its cavities inward."""
    n_pieces, piece = igl.facet_components(mended.triangles)
    volumes = [
        enclosed_volume(TriangleSurface(mended.vertices, mended.triangles[piece == p].astype(np.int32)))
        for p in range(n_pieces)
    ]
    body = int(np.argmax(np.abs(volumes)))
    for p, volume in enumerate(volumes):
        if (volume > 0) != (p == body):
            mended.triangles[piece == p] = mended.triangles[piece == p][:, ::-1]
            mended.changes.append(f"turned {np.sum(piece == p):,} triangles, as they were inside-out")


def _crossing(mended: Repair, n_rings: int) -> NDArray[np.bool_]:
    """(n_triangles,): those that intersect others, and those around them."""
    found, pairs, _ = igl.predicates.find_self_intersections(
        np.ascontiguousarray(mended.vertices), np.ascontiguousarray(mended.triangles)
    )
    crossing = np.zeros(len(mended.triangles), bool)
    if found:
        crossing[pairs.ravel()] = True
        for _ in range(n_rings):
            near = np.zeros(len(mended.vertices), bool)
            near[mended.triangles[crossing]] = True
            crossing = np.asarray(near[mended.triangles].any(axis=1))
    return crossing
