"""Stress in every node's cell, and a force balance that is the negative adjoint of its strain: symmetric, stable, passive.

A node stands for a cell, of which centroid and second moments are known. Strain is taken at the centroid, where it is the
mean over the cell of a field up to second order, and stress there works on it: B^T V C B. The strain varies within the
cell, by the second derivatives of the shape functions; half of the deviatoric energy of that variation is added. Without
any, bending is too soft; all of it makes bending exact even with two nodes through the thickness, and a coarse patch too
stiff, under whose edge the shape functions exaggerate second derivatives. (Strain at a node on the surface, given the
node's whole cell, bends 3 times too stiffly there. Hillman & Chen 2016 add the variation about the node.) The
volumetric part is left out, so that nothing locks when the body is nearly incompressible. M = H^T m H with the masses m of
`inertia`. The gradient is corrected to obey the divergence theorem (see `consistency`), so that constant
stress is in equilibrium. Traction-free surfaces are natural. The force on a contact patch is conjugate to the displacement
of its tip.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import csr_array

from palpate.discretization.assembled_body import AssembledBody
from palpate.discretization.consistency import consistent_gradient, vector_areas
from palpate.discretization.inertia import inertial_volumes
from palpate.discretization.nodal import SUPPORT_RADIUS_FACTOR, NodalBasis, nodal_basis
from palpate.discretization.stiffness import isotropic_stiffness
from palpate.discretization.supports import require_volumes, supports
from palpate.geometry.cloud import NodeCloud
from palpate.meshfree import shape_functions
from palpate.scene.material import Material

Array = NDArray[np.float64]

_VARIATION = 0.5
"""Share of the energy of the strain's variation within cells. With 0, 1/2 and 1: first frequency of a cantilever with five
nodes through its thickness -1.9, -0.9 and 0.0 %; stiffness of a punch of radius a at spacing a/2 -9.9, +1.7 and +10.6 %,
at a/3 -6.6, -0.3 and +4.6 % (docs/validation.md)."""


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
    basis, pattern, gradient = gradient_in_cells(cloud, support_radius_factor)
    mu, volumetric = material.shear_modulus_pa, material.lame_lambda_pa
    relative = cloud.relative_stiffness
    stiff_volumes = cloud.volumes if relative is None else cloud.volumes * relative
    return AssembledBody(
        basis=basis,
        stiffness=isotropic_stiffness(
            pattern, gradient, stiff_volumes, np.array([volumetric, *3 * [-2 / 3 * mu]]), mu
        ),
        mass=material.density_kg_per_m3 * inertial_volumes(cloud, basis),
        supports=held,
        symmetric=True,
    )


def gradient_in_cells(
    cloud: NodeCloud, support_radius_factor: float = SUPPORT_RADIUS_FACTOR
) -> tuple[NodalBasis, csr_array, Array]:
    """The basis, the pattern (n_nodes, n_nodes), which nodes reach which cell, and (nnz, 4, 3), 1/m, what acts on them.

    The first of the four operators is the gradient at the centroids, corrected; the others are how much it changes over
    one standard deviation of the cell along each of its principal axes, times the square root of the share that counts.
    """
    points, spacing, gaps = cloud.points, cloud.spacing, cloud.gaps
    basis, _ = nodal_basis(points, spacing, support_radius_factor, derivatives=0, gaps=gaps)
    h = shape_functions(cloud.centroids, points, basis.radii, derivatives=2, gaps=gaps)
    target = basis.value.T @ vector_areas(cloud)
    mean = consistent_gradient(points, cloud.centroids, cloud.volumes, spacing, target, h, basis.radii)
    xx, yy, zz, xy, yz, zx = (second.data for second in h.hessian)
    second = np.array([[xx, xy, zx], [xy, yy, yz], [zx, yz, zz]])
    variances, axes = np.linalg.eigh(cloud.moments)
    deviations = axes * np.sqrt(_VARIATION * np.maximum(variances, 0.0))[:, None, :]
    cell = np.repeat(np.arange(cloud.n_nodes), np.diff(h.value.indptr))
    gradient = np.empty((h.value.nnz, 4, 3))
    gradient[:, 0] = np.column_stack([d.data for d in mean])
    gradient[:, 1:] = np.einsum("jak,abj->jkb", deviations[cell], second)
    return basis, h.value, gradient
