"""The gradient nearest to the meshfree one that obeys the divergence theorem, so that nodal integration passes patch tests.

Summing over nodes, sum_I V_I dh_J/dx(x_I) differs from the boundary integral of h_J n. That difference acts as a spurious
body force under constant stress, and with it frequencies do not converge on scattered nodes. The correction here is
the smallest (in the norm sum_IJ h_I² dG_IJ² / W_IJ, on the same sparsity) that keeps linear fields exact, row by row,
and makes sum_I V_I G_I = b, the nodal vector areas. Because strain and its adjoint use the same corrected operator,
symmetry stays. The idea is that of variationally consistent integration (Chen, Hillman & Rüter 2013).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import bsr_array, csr_array, diags_array
from scipy.spatial import cKDTree

from palpate.factorization import factorize
from palpate.geometry.cloud import NodeCloud
from palpate.geometry.measures import triangle_normals
from palpate.geometry.sampling import sample_elements
from palpate.geometry.tributary import nearest_node
from palpate.meshfree import ShapeFunctions
from palpate.meshfree.kernel import quartic_spline

Array = NDArray[np.float64]

SAMPLES_A_SPACING = 6
"""Surface samples along one node spacing where vector areas are shared out among the nodes."""


def consistent_gradient(
    nodes: Array,
    places: Array,
    volumes: Array,
    spacing: Array,
    target: Array,
    h: ShapeFunctions,
    radii: Array,
) -> list[csr_array]:
    """The derivatives along each axis, (n_nodes, n_nodes) acting on parameters, 1/m, with the sparsity of h.

    nodes (n_nodes, dim), places (n_nodes, dim) where the strain of each is taken, volumes, spacing and support radii
    (n_nodes,); h the shape functions at the places. target (n_nodes, dim), m², is H^T b with the shape functions H at the
    nodes and the vector areas b, which satisfy sum b = 0 and sum x b^T = sum V 1. Then the derivatives are exact for
    linear fields at every node, and sum_I V_I G_IJ = target_J.
    """
    n, terms = len(nodes), 1 + nodes.shape[1]
    node = np.repeat(np.arange(n), np.diff(h.value.indptr))
    other = h.value.indices
    offset = nodes[other] - places[node]
    weight = quartic_spline(np.minimum(np.linalg.norm(offset, axis=1) / radii[other], 1.0))
    linear = np.column_stack([np.ones(len(offset)), offset / spacing[node, None]])  # (nnz, terms)
    # With multipliers xi the correction is W (xi - its local linear fit) V / h², whose constraint is S xi = defect.
    moments = np.stack(
        [[np.bincount(node, weight * p * q, minlength=n) for q in linear.T] for p in linear.T], axis=0
    ).transpose(2, 0, 1)
    inverse_moments = np.linalg.inv(moments)
    rows = (terms * node[:, None] + np.arange(terms)).ravel()
    fit = csr_array(
        ((weight[:, None] * linear).ravel(), (rows, np.repeat(other, terms))), shape=(terms * n, n)
    )
    share = volumes / spacing**2
    scale = volumes * share
    inner = bsr_array(
        (scale[:, None, None] * inverse_moments, np.arange(n), np.arange(n + 1)), shape=(terms * n, terms * n)
    )
    diagonal = np.bincount(other, weight * scale[node], minlength=n)
    # Scaled to a unit diagonal, which on graded clouds spans many powers of ten.
    inverse_root = diags_array(diagonal**-0.5)
    normal = inverse_root @ (diags_array(diagonal) - fit.T @ (inner @ fit)) @ inverse_root
    # Linear fields need no correction: they are the null space. A defect without a part along them has multipliers that
    # are zero at nodes which fix a linear field, and a 1 on the diagonal there finds these.
    null, _ = np.linalg.qr(
        np.sqrt(diagonal)[:, None] * np.column_stack([np.ones(n), nodes - nodes.mean(axis=0)])
    )
    pinned = np.zeros(n)
    pinned[_far_apart(nodes)] = 1
    factor = factorize(csr_array(normal + diags_array(pinned)), points=nodes)

    corrected = list(h.gradient)
    for _ in range(2):  # the second time for the round-off of the first, which grows with the cloud's grading
        defect = target - np.column_stack([derivative.T @ volumes for derivative in corrected])
        scaled = inverse_root @ defect
        multipliers = inverse_root @ factor.solve(scaled - null @ (null.T @ scaled))
        for axis, xi in enumerate(multipliers.T):
            fitted = (inverse_moments @ (fit @ xi).reshape(n, terms, 1))[:, :, 0]
            change = weight * share[node] * (xi[other] - np.sum(linear * fitted[node], axis=1))
            data = corrected[axis].data + change
            corrected[axis] = csr_array((data, other, h.value.indptr), shape=h.value.shape)
    return corrected


def _far_apart(points: Array) -> list[int]:
    """1 + dim nodes, each the farthest from the point, line or plane through those before: they fix a linear field."""
    offset = points - points.mean(axis=0)
    chosen = [int(np.argmax(np.linalg.norm(offset, axis=1)))]
    offset = points - points[chosen[0]]
    for _ in range(points.shape[1]):
        distance = np.linalg.norm(offset, axis=1)
        chosen.append(int(np.argmax(distance)))
        direction = offset[chosen[-1]] / distance[chosen[-1]]
        offset = offset - np.outer(offset @ direction, direction)
    return chosen


def vector_areas(cloud: NodeCloud) -> Array:
    """(n_nodes, 3), m²: the integral of the outward normal over the surface nearest to each boundary node.

    Shared out from fine samples of the triangles, then made to obey the divergence theorem with the cloud's volumes.
    """
    boundary = np.flatnonzero(cloud.boundary)
    tree, spacing = cKDTree(cloud.points[boundary]), cloud.spacing[boundary]
    normals, _ = triangle_normals(cloud.surface)
    samples, triangle = sample_elements(
        cloud.surface.vertices,
        cloud.surface.triangles,
        lambda points: spacing[tree.query(points, workers=-1)[1]],
        1 / SAMPLES_A_SPACING,
    )
    sight = None if cloud.gaps is None else cloud.gaps.sight(samples.points)
    owner = boundary[nearest_node(cloud.points[boundary], samples.points, sight)]
    b = np.zeros((cloud.n_nodes, 3))
    np.add.at(b, owner, samples.measures[:, None] * normals[triangle])
    b[boundary] = obeying_divergence_theorem(b[boundary], cloud.points[boundary], float(cloud.volumes.sum()))
    return b


def obeying_divergence_theorem(b: Array, points: Array, volume: float) -> Array:
    """(n, dim): vector areas b (n, dim) of boundary nodes at points (n, dim), changed so that they enclose the volume.

    The smallest change that is linear in x and makes sum b = 0 and sum x b^T = volume 1; each component changes in
    proportion to itself, so that the nodes of a flat face keep its normal.
    """
    linear = np.column_stack([np.ones(len(points)), points - points.mean(axis=0)])
    corrected = b.copy()
    for axis, component in enumerate(b.T):
        wanted = np.zeros(linear.shape[1])
        wanted[1 + axis] = volume
        weighted = np.abs(component)[:, None] * linear
        corrected[:, axis] += weighted @ np.linalg.solve(linear.T @ weighted, wanted - linear.T @ component)
    return corrected
