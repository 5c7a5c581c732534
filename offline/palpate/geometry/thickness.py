"""How many nodes lie across a body beneath points of its surface: where there are few, the part bends wrongly."""

from __future__ import annotations

import igl
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from palpate.geometry.cloud import NodeCloud

Array = NDArray[np.float64]

_START = 1e-3
"""Depth, in spacings, from which rays start, so that they do not hit the triangle that the node is on."""

_STEPS = 16
"""Places along a ray where the spacing is asked for."""


def thickness(cloud: NodeCloud, nodes: NDArray[np.intp]) -> Array:
    """(n,), m: from boundary nodes (n,) to the other side of the body, against their normals; infinite where a ray hits nothing."""
    vertices, triangles = cloud.surface.vertices, cloud.surface.triangles.astype(np.int64)
    found = np.full(len(nodes), np.inf)
    for i, node in enumerate(nodes):
        start, normal = _START * cloud.spacing[node], cloud.normals[node]
        source = np.ascontiguousarray(cloud.points[node] - start * normal)
        hits = igl.ray_mesh_intersect(source, -normal, vertices, triangles, first=True)
        if hits:
            found[i] = start + hits[0][1]  # triangle, distance, place within the triangle
    return found


def nodes_across(cloud: NodeCloud, nodes: NDArray[np.intp]) -> Array:
    """(n,): the number of nodes, with those on both sides, that a line from each boundary node through the body meets.

    It is one more than the integral of 1 / spacing along the line, and not a whole number.
    """
    thick = thickness(cloud, nodes)
    across = np.full(len(nodes), np.inf)
    through = np.isfinite(thick)
    shares = (np.arange(_STEPS) + 0.5) / _STEPS
    chosen = nodes[through]
    ways = thick[through, None, None] * cloud.normals[chosen][:, None]
    places = cloud.points[chosen][:, None] - shares[:, None] * ways
    _, nearest = cKDTree(cloud.points).query(places.reshape(-1, 3), workers=-1)
    density = (1 / cloud.spacing[nearest]).reshape(-1, _STEPS).mean(axis=1)
    across[through] = 1 + thick[through] * density
    return across
