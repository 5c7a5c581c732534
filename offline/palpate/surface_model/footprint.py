"""How a small sphere spreads its force over the points of a surface: the contact that errors are stated for."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array, eye_array, kron
from scipy.spatial import cKDTree

from palpate.model_file.contact_size import contact_radius_m

Array = NDArray[np.float64]


def footprints(points: Array, normals: Array, areas: Array, tool_radius_m: float) -> csr_array:
    """(n_points, n_points): row i spreads a unit force over the points in contact around point i.

    points (n_points, 3), m; normals (n_points, 3); areas (n_points,), m², that the points stand for

    The weights follow the pressure of Hertz, sqrt(1 - (distance / radius)²), and sum to 1. Points that face away belong
    to the far side of a thin part. Where the points are far apart the contact is one point.
    """
    radius = contact_radius_m(tool_radius_m)
    pairs = cKDTree(points).query_pairs(radius, output_type="ndarray")
    i, j = np.vstack([pairs, pairs[:, ::-1], np.repeat(np.arange(len(points))[:, None], 2, axis=1)]).T
    same_side = np.einsum("pi,pi->p", normals[i], normals[j]) > 0
    i, j = i[same_side | (i == j)], j[same_side | (i == j)]
    distance = np.linalg.norm(points[i] - points[j], axis=1)
    pressure = areas[j] * np.sqrt(np.maximum(0.0, 1 - (distance / radius) ** 2))
    weights = pressure / np.bincount(i, pressure, minlength=len(points))[i]
    return csr_array((weights, (i, j)), shape=(len(points), len(points)))


def on_components(weights: csr_array) -> csr_array:
    """(3 n, 3 m): weights (n, m) on each of three components, those of a point side by side."""
    return csr_array(kron(weights, eye_array(3), format="csr"))
