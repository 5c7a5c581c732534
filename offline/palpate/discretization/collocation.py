"""The discretization of BaniHani & De 2009: momentum at interior nodes, traction at boundary nodes (Eq. 11-14, 30-33).

It is not symmetric, so its modes are complex and may grow. Linear consistency is order 0 for second derivatives, so it
does not converge on scattered nodes. It is here for the paper's examples and for comparison; `conservative` is the
default.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike
from scipy.sparse import bsr_array, csr_array

from palpate.discretization.assembled_body import AssembledBody
from palpate.discretization.nodal import SUPPORT_RADIUS_FACTOR, nodal_basis
from palpate.discretization.supports import Supports, require_volumes, supports
from palpate.geometry.cloud import NodeCloud
from palpate.meshfree import ShapeFunctions
from palpate.scene.material import Material


def assemble(
    cloud: NodeCloud,
    material: Material,
    fixed: ArrayLike,
    contacts: Sequence[ArrayLike],
    support_radius_factor: float = SUPPORT_RADIUS_FACTOR,
) -> AssembledBody:
    """The body that is held at the nodes `fixed` and driven at the patches `contacts` (node indices each).

    Row I is minus the divergence of the stress times the volume at an interior node, and traction times area at a
    boundary node, whose own inertia is dropped.

    Raises ValueError when the arguments are inconsistent, a patch node is not on the boundary or no interior node is
    free, SupportError when a node has too few neighbors.
    """
    held = supports(cloud.n_nodes, fixed, contacts)
    require_volumes(cloud)
    _require_patches_on_boundary(cloud, held)
    basis, h = nodal_basis(cloud.points, cloud.spacing, support_radius_factor, derivatives=2, gaps=cloud.gaps)
    return AssembledBody(
        basis=basis,
        stiffness=force_operator(cloud, material, h),
        mass=np.where(cloud.boundary, 0.0, material.density_kg_per_m3 * cloud.volumes),
        supports=held,
        symmetric=False,
    )


def force_operator(cloud: NodeCloud, material: Material, h: ShapeFunctions) -> csr_array:
    """(3 n_nodes, 3 n_nodes), N/m: the force at every node from the parameters.

    Inside -V (mu lap(u) + (lambda + mu) grad(div u)), on the boundary A (lambda n div u + mu (grad u + grad u^T) n).
    """
    lam, mu = material.lame_lambda_pa, material.shear_modulus_pa
    node = np.repeat(np.arange(cloud.n_nodes), np.diff(h.value.indptr))
    xx, yy, zz, xy, yz, zx = (m.data for m in h.hessian)
    second = np.stack([[xx, xy, zx], [xy, yy, yz], [zx, yz, zz]]).transpose(2, 0, 1)
    slope = np.stack([m.data for m in h.gradient], axis=1)
    normal = cloud.normals[node]
    identity = np.eye(3)
    divergence = (lam + mu) * second + mu * (xx + yy + zz)[:, None, None] * identity
    traction = lam * normal[:, :, None] * slope[:, None, :] + mu * slope[:, :, None] * normal[:, None, :]
    traction += mu * np.sum(normal * slope, axis=1)[:, None, None] * identity
    blocks = np.where(
        cloud.boundary[node, None, None],
        cloud.areas[node, None, None] * traction,
        -cloud.volumes[node, None, None] * divergence,
    )
    size = 3 * cloud.n_nodes
    return csr_array(bsr_array((blocks, h.value.indices, h.value.indptr), shape=(size, size)))


def _require_patches_on_boundary(cloud: NodeCloud, held: Supports) -> None:
    for k, patch in enumerate(held.contacts):
        inside = patch[~cloud.boundary[patch]]
        if len(inside):
            raise ValueError(
                f"contacts[{k}] holds node {inside[0]}, which is not on the boundary and has no traction"
            )
    if np.all(cloud.boundary[held.free]):
        raise ValueError("no interior node is free: expected a finer cloud")
