"""Nodal-stress collocation whose divergence is the negative adjoint of its gradient: symmetric, stable and passive.

Stress is collocated at every node, sigma_I = C eps(u^h)(x_I), and the force balance uses the adjoint of the same strain
operator B in the inner product of the nodal volumes V. So K = B^T V C B and M = H^T rho V H in the parameters of the
shape functions, and the mass of a nodal value is rho V. The gradient is corrected to obey the divergence theorem (see
`consistency`), so that constant stress is in equilibrium. Traction-free surfaces are natural. The force on a contact
patch is conjugate to the displacement of its tip.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import bsr_array, csr_array

from palpate.discretization.assembled_body import AssembledBody
from palpate.discretization.consistency import consistent_gradient, vector_areas
from palpate.discretization.nodal import SUPPORT_RADIUS_FACTOR, NodalBasis, nodal_basis
from palpate.discretization.supports import require_volumes, supports
from palpate.geometry.cloud import NodeCloud
from palpate.scene.material import Material


def assemble(
    cloud: NodeCloud,
    material: Material,
    fixed: ArrayLike,
    contacts: Sequence[ArrayLike],
    support_radius_factor: float = SUPPORT_RADIUS_FACTOR,
) -> AssembledBody:
    """The body that is held at the nodes `fixed` and driven at the patches `contacts` (node indices each).

    Raises ValueError when the arguments are inconsistent, SupportError when a node has too few neighbors.
    """
    held = supports(cloud.n_nodes, fixed, contacts)
    require_volumes(cloud)
    basis, gradient = gradient_at_nodes(cloud, support_radius_factor)
    strain = strain_operator(gradient)
    stress = _at_every_node(cloud.volumes[:, None, None] * elasticity_matrix(material)) @ strain
    return AssembledBody(
        basis=basis,
        stiffness=csr_array(strain.T @ stress),
        mass=material.density_kg_per_m3 * cloud.volumes,
        supports=held,
        symmetric=True,
    )


def gradient_at_nodes(
    cloud: NodeCloud, support_radius_factor: float = SUPPORT_RADIUS_FACTOR
) -> tuple[NodalBasis, list[csr_array]]:
    """The basis, and [d/dx, d/dy, d/dz] at the nodes, each (n_nodes, n_nodes), 1/m, from the parameters."""
    basis, h = nodal_basis(cloud.points, cloud.spacing, support_radius_factor, derivatives=1, gaps=cloud.gaps)
    areas = vector_areas(cloud)
    return basis, consistent_gradient(cloud.points, cloud.volumes, cloud.spacing, areas, h, basis.radii)


def strain_operator(gradient: Sequence[csr_array]) -> bsr_array:
    """(6 n_nodes, 3 n_nodes), 1/m: engineering strain xx, yy, zz, xy, yz, zx at every node; one pattern for all axes."""
    pattern = gradient[0]
    x, y, z = (d.data for d in gradient)
    blocks = np.zeros((pattern.nnz, 6, 3))
    blocks[:, 0, 0] = blocks[:, 3, 1] = blocks[:, 5, 2] = x
    blocks[:, 1, 1] = blocks[:, 3, 0] = blocks[:, 4, 2] = y
    blocks[:, 2, 2] = blocks[:, 4, 1] = blocks[:, 5, 0] = z
    n_nodes = pattern.shape[0]
    return bsr_array((blocks, pattern.indices, pattern.indptr), shape=(6 * n_nodes, 3 * n_nodes))


def elasticity_matrix(material: Material) -> NDArray[np.float64]:
    """(6, 6), Pa at rest: C of Eq. 10, for engineering strain xx, yy, zz, xy, yz, zx."""
    c = material.shear_modulus_pa * np.diag([2.0, 2.0, 2.0, 1.0, 1.0, 1.0])
    c[:3, :3] += material.lame_lambda_pa
    return c


def _at_every_node(blocks: NDArray[np.float64]) -> bsr_array:
    """Block diagonal of blocks (n_nodes, k, k)."""
    n_nodes, k, _ = blocks.shape
    return bsr_array((blocks, np.arange(n_nodes), np.arange(n_nodes + 1)), shape=(k * n_nodes, k * n_nodes))
