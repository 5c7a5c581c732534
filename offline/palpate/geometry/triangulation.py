"""Split the faces of a surface file into triangles, and merge vertices at the same place."""

from __future__ import annotations

from dataclasses import dataclass

import mapbox_earcut
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from palpate.geometry.readers import Polygons, ReadError

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

MERGE_TOLERANCE = 1e-6
"""Vertices closer than this fraction of the body's diagonal are merged: most programs write six digits."""


def triangulate(polygons: Polygons) -> tuple[Indices, Indices]:
    """Triangles (n_triangles, 3) over the polygons' vertices, and the index of the polygon that each belongs to (n_triangles,).

    A quadrilateral is cut along a diagonal inside it, a polygon with more corners by ear clipping: concave polygons keep
    their outline. Raises ReadError naming a polygon that crosses itself.
    """
    start = np.cumsum(polygons.sizes) - polygons.sizes
    simple, quads, others = (
        np.flatnonzero(c) for c in (polygons.sizes == 3, polygons.sizes == 4, polygons.sizes > 4)
    )
    triangles = [polygons.corners[start[simple, None] + np.arange(3)]]
    corners = polygons.corners[start[quads, None] + np.arange(4)]
    halves, crossed = _cut_quads(polygons.vertices[corners])
    triangles.append(np.take_along_axis(corners, halves.reshape(-1, 6), axis=1).reshape(-1, 3))
    owners = [simple, np.repeat(quads, 2)]
    bad = quads[crossed].tolist()
    for face in others:
        corners = polygons.corners[start[face] : start[face] + polygons.sizes[face]]
        ears = _clip_ears(polygons.vertices[corners])
        if ears is None:
            bad.append(face)
        else:
            triangles.append(corners[ears])
            owners.append(np.full(len(ears), face))
    if bad:
        raise ReadError(
            f"{len(bad)} faces cross themselves, so that they can't be split into triangles, the first is face "
            f"{min(bad) + polygons.first}. To mend: Blender: delete the faces, then Mesh > Clean Up > Fill Holes"
        )
    owner = np.concatenate(owners)
    order = np.argsort(owner, kind="stable")
    return np.concatenate(triangles)[order], owner[order]


_DIAGONALS = np.array([[[0, 1, 2], [0, 2, 3]], [[0, 1, 3], [1, 2, 3]]])


def _cut_quads(quads: Array) -> tuple[Indices, NDArray[np.bool_]]:
    """Two triangles (n, 2, 3) of each quadrilateral (n, 4, 3), and whether it crosses itself (n,)."""
    normal = np.cross(quads[:, 2] - quads[:, 0], quads[:, 3] - quads[:, 1])
    a, b, c = np.moveaxis(quads[:, _DIAGONALS], 3, 0)  # (n, 2 diagonals, 2 triangles, 3)
    along = np.einsum("ndti,ni->ndt", np.cross(b - a, c - a), normal)
    smaller = along.min(axis=2)  # half of each cut, negative where it faces the other way
    best = np.argmax(smaller, axis=1)
    return _DIAGONALS[best], np.max(smaller, axis=1) < 0


def _clip_ears(outline: Array) -> Indices | None:
    """Triangles (n - 2, 3) of a nearly flat polygon (n, 3), with its orientation; None if it crosses itself."""
    following = np.vstack([outline[1:], outline[:1]])
    normal = np.cross(outline - outline[0], following - outline[0]).sum(axis=0)
    # Seen along the axis that is nearest to the normal, and from the side that it points to.
    axis = int(np.argmax(np.abs(normal)))
    plane = [(axis + 1) % 3, (axis + 2) % 3] if normal[axis] > 0 else [(axis + 2) % 3, (axis + 1) % 3]
    flat = np.ascontiguousarray((outline - outline[0])[:, plane])
    ears = mapbox_earcut.triangulate_float64(flat, np.array([len(flat)], np.uint32)).reshape(-1, 3)
    (ux, uy), (vx, vy) = (flat[ears[:, 1]] - flat[ears[:, 0]]).T, (flat[ears[:, 2]] - flat[ears[:, 0]]).T
    areas = (ux * vy - uy * vx) / 2
    enclosed = abs(normal[axis]) / 2
    if len(ears) != len(flat) - 2 or abs(np.abs(areas).sum() - enclosed) > 1e-9 * enclosed:
        return None
    return np.asarray(ears[:, ::-1] if areas.sum() < 0 else ears, np.int64)


@dataclass(frozen=True)
class Welded:
    """A triangle surface whose vertices are distinct.

    vertices   (n_vertices, 3), in the file's unit
    triangles  (n_triangles, 3), indices of vertices
    owner      (n_triangles,), the face of the file that each triangle belongs to
    original   (n_vertices,), a vertex of the file at this place
    n_merged   places that were merged with another one nearby
    n_dropped  triangles left out because two of their corners are at one place
    """

    vertices: Array
    triangles: Indices
    owner: Indices
    original: Indices
    n_merged: int
    n_dropped: int


def weld(vertices: Array, triangles: Indices, owner: Indices, tolerance: float) -> Welded:
    """Merge vertices no further apart than the tolerance, and drop vertices that no triangle uses."""
    used, corners = np.unique(triangles, return_inverse=True)
    places, first, place = np.unique(vertices[used], axis=0, return_index=True, return_inverse=True)
    pairs = cKDTree(places).query_pairs(tolerance, output_type="ndarray")
    graph = coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), (len(places), len(places)))
    n_clusters, cluster = connected_components(graph, directed=False)
    lowest = np.full(n_clusters, len(places))
    np.minimum.at(lowest, cluster, np.arange(len(places)))
    kept, merged = np.unique(lowest[cluster], return_inverse=True)
    index = merged[place.ravel()][corners.reshape(-1, 3)]
    whole = (index != np.roll(index, 1, axis=1)).all(axis=1)
    return Welded(
        vertices=places[kept],
        triangles=index[whole],
        owner=owner[whole],
        original=used[first[kept]],
        n_merged=len(places) - len(kept),
        n_dropped=int(np.sum(~whole)),
    )
