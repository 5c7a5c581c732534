"""Tip stiffness of the conservative discretization without its modes, for clouds too large for them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import csr_array, diags_array
from scipy.sparse.linalg import LinearOperator, SuperLU, cg, splu

from palpate.discretization.conservative import SUPPORT_RADIUS_FACTOR, sparse_gradient
from palpate.discretization.supports import supports
from palpate.geometry.cloud import NodeCloud
from palpate.scene.material import Material

Array = NDArray[np.float64]

RESIDUAL = 1e-7
"""Relative residual at which the iteration stops; the energy, and so the stiffness, is accurate to about its square."""

PENALTY = 100.0
"""Stiffness of the preconditioner's supports over that of a node; it changes the iterations, not the result."""

MAX_ITERATIONS = 2000
"""Some 100 are usual at nu = 0.49, more nearer to 0.5."""


def static_stiffness(
    cloud: NodeCloud,
    material: Material,
    fixed: ArrayLike,
    contacts: Sequence[ArrayLike],
    *,
    support_radius_factor: float = SUPPORT_RADIUS_FACTOR,
) -> Array:
    """(3 n_contacts, 3 n_contacts), N/m at rest: forces on the tips for unit displacements of each, as in `ElasticModes`.

    Conjugate gradients in the nodal values: the stiffness is only ever applied, through the sparse gradient and the
    sparse LU factor of H. The preconditioner is one component's Laplacian, held at the same nodes by a penalty and
    factorized once: elasticity differs from three of them by a factor that the spacing does not enter. Raises as
    `conservative.elastic_modes`, and RuntimeError when the iteration does not converge.
    """
    held = supports(cloud.n_nodes, fixed, contacts)
    h, gradient = sparse_gradient(cloud, support_radius_factor)
    values, transposed = splu(h.value.tocsc()), splu(h.value.T.tocsc())
    lam, mu = material.lame_lambda_pa, material.shear_modulus_pa

    def force(u: Array) -> Array:
        """K u for nodal displacements u (n_nodes, 3), N: the adjoint divergence of the collocated stress."""
        parameters = values.solve(u)
        slope = np.stack([g @ parameters for g in gradient], axis=1)  # [node, b, a] = du_a/dx_b
        stress = mu * (slope + slope.transpose(0, 2, 1))
        stress[:, range(3), range(3)] += lam * np.trace(slope, axis1=1, axis2=2)[:, None]
        stress *= cloud.volumes[:, None, None]
        return transposed.solve(sum(g.T @ stress[:, b] for b, g in enumerate(gradient)))

    free = held.free
    size = 3 * len(free)

    def apply(v: Array) -> Array:
        u = np.zeros((cloud.n_nodes, 3))
        u[free] = v.reshape(-1, 3)
        return force(u)[free].ravel()

    laplacian = _held_laplacian(cloud.volumes, h.value, gradient, held.prescribed)

    def precondition(r: Array) -> Array:
        full = np.zeros((cloud.n_nodes, 3))
        full[free] = r.reshape(-1, 3)
        return (h.value @ laplacian.solve(h.value.T @ full))[free].ravel()

    operator = LinearOperator((size, size), matvec=apply, dtype=np.float64)
    preconditioner = LinearOperator((size, size), matvec=precondition, dtype=np.float64)
    fields, forces = [], []
    for tip in held.patch_shapes.T:
        u = tip.reshape(-1, 3).copy()
        solution, failed = cg(
            operator, -force(u)[free].ravel(), rtol=RESIDUAL, maxiter=MAX_ITERATIONS, M=preconditioner
        )
        if failed:
            raise RuntimeError(
                f"the static solution did not converge in {MAX_ITERATIONS} iterations: expected poissons_ratio = "
                f"{material.poissons_ratio} further from 0.5, or a more even cloud"
            )
        u[free] = solution.reshape(-1, 3)
        fields.append(u.ravel())
        forces.append(force(u).ravel())
    stiffness: Array = np.array(fields) @ np.array(forces).T
    return (stiffness + stiffness.T) / 2


def _held_laplacian(
    volumes: Array, value: csr_array, gradient: Sequence[csr_array], prescribed: NDArray[np.int64]
) -> SuperLU:
    """LU factor of sum_a G_a^T V G_a plus a penalty on the prescribed nodal values, on the parameters, (n, n)."""
    weight = diags_array(volumes)
    matrix = sum((g.T @ weight @ g for g in gradient), start=csr_array(value.shape))
    stiffness = matrix.diagonal()[prescribed]
    held = value[prescribed]
    matrix = matrix + held.T @ (diags_array(PENALTY * stiffness) @ held)
    return splu(
        matrix.tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True}
    )
