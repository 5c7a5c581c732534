"""Whether a triangle surface bounds one solid body: all faults at once, in the words of the file, with what to do."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import igl
import igl.predicates
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from palpate.geometry.cloud import TriangleSurface
from palpate.geometry.measures import enclosed_volume, triangle_normals

Array = NDArray[np.float64]
Indices = NDArray[np.signedinteger]


class SurfaceError(ValueError):
    """A surface doesn't bound one body. The message has a line for each fault: how often, where first, what to do."""


@dataclass(frozen=True)
class Naming:
    """How vertices, triangles and places of a surface are named to its author.

    unit, unit_m  the file's unit and its length, m
    vertices      (n_vertices,), number of each vertex in the file; None where the format has none
    triangles     (n_triangles,), number of the face that each triangle is of; None: their indices
    mend          what to do about the faults
    """

    unit: str = "m"
    unit_m: float = 1.0
    vertices: Indices | None = None
    triangles: Indices | None = None
    mend: str = "To mend: palpate repair"

    def place(self, point: Array) -> str:
        """A place in the file's unit, and in m where that is another one; point (3,) in m."""
        here = _coordinates(point / self.unit_m, self.unit)
        return here if self.unit == "m" else f"{here} = {_coordinates(point, 'm')}"

    def edge(self, a: int, b: int) -> str:
        return "" if self.vertices is None else f" from vertex {self.vertices[a]} to {self.vertices[b]}"

    def triangle(self, t: int) -> str:
        return str(t if self.triangles is None else self.triangles[t])


def check_surface(surface: TriangleSurface, naming: Naming | None = None) -> None:
    """Raise SurfaceError unless the surface bounds one solid body.

    That is: not empty, no triangle without area, closed, manifold, consistently oriented, free of self-intersections, and
    with its normals pointing out of the body. It is in one piece, or others lie inside the largest and bound cavities. All
    that fail are named, each in its line.
    """
    if naming is None:
        naming = Naming(vertices=np.arange(len(surface.vertices)))
    found = list(_faults(surface, naming)) if len(surface.triangles) else ["is empty: expected triangles"]
    if found:
        raise SurfaceError("\n".join(f"the surface {fault}" for fault in found))


def _faults(surface: TriangleSurface, naming: Naming) -> Iterator[str]:
    edges, counts, balance = edges_of(surface.triangles)
    n_open = int(np.sum(counts == 1))
    if n_open > len(counts) / 2:
        # Pieces and intersections would only repeat this.
        yield (
            f"is open: {n_open} of its {len(counts)} edges belong to one triangle only, so most triangles don't share "
            f"vertices. {naming.mend}"
        )
        return
    flat = flat_triangles(surface)
    if flat.any():
        first = int(np.argmax(flat))
        where = naming.place(surface.vertices[surface.triangles[first]].mean(axis=0))
        yield (
            f"is degenerate: {flat.sum()} triangles without area, the first is {naming.triangle(first)} near {where}. "
            f"{naming.mend}"
        )
    uneven = (counts == 2) & (balance != 0)
    for what, fault, description in (
        ("open", counts == 1, "edges with one triangle"),
        ("not manifold", counts > 2, "edges with more than two triangles"),
        ("not oriented consistently", uneven, "edges that both triangles run alike"),
    ):
        if fault.any():
            a, b = edges[np.argmax(fault)]
            where = naming.place(surface.vertices[[a, b]].mean(axis=0))
            yield f"is {what}: {fault.sum()} {description}, the first{naming.edge(a, b)} near {where}. {naming.mend}"
    sound = bool(np.all(counts == 2) and not uneven.any())
    yield from _separate_pieces(surface, naming, sound)
    volume = enclosed_volume(surface)
    if sound and volume <= 0:
        yield (
            f"is inside-out: it encloses {volume:.3g} m³, expected its triangles counter-clockwise seen from outside. "
            f"{naming.mend}"
        )
    yield from _crossings(surface, np.flatnonzero(~flat), naming)


def flat_triangles(surface: TriangleSurface) -> NDArray[np.bool_]:
    """(n_triangles,): so flat, relative to the longest edge, that the normal is round-off."""
    corners = surface.vertices[surface.triangles]
    edges = np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=2).max(axis=1)
    _, areas = triangle_normals(surface)
    return areas <= 1e-10 * edges**2


def edges_of(triangles: Indices) -> tuple[Indices, Indices, Indices]:
    """Edges (n, 2), how many triangles have each (n,), and how many more run it upward than downward (n,)."""
    directed = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    edges, which, counts = np.unique(
        np.sort(directed, axis=1), axis=0, return_inverse=True, return_counts=True
    )
    upward = np.bincount(which.ravel(), directed[:, 0] < directed[:, 1], len(edges)).astype(np.int64)
    return edges, counts, 2 * upward - counts


def _separate_pieces(surface: TriangleSurface, naming: Naming, sound: bool) -> Iterator[str]:
    """Pieces that are no cavities of the largest one; in a surface that is not sound itself, all but one."""
    triangles, n = surface.triangles, len(surface.vertices)
    ends = np.concatenate([triangles[:, 1], triangles[:, 2]])
    graph = coo_array((np.ones(len(ends)), (np.tile(triangles[:, 0], 2), ends)), (n, n))
    _, label = connected_components(graph, directed=False)
    pieces = [np.flatnonzero(label[triangles[:, 0]] == piece) for piece in np.unique(label[triangles[:, 0]])]
    if len(pieces) == 1:
        return
    if not sound:
        yield _told(pieces, f"has {len(pieces)} separate pieces, expected 1", surface, naming)
        return
    parts = [TriangleSurface(surface.vertices, triangles[piece]) for piece in pieces]
    volumes = [enclosed_volume(part) for part in parts]
    body = int(np.argmax(np.abs(volumes)))
    places = np.array([surface.vertices[part.triangles[0, 0]] for part in parts])
    inside = np.array(
        [
            np.abs(igl.winding_number(part.vertices, part.triangles.astype(np.int64), places)) > 0.5
            for part in parts
        ]
    )  # [k]: which are inside part k
    np.fill_diagonal(inside, False)
    apart, nested, turned = [], [], []
    for k in range(len(parts)):
        if k == body:
            continue
        if not inside[body, k]:
            apart.append(k)
        elif inside[:, k].sum() > 1:
            nested.append(k)
        elif volumes[k] * volumes[body] > 0:
            turned.append(k)
    for found, fault in (
        (apart, f"{len(apart) + 1} separate pieces, expected 1"),
        (nested, f"{len(nested)} pieces inside its cavities, expected none"),
        (
            turned,
            f"{len(turned)} cavities whose triangles face as the body's, expected them the other way round",
        ),
    ):
        if found:
            yield _told([pieces[k] for k in found], f"has {fault}", surface, naming)


def _told(pieces: list[Indices], fault: str, surface: TriangleSurface, naming: Naming) -> str:
    smallest = min(pieces, key=len)
    where = naming.place(surface.vertices[surface.triangles[smallest[0]]].mean(axis=0))
    return f"{fault}: the smallest has {len(smallest)} triangles near {where}. {naming.mend}"


def _crossings(surface: TriangleSurface, solid: Indices, naming: Naming) -> Iterator[str]:
    """The self-intersections among the triangles that have an area."""
    triangles = surface.triangles[solid]
    crossing, pairs, _ = igl.predicates.find_self_intersections(
        np.ascontiguousarray(surface.vertices), np.ascontiguousarray(triangles, dtype=np.int64)
    )
    if crossing:
        first, second = pairs[0]
        where = naming.place(surface.vertices[triangles[first]].mean(axis=0))
        yield (
            f"intersects itself: {len(pairs)} pairs of triangles, the first are {naming.triangle(solid[first])} and "
            f"{naming.triangle(solid[second])} near {where}. {naming.mend}"
        )


def _coordinates(point: Array, unit: str) -> str:
    return "(" + ", ".join(f"{x:.6g}" for x in point) + f") {unit}"
