"""Closed triangle surfaces: reading them, measuring them, and refusing those that bound no body."""

from __future__ import annotations

from pathlib import Path

import igl.predicates
import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from palpate.geometry.cloud import TriangleSurface

Array = NDArray[np.float64]

_FORMATS = (".stl", ".obj", ".ply")


class SurfaceError(ValueError):
    """A surface doesn't bound one body; the message says what is wrong with it, how often, and where first."""


def load_surface(path: Path, unit_m: float = 1.0) -> TriangleSurface:
    """Read a closed surface from an STL, OBJ or PLY file.

    unit_m  length of the file's unit, m (0.001 for a file in millimeters)

    Vertices at the very same place are merged (an STL file repeats them) and unused ones dropped.
    Raises FileNotFoundError, and SurfaceError when the file can't be read or `check_surface` refuses it.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such surface file")
    if path.suffix.lower() not in _FORMATS:
        raise SurfaceError(f"{path}: expected one of {', '.join(_FORMATS)}")
    if not (np.isfinite(unit_m) and unit_m > 0):
        raise ValueError(f"unit_m = {unit_m}: expected a length above 0")
    try:
        mesh = trimesh.load_mesh(path, process=False)
        corners = np.asarray(mesh.vertices, dtype=np.float64)[np.asarray(mesh.faces, dtype=np.int64)]
    except Exception as error:  # the readers raise whatever they stumble over
        raise SurfaceError(f"{path}: can't be read as a triangle surface ({error})") from error
    vertices, index = np.unique(corners.reshape(-1, 3), axis=0, return_inverse=True)
    surface = TriangleSurface(vertices * unit_m, index.reshape(-1, 3).astype(np.int32))
    try:
        check_surface(surface)
    except SurfaceError as error:
        raise SurfaceError(f"{path}: {error}") from error
    return surface


def triangle_normals(surface: TriangleSurface) -> tuple[Array, Array]:
    """Unit normals (n_triangles, 3) and areas (n_triangles,), m²; the normal of a triangle without area is zero."""
    a, b, c = np.moveaxis(surface.vertices[surface.triangles], 1, 0)
    cross = np.cross(b - a, c - a)
    length = np.linalg.norm(cross, axis=1)
    return cross / np.where(length > 0, length, 1.0)[:, None], length / 2


def enclosed_volume(surface: TriangleSurface) -> float:
    """Volume within a closed surface, m³, by the divergence theorem; negative if it is inside-out."""
    corners = surface.vertices[surface.triangles] - surface.vertices.mean(axis=0)
    return float(np.sum(np.cross(corners[:, 0], corners[:, 1]) * corners[:, 2]) / 6)


def check_surface(surface: TriangleSurface) -> None:
    """Raise SurfaceError unless the surface bounds one solid body.

    That is: finite, not empty, no triangle without area, closed, manifold, consistently oriented, in one piece
    (so no cavities and no separate bodies), free of self-intersections, and with its normals pointing outward.
    The first of these that fails is named.
    """
    vertices, triangles = surface.vertices, surface.triangles
    if len(triangles) == 0:
        raise SurfaceError("the surface is empty: expected triangles")
    if triangles.min() < 0 or triangles.max() >= len(vertices):
        raise SurfaceError(
            f"the surface is damaged: triangles name vertices {triangles.min()}..{triangles.max()}, "
            f"expected 0..{len(vertices) - 1}"
        )
    bad = np.flatnonzero(~np.all(np.isfinite(vertices), axis=1))
    if len(bad):
        raise SurfaceError(
            f"the surface is not finite: {len(bad)} vertices, the first is number {bad[0]} at {vertices[bad[0]].tolist()}"
        )
    _refuse_degenerate(surface)
    _refuse_bad_edges(surface)
    _refuse_pieces(surface)
    volume = enclosed_volume(surface)
    if volume <= 0:
        raise SurfaceError(
            f"the surface is inside-out: it encloses {volume:.3g} m³, expected its triangles counter-clockwise "
            "seen from outside"
        )
    crossing, pairs, _ = igl.predicates.find_self_intersections(
        np.ascontiguousarray(vertices), triangles.astype(np.int64)
    )
    if crossing:
        where = _place(vertices[triangles[pairs[0, 0]]].mean(axis=0))
        raise SurfaceError(
            f"the surface intersects itself: {len(pairs)} pairs of triangles, the first are {pairs[0, 0]} and "
            f"{pairs[0, 1]} near {where}"
        )


def _refuse_degenerate(surface: TriangleSurface) -> None:
    # Relative to its longest edge, a triangle this flat has a normal that is round-off.
    corners = surface.vertices[surface.triangles]
    edges = np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=2).max(axis=1)
    _, areas = triangle_normals(surface)
    flat = np.flatnonzero(areas <= 1e-10 * edges**2)
    if len(flat):
        raise SurfaceError(
            f"the surface is degenerate: {len(flat)} triangles without area, the first is {flat[0]} near "
            f"{_place(corners[flat[0]].mean(axis=0))}"
        )


def _refuse_bad_edges(surface: TriangleSurface) -> None:
    triangles = surface.triangles
    directed = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    edges, which, counts = np.unique(
        np.sort(directed, axis=1), axis=0, return_inverse=True, return_counts=True
    )
    balance = np.bincount(which.ravel(), np.where(directed[:, 0] < directed[:, 1], 1, -1))
    faults = (
        ("open", counts == 1, "edges with one triangle"),
        ("not manifold", counts > 2, "edges with more than two triangles"),
        ("not oriented consistently", (counts == 2) & (balance != 0), "edges that both triangles run alike"),
    )
    for what, fault, description in faults:
        found = np.flatnonzero(fault)
        if len(found):
            a, b = edges[found[0]]
            raise SurfaceError(
                f"the surface is {what}: {len(found)} {description}, the first from vertex {a} to {b} near "
                f"{_place(surface.vertices[[a, b]].mean(axis=0))}"
            )


def _refuse_pieces(surface: TriangleSurface) -> None:
    triangles, n = surface.triangles, len(surface.vertices)
    ones = np.ones(len(triangles) * 2)
    graph = coo_array(
        (ones, (np.tile(triangles[:, 0], 2), np.concatenate([triangles[:, 1], triangles[:, 2]]))), (n, n)
    )
    _, label = connected_components(graph, directed=False)
    pieces, sizes = np.unique(label[triangles[:, 0]], return_counts=True)
    if len(pieces) > 1:
        smallest = np.flatnonzero(label[triangles[:, 0]] == pieces[np.argmin(sizes)])
        where = _place(surface.vertices[triangles[smallest[0]]].mean(axis=0))
        raise SurfaceError(
            f"the surface has {len(pieces)} separate pieces, expected 1 (no cavities, no second body): the "
            f"smallest has {sizes.min()} triangles near {where}"
        )


def _place(point: Array) -> str:
    return "(" + ", ".join(f"{x:.6g}" for x in point) + ") m"
