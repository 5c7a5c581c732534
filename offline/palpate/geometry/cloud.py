"""The node cloud: where the nodes are, and what volume and surface each one stands for."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from palpate.geometry.visibility import Gaps


@dataclass(frozen=True)
class TriangleSurface:
    """A triangulated surface.

    vertices  (n_vertices, 3), m
    triangles (n_triangles, 3), vertex indices, counter-clockwise seen from outside
    """

    vertices: NDArray[np.float64]
    triangles: NDArray[np.int32]


@dataclass(frozen=True)
class NodeCloud:
    """Nodes that fill a body, surface nodes included.

    points   (n_nodes, 3), m
    normals  (n_nodes, 3), unit outward normals; zero at interior nodes
    volumes  (n_nodes,), m³, of the nodes' cells: the parts of the body nearest to them; they sum to the body's volume
    centroids  (n_nodes, 3), m, of the cells
    moments  (n_nodes, 3, 3), m²: the mean over the cell of (x - centroid) (x - centroid)^T
    areas    (n_nodes,), m²; zero at interior nodes, they sum to the body's surface
    boundary (n_nodes,), true on the boundary
    spacing  (n_nodes,), m; local distance between neighboring nodes, from which the support radius follows
    surface  the body's boundary
    gaps     across which nodes are no neighbors; None where there can be none, as in a convex body
    relative_stiffness  (n_nodes,), Young's modulus of the nodes' cells over the material's; None: 1 everywhere
    """

    points: NDArray[np.float64]
    normals: NDArray[np.float64]
    volumes: NDArray[np.float64]
    centroids: NDArray[np.float64]
    moments: NDArray[np.float64]
    areas: NDArray[np.float64]
    boundary: NDArray[np.bool_]
    spacing: NDArray[np.float64]
    surface: TriangleSurface
    gaps: Gaps | None = None
    relative_stiffness: NDArray[np.float64] | None = None

    @property
    def n_nodes(self) -> int:
        return len(self.points)
