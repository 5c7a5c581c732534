"""Tip stiffness of the conservative discretization without its modes, for clouds too large for them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array, diags_array
from scipy.sparse.linalg import LinearOperator, SuperLU, cg, splu

from palpate.discretization.assembled_body import AssembledBody

Array = NDArray[np.float64]

RESIDUAL = 1e-7
"""Relative residual at which the iteration stops; the energy, and so the stiffness, is accurate to about its square."""

PENALTY = 100.0
"""Stiffness of the preconditioner's supports over that of a node; it changes the iterations, not the result."""

MAX_ITERATIONS = 2000
"""Some 100 are usual at nu = 0.49, more nearer to 0.5."""


def static_stiffness(body: AssembledBody) -> Array:
    """(3 n_contacts, 3 n_contacts), N/m at rest: forces on the tips for unit displacements of each, as in `ElasticModes`.

    Conjugate gradients in the nodal values of a symmetric body: H⁻ᵀ K H⁻¹ is applied by the sparse LU factor of H,
    never formed. The preconditioner is one component's Laplacian, held at the same nodes by a penalty and factorized once:
    elasticity differs from three of them by a factor that the spacing does not enter.

    Raises RuntimeError when the iteration does not converge.
    """
    held, value = body.supports, body.basis.value
    factor, transposed = splu(value.tocsc()), splu(value.T.tocsc())

    def force(u: Array) -> Array:
        """The forces on the nodes (n_nodes, 3), N, that hold the displacements u (n_nodes, 3), m."""
        parameters = factor.solve(u).ravel()
        return transposed.solve((body.stiffness @ parameters).reshape(-1, 3))

    free = held.free
    size = 3 * len(free)

    def apply(v: Array) -> Array:
        u = np.zeros((body.n_nodes, 3))
        u[free] = v.reshape(-1, 3)
        return force(u)[free].ravel()

    laplacian = _held_laplacian(body)

    def precondition(r: Array) -> Array:
        full = np.zeros((body.n_nodes, 3))
        full[free] = r.reshape(-1, 3)
        return (value @ laplacian.solve(value.T @ full))[free].ravel()

    operator = LinearOperator((size, size), matvec=apply, dtype=np.float64)
    preconditioner = LinearOperator((size, size), matvec=precondition, dtype=np.float64)
    fields, forces = [], []
    for tip in np.kron(held.tips.toarray(), np.eye(3)).T:
        u = tip.reshape(-1, 3).copy()
        solution, failed = cg(
            operator, -force(u)[free].ravel(), rtol=RESIDUAL, maxiter=MAX_ITERATIONS, M=preconditioner
        )
        if failed:
            raise RuntimeError(
                f"the static solution did not converge in {MAX_ITERATIONS} iterations: expected a Poisson's ratio "
                "further from 0.5, or a more even cloud"
            )
        u[free] = solution.reshape(-1, 3)
        fields.append(u.ravel())
        forces.append(force(u).ravel())
    stiffness: Array = np.array(fields) @ np.array(forces).T
    return (stiffness + stiffness.T) / 2


def _held_laplacian(body: AssembledBody) -> SuperLU:
    """LU factor (n_nodes, n_nodes) of the Laplacian on the parameters with a penalty on the prescribed nodal values.

    The sum of the three diagonal blocks of an isotropic K is (lambda + 4 mu) times the Laplacian.
    """
    matrix = sum((body.stiffness[a::3, a::3] for a in range(3)), start=csr_array(body.basis.value.shape))
    prescribed = body.supports.prescribed
    held = body.basis.value[prescribed]
    penalty = diags_array(PENALTY * matrix.diagonal()[prescribed])
    matrix = matrix + held.T @ (penalty @ held)
    return splu(
        matrix.tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True}
    )
