"""The gradient nearest to the meshfree one that obeys the divergence theorem, so that nodal integration passes patch tests.

Summing over nodes, sum_I V_I dh_J/dx(x_I) differs from the boundary integral of h_J n. That difference acts as a spurious
body force under constant stress, and with it frequencies do not converge on scattered nodes. The correction here is
the smallest (in the norm sum_I V_I h_I² dG_IJ² / W_IJ, on the same sparsity) that keeps linear fields exact, row by row,
and makes sum_I V_I G_I = b, the nodal vector areas. Because strain and its adjoint use the same corrected operator,
symmetry stays. The idea is that of variationally consistent integration (Chen, Hillman & Rueter 2013).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve
from scipy.sparse import bsr_array, csr_array, diags_array
from scipy.spatial import cKDTree

from palpate.geometry.cloud import NodeCloud
from palpate.geometry.sampling import sample_elements
from palpate.geometry.surface import triangle_normals
from palpate.meshfree import ShapeFunctions
from palpate.meshfree.kernel import quartic_spline

Array = NDArray[np.float64]

SAMPLES_A_SPACING = 6
"""Surface samples along one node spacing where vector areas are shared out among the nodes."""


def consistent_gradient(
    cloud: NodeCloud, h: ShapeFunctions, radii: Array
) -> tuple[csr_array, csr_array, csr_array]:
    """d/dx, d/dy, d/dz, each (n_nodes, n_nodes) acting on parameters, 1/m, with the sparsity of h.

    Exact for linear fields at every node, and sum_I V_I G_IJ = (H^T b)_J with the vector areas b.
    """
    n = cloud.n_nodes
    node = np.repeat(np.arange(n), np.diff(h.value.indptr))
    other = h.value.indices
    offset = cloud.points[other] - cloud.points[node]
    weight = quartic_spline(np.minimum(np.linalg.norm(offset, axis=1) / radii[other], 1.0))
    linear = np.column_stack([np.ones(len(offset)), offset / cloud.spacing[node, None]])  # (nnz, 4)
    # With multipliers xi the correction is W (xi - its local linear fit) / h², whose constraint is S xi = defect.
    moments = np.stack(
        [[np.bincount(node, weight * p * q, minlength=n) for q in linear.T] for p in linear.T], axis=0
    ).transpose(2, 0, 1)
    inverse_moments = np.linalg.inv(moments)
    rows = (4 * node[:, None] + np.arange(4)).ravel()
    fit = csr_array(((weight[:, None] * linear).ravel(), (rows, np.repeat(other, 4))), shape=(4 * n, n))
    share = cloud.volumes / cloud.spacing**2
    scale = cloud.volumes * share
    inner = bsr_array(
        (scale[:, None, None] * inverse_moments, np.arange(n), np.arange(n + 1)), shape=(4 * n, 4 * n)
    )
    diagonal = np.bincount(other, weight * scale[node], minlength=n)
    normal = (diags_array(diagonal) - fit.T @ (inner @ fit)).toarray(order="F")
    # Linear fields need no correction: they are the null space, and no defect has a part along them.
    null = np.column_stack([np.ones(n), cloud.points - cloud.points.mean(axis=0)])
    null /= np.linalg.norm(null, axis=0)
    normal += np.mean(diagonal) * null @ null.T
    factor = cho_factor(normal, overwrite_a=True, check_finite=False)

    target = h.value.T @ vector_areas(cloud)
    corrected = []
    for axis, plain in enumerate(h.gradient):
        xi = cho_solve(factor, target[:, axis] - plain.T @ cloud.volumes, check_finite=False)
        fitted = (inverse_moments @ (fit @ xi).reshape(n, 4, 1))[:, :, 0]
        change = weight * share[node] * (xi[other] - np.sum(linear * fitted[node], axis=1))
        corrected.append(csr_array((plain.data + change, plain.indices, plain.indptr), shape=plain.shape))
    return corrected[0], corrected[1], corrected[2]


def vector_areas(cloud: NodeCloud) -> Array:
    """(n_nodes, 3), m²: the integral of the outward normal over the surface nearest to each boundary node.

    Shared out from fine samples of the triangles, then changed by the smallest linear field with which the divergence
    theorem holds for the cloud: sum b = 0 and sum x b^T = V 1, V being the sum of the volumes. Each component changes
    in proportion to itself, so that the nodes of a flat face keep its normal.
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
    owner = boundary[tree.query(samples.points, workers=-1)[1]]
    b = np.zeros((cloud.n_nodes, 3))
    np.add.at(b, owner, samples.measures[:, None] * normals[triangle])
    linear = np.column_stack([np.ones(len(boundary)), cloud.points[boundary] - cloud.points.mean(axis=0)])
    for axis, wanted in enumerate(np.eye(4)[1:] * cloud.volumes.sum()):
        component = b[boundary, axis]
        weighted = np.abs(component)[:, None] * linear
        b[boundary, axis] += weighted @ np.linalg.solve(linear.T @ weighted, wanted - linear.T @ component)
    return b
