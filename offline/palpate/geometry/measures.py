"""Normals, areas and the enclosed volume of a triangle surface."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from palpate.geometry.cloud import TriangleSurface

Array = NDArray[np.float64]


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
