"""How far the surface of the tissue is stretched or compressed in itself."""

from __future__ import annotations

import numpy as np

from palpate_view.surface import Floats, Triangles


class SurfaceStrain:
    """The strain of a triangulated surface with vertices (n, 3), m, at rest and triangles (m, 3).

    A stress would need the history of the strain and the moduli, which no message holds; the strain needs the displacement alone.
    """

    def __init__(self, vertices: Floats, triangles: Triangles) -> None:
        self._triangles = triangles
        first, second = _edges(vertices, triangles)
        length = np.linalg.norm(first, axis=1)
        along = np.einsum("ij,ij->i", first, second) / np.where(length > 0, length, 1.0)
        across = np.sqrt(np.maximum(np.einsum("ij,ij->i", second, second) - along**2, 0.0))
        area = length * across
        flat = area > 1e-12 * float(
            area.max(initial=0.0)
        )  # others are lines: no strain can be told from them
        self._area = np.where(flat, area, 0.0)
        # Columns of the inverse of [[length, along], [0, across]]: edges in the triangle's plane, at rest.
        safe_length, safe_across = np.where(flat, length, 1.0), np.where(flat, across, 1.0)
        self._from_first = 1.0 / safe_length
        self._from_second = np.stack([-along / (safe_length * safe_across), 1.0 / safe_across])
        around = self._at_vertices(self._area, len(vertices))
        self._around = np.where(around > 0, around, 1.0)

    def largest(self, deformed: Floats) -> Floats:
        """(n,) the larger magnitude of both principal stretches less 1, at the deformed vertices (n, 3), m.

        The stretches are the singular values of each triangle's deformation gradient, so no rotation changes them. Each vertex
        has the mean of its triangles, weighted with their areas at rest.
        """
        first, second = _edges(deformed, self._triangles)
        x = self._from_first[:, None] * first
        y = self._from_second[0][:, None] * first + self._from_second[1][:, None] * second
        xx, yy, xy = (np.einsum("ij,ij->i", a, b) for a, b in ((x, x), (y, y), (x, y)))
        middle, half = (xx + yy) / 2, np.hypot((xx - yy) / 2, xy)
        strain = np.maximum(np.sqrt(middle + half) - 1, 1 - np.sqrt(np.maximum(middle - half, 0.0)))
        return self._at_vertices(self._area * strain, len(deformed)) / self._around

    def _at_vertices(self, of_triangles: Floats, n_vertices: int) -> Floats:
        """(n_vertices,) sums of a value (m,) of the triangles around each vertex."""
        return np.sum([np.bincount(corner, of_triangles, n_vertices) for corner in self._triangles.T], axis=0)


def _edges(vertices: Floats, triangles: Triangles) -> tuple[Floats, Floats]:
    a, b, c = (vertices[triangles[:, i]] for i in range(3))
    return b - a, c - a
