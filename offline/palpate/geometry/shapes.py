"""Node clouds of simple bodies: a box on a lattice, and a ball."""

from __future__ import annotations

import itertools

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from palpate.geometry.cloud import NodeCloud, TriangleSurface
from palpate.geometry.tributary import Cells, tributary_cells, tributary_measures

Array = NDArray[np.float64]
Vector = tuple[float, float, float]

_SAMPLES_A_SPACING = 8
"""Fine samples along one node spacing where volumes and areas come from the nearest node."""


def box_lattice(
    lower: Vector, upper: Vector, counts: tuple[int, int, int], jitter: float = 0.0, seed: int = 0
) -> NodeCloud:
    """Lattice of counts[0] x counts[1] x counts[2] nodes from face to face of a box.

    lower, upper  opposite corners, m
    counts        nodes along x, y, z, at least 2 each; 9 of them in 1 m are 1/8 m apart
    jitter        largest displacement of a node along each axis as a fraction of the spacing, 0 <= jitter < 0.5.
                  Nodes of a face stay in it, nodes of an edge on it, corners where they are.
    seed          of the jitter

    Volumes and areas are the trapezoid rule's; with jitter, the parts of the box and of each face that are
    nearest to the node, measured with 8 samples a spacing. Either way they sum to the box's volume and surface.
    An edge or corner node has the mean of its faces' normals, weighted with the area it holds of each.
    `spacing` is the largest of the three axes'.
    """
    low, high, n = np.asarray(lower, float), np.asarray(upper, float), np.asarray(counts)
    step = (high - low) / (n - 1)
    index = _lattice_index(n)
    points = np.where(index == n - 1, high, low + index * step)
    ends = np.stack([index == 0, index == n - 1], axis=2)  # (n_nodes, 3 axes, 2)
    outer = ends.any(axis=2)
    lengths = np.where(outer, 0.5, 1.0) * step  # what each node stands for along each axis, without jitter
    samples = _SAMPLES_A_SPACING * (n - 1)
    if jitter:
        shift = np.random.default_rng(seed).uniform(-jitter, jitter, points.shape) * step
        points = points + np.where(outer, 0.0, shift)
        cells = tributary_cells(points, *_midpoints(low, high, samples))
    else:
        inward = ends[:, :, 0].astype(float) - ends[:, :, 1]
        squares = lengths[:, :, None] ** 2 / 12 * np.eye(3)
        cells = Cells(np.prod(lengths, axis=1), points + inward * step / 4, squares)

    normals, areas = np.zeros_like(points), np.zeros(len(points))
    for axis, side in itertools.product(range(3), range(2)):
        members = ends[:, axis, side]
        if jitter:
            flat = np.arange(3) == axis
            face = (low, high)[side]
            grid = _midpoints(
                np.where(flat, face, low), np.where(flat, face, high), np.where(flat, 1, samples)
            )
            share = tributary_measures(points[members], *grid)
        else:
            share = np.prod(np.delete(lengths[members], axis, axis=1), axis=1)
        areas[members] += share
        normals[members, axis] += (2 * side - 1) * share
    boundary = np.any(outer, axis=1)
    normals[boundary] /= np.linalg.norm(normals[boundary], axis=1, keepdims=True)
    return NodeCloud(
        points=points,
        normals=normals,
        volumes=cells.volumes,
        centroids=cells.centroids,
        moments=cells.moments,
        areas=areas,
        boundary=boundary,
        spacing=np.full(len(points), step.max()),
        surface=_lattice_surface(points, n),
    )


def ball(radius_m: float, spacing_m: float) -> NodeCloud:
    """Ball around the origin: a cubic lattice inside, spiral points on the surface.

    The surface nodes lie on a Fibonacci spiral, one for every spacing², and the lattice ends 0.6 spacings below
    them. Volumes and areas are those of the points of the ball and of the sphere nearest to the node, from
    samples 1/8 spacing apart; they sum to 4/3 pi radius³ and 4 pi radius².

    radius_m   > 0
    spacing_m  > 0, at most half the radius
    """
    area, volume = 4 * np.pi * radius_m**2, 4 / 3 * np.pi * radius_m**3
    outward = directions(round(area / spacing_m**2))
    interior = _grid_in_ball(radius_m - 0.6 * spacing_m, spacing_m, offset=0.0)
    points = np.vstack([interior, radius_m * outward])
    on_surface = np.arange(len(points)) >= len(interior)

    fine = spacing_m / _SAMPLES_A_SPACING
    samples = _grid_in_ball(radius_m, fine, offset=0.5)
    cells = tributary_cells(points, samples, np.ones(len(samples)), volume)
    skin = radius_m * directions(round(area / fine**2))
    areas = np.zeros(len(points))
    areas[on_surface] = tributary_measures(points[on_surface], skin, np.ones(len(skin)), area)
    normals = np.zeros_like(points)
    normals[on_surface] = outward
    hull = ConvexHull(outward).simplices
    corners = outward[hull]
    inward = np.einsum("ti,ti->t", np.cross(corners[:, 0], corners[:, 1]), corners[:, 2]) < 0
    hull[inward] = hull[inward][:, ::-1]
    return NodeCloud(
        points=points,
        normals=normals,
        volumes=cells.volumes,
        centroids=cells.centroids,
        moments=cells.moments,
        areas=areas,
        boundary=on_surface,
        spacing=np.full(len(points), spacing_m),
        surface=TriangleSurface(vertices=radius_m * outward, triangles=hull.astype(np.int32)),
    )


def _lattice_index(counts: NDArray[np.int64]) -> NDArray[np.int64]:
    """(prod(counts), 3), the integer places of a lattice, the last one running fastest."""
    return np.indices(tuple(int(n) for n in counts)).reshape(3, -1).T


def _midpoints(low: Array, high: Array, cells: NDArray[np.int64]) -> tuple[Array, Array, float]:
    """Midpoints of a grid of cells, their equal weights, and the measure of the whole (of a face if one is flat)."""
    extent = high - low
    total = float(np.prod(extent[extent > 0]))
    points = low + (_lattice_index(cells) + 0.5) * (extent / cells)
    return points, np.full(len(points), total / len(points)), total


def directions(count: int) -> Array:
    """(count, 3), nearly evenly spread unit vectors on the Fibonacci (golden-angle) spiral."""
    i = np.arange(count)
    z = 1 - (2 * i + 1) / count
    angle = np.pi * (3 - np.sqrt(5)) * i
    rho = np.sqrt(1 - z**2)
    return np.column_stack([rho * np.cos(angle), rho * np.sin(angle), z])


def _grid_in_ball(radius: float, step: float, offset: float) -> Array:
    """(n, 3), points (i + offset) step within the radius; offset 0 has a point at the center."""
    reach = int(np.ceil(radius / step)) + 1
    axis = (np.arange(-reach, reach + 1) + offset) * step
    points = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
    return points[np.einsum("ij,ij->i", points, points) <= radius**2]


def _lattice_surface(points: Array, n: NDArray[np.int64]) -> TriangleSurface:
    """Two triangles for every cell of the six faces of a lattice of nodes; its vertices are the boundary nodes."""
    index = np.arange(len(points)).reshape(n)
    triangles = []
    for axis in range(3):
        for side in (0, -1):
            layer = np.take(index, side, axis=axis)
            a, b, c, d = layer[:-1, :-1], layer[1:, :-1], layer[1:, 1:], layer[:-1, 1:]
            quads = np.stack([a, b, c, d], axis=-1).reshape(-1, 4)
            # The two axes left over, in order, turn about +x and +z, but about -y.
            if (side == 0) != (axis == 1):
                quads = quads[:, ::-1]
            triangles += [quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]]
    used, renumbered = np.unique(np.vstack(triangles), return_inverse=True)
    return TriangleSurface(vertices=points[used], triangles=renumbered.reshape(-1, 3).astype(np.int32))
