"""Nodal-stress collocation whose divergence is the negative adjoint of its gradient: symmetric, stable and passive.

Stress is collocated at every node, sigma_I = C eps(u^h)(x_I), and the force balance uses the adjoint of the same strain
operator in the inner product of the nodal volumes V. The strain operator is made to obey the divergence theorem
(see `consistency`), so that constant stress is in equilibrium. In nodal values u the strain energy is
1/2 sum_I V_I sigma_I : eps_I and the mass is rho V, a diagonal. Traction-free surfaces are natural; a held node is a deleted row, and a contact patch
is a set of rows and columns added up, whose force is conjugate to the tip's displacement.
"""

from __future__ import annotations

import os
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import eigh
from scipy.sparse import csr_array, diags_array, eye_array, hstack, kron

from palpate.discretization.consistency import consistent_gradient, vector_areas
from palpate.discretization.nodal import NodalValues, nodal_shape_functions
from palpate.discretization.supports import Supports, components, supports
from palpate.geometry.cloud import NodeCloud
from palpate.meshfree import ShapeFunctions
from palpate.modes.elastic_modes import ElasticModes
from palpate.scene.material import Material
from palpate_paper.time_integration import EquationsOfMotion, with_multipliers

SUPPORT_RADIUS_FACTOR = 2.2
"""Support radius over node spacing. On the unit cube 1.8 is a little better on lattices and 2.6 worse on scattered nodes."""

Array = NDArray[np.float64]


def elastic_modes(
    cloud: NodeCloud,
    material: Material,
    fixed: ArrayLike,
    contacts: Sequence[ArrayLike],
    *,
    support_radius_factor: float = SUPPORT_RADIUS_FACTOR,
) -> ElasticModes:
    """All modes of the body that is held at the nodes `fixed` and driven at the patches `contacts` (node indices each).

    Dense: 3 n_free unknowns, n_free³ work. Raises ValueError when the arguments are inconsistent, SupportError when a
    node has too few neighbors, MemoryError when the cloud is too large for all its modes.
    """
    held = supports(cloud.n_nodes, fixed, contacts)
    _require_volumes(cloud)
    size = 3 * len(held.free)
    _require_memory(cloud.n_nodes, size)
    reduced = stiffness(
        [d @ _kinematics(held) for d in gradient(cloud, support_radius_factor)], cloud.volumes, material
    )
    coupling, direct = reduced[:size, size:].copy(), reduced[size:, size:].copy()
    inverse_root_mass = np.repeat((material.density_kg_per_m3 * cloud.volumes[held.free]) ** -0.5, 3)
    dynamic = np.array(reduced[:size, :size], order="F")
    del reduced
    dynamic *= inverse_root_mass[:, None]
    dynamic *= inverse_root_mass
    squared_frequencies, vectors = eigh(dynamic, driver="evd", overwrite_a=True, check_finite=False)
    vectors *= inverse_root_mass[:, None]
    input_coupling = vectors.T @ coupling
    shapes = np.zeros((3 * cloud.n_nodes, size))
    shapes[components(held.free, 3)] = vectors
    return ElasticModes(
        squared_frequencies=squared_frequencies,
        input_coupling=input_coupling,
        output_coupling=input_coupling.T,
        direct_stiffness=direct,
        shapes=shapes,
        patch_shapes=held.patch_shapes,
    )


def equations_of_motion(
    cloud: NodeCloud,
    material: Material,
    fixed: ArrayLike,
    contacts: Sequence[ArrayLike],
    *,
    support_radius_factor: float = SUPPORT_RADIUS_FACTOR,
) -> EquationsOfMotion:
    """The same model for time integration, sparse: in the shape functions' parameters, with multipliers as forces.

    As in the modal model the held and driven nodes carry no mass. Raises as `elastic_modes`, but for the memory.
    """
    held = supports(cloud.n_nodes, fixed, contacts)
    _require_volumes(cloud)
    h, gradient = sparse_gradient(cloud, support_radius_factor)
    lam, mu = material.lame_lambda_pa, material.shear_modulus_pa
    volumes = diags_array(cloud.volumes)
    products = [[g.T @ volumes @ f for f in gradient] for g in gradient]
    trace = mu * (products[0][0] + products[1][1] + products[2][2])
    stiffness = sum(
        kron(lam * products[a][b] + mu * products[b][a] + (trace if a == b else 0 * trace), _unit(a, b))
        for a in range(3)
        for b in range(3)
    )
    density = np.zeros(cloud.n_nodes)
    density[held.free] = material.density_kg_per_m3 * cloud.volumes[held.free]
    mass = h.value.T @ diags_array(density) @ h.value
    return with_multipliers(
        csr_array(kron(mass, np.eye(3))),
        csr_array(stiffness),
        csr_array(kron(h.value, np.eye(3))),
        components(held.prescribed, 3),
        csr_array(kron(held.tips, np.eye(3))),
    )


def gradient(cloud: NodeCloud, support_radius_factor: float = SUPPORT_RADIUS_FACTOR) -> list[Array]:
    """[d/dx, d/dy, d/dz], each (n_nodes, n_nodes), 1/m: the gradient at the nodes from the nodal values."""
    h, parameter_gradient = sparse_gradient(cloud, support_radius_factor)
    values = NodalValues(h.value)
    return [values.operator(g) for g in parameter_gradient]


def sparse_gradient(cloud: NodeCloud, support_radius_factor: float) -> tuple[ShapeFunctions, list[csr_array]]:
    """The shape functions at the nodes, and the gradient from their parameters, as sparse matrices."""
    h = nodal_shape_functions(cloud, support_radius_factor, derivatives=1)
    radii = support_radius_factor * cloud.spacing
    return h, consistent_gradient(cloud.points, cloud.volumes, cloud.spacing, vector_areas(cloud), h, radii)


def stiffness(gradient: Sequence[Array], volumes: Array, material: Material) -> Array:
    """(3 m, 3 m), N/m: sum_I V_I B_I^T C B_I for the gradient operators d/dx, d/dy, d/dz, each (n_nodes, m).

    Unknowns x, y, z of point 0, then of point 1, ... Written out for an isotropic C: with P_ab = D_a^T V D_b the block of
    components a, b is lambda P_ab + mu P_ab^T, and mu (P_xx + P_yy + P_zz) on the diagonal.
    """
    lam, mu = material.lame_lambda_pa, material.shear_modulus_pa
    m = gradient[0].shape[1]
    k = np.zeros((m, 3, m, 3))
    for a in range(3):
        weighted = volumes[:, None] * gradient[a]
        for b in range(a + 1):
            p = gradient[b].T @ weighted  # P_ba
            if a == b:
                k[:, a, :, a] += (lam + mu) * p
                for c in range(3):
                    k[:, c, :, c] += mu * p
            else:
                block = lam * p + mu * p.T
                k[:, b, :, a] = block
                k[:, a, :, b] = block.T
    return k.reshape(3 * m, 3 * m)


def _kinematics(held: Supports) -> csr_array:
    """(n_nodes, n_free + n_contacts): nodal values from the free nodes' values and the tips'."""
    free = eye_array(held.n_nodes, format="csr")[:, held.free]
    return csr_array(hstack([free, held.tips]))


def _unit(a: int, b: int) -> Array:
    """(3, 3), 1 in row a and column b."""
    unit = np.zeros((3, 3))
    unit[a, b] = 1.0
    return unit


def _require_volumes(cloud: NodeCloud) -> None:
    bad = np.flatnonzero(~(cloud.volumes > 0))
    if len(bad):
        raise ValueError(
            f"node {bad[0]} has volume {cloud.volumes[bad[0]]} m³: expected above 0 "
            "(two nodes at the same place, or one outside the body)"
        )


def _require_memory(n_nodes: int, size: int) -> None:
    needed = 8 * (3 * size**2 + 5 * n_nodes**2)
    present = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    if needed > present:
        raise MemoryError(
            f"all modes of {n_nodes} nodes need about {needed / 2**30:.1f} GiB, this machine has {present / 2**30:.1f}: "
            "use a coarser cloud, graded towards the contact patches"
        )
