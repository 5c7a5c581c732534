"""Writes a triangle surface as a PLY file."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def ply_bytes(vertices: NDArray[np.float64], triangles: NDArray[np.integer]) -> bytes:
    """A binary PLY file in double precision, without the vertices that no triangle uses.

    vertices   (n_vertices, 3), in any unit
    triangles  (n_triangles, 3)
    """
    used, corners = np.unique(triangles, return_inverse=True)
    faces = np.empty(len(triangles), dtype=[("count", "u1"), ("corners", "<i4", 3)])
    faces["count"], faces["corners"] = 3, corners.reshape(-1, 3)
    header = (
        f"ply\nformat binary_little_endian 1.0\nelement vertex {len(used)}\nproperty double x\nproperty double y\n"
        f"property double z\nelement face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    return header.encode() + vertices[used].astype("<f8").tobytes() + faces.tobytes()
