"""The discretization of BaniHani & De 2009: momentum at interior nodes, traction at free boundary nodes (Eq. 11-14, 30-33).

Nonsymmetric, so its modes are complex and may grow: look at `stability` before trusting a model. Linear consistency is
order 0 for second derivatives, so on scattered nodes it does not converge. It is here for the paper's examples and for
comparison; `conservative` is the one to build organs with.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import eig, lu_factor, lu_solve
from scipy.sparse import block_array, csr_array, diags_array, kron, vstack

from palpate.discretization.nodal import NodalValues, nodal_shape_functions
from palpate.discretization.supports import Supports, components, supports
from palpate.geometry.cloud import NodeCloud
from palpate.modes.elastic_modes import ElasticModes
from palpate.scene.material import Material
from palpate_paper.time_integration import EquationsOfMotion

SUPPORT_RADIUS_FACTOR = 2.2
"""Support radius over node spacing: the paper's cube is stable here and not at 2.0, 2.4 or 2.6 for some layouts."""

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

    The states are the nodal values at interior nodes; free boundary nodes follow from zero traction. The force on a
    patch is traction times tributary area, summed over its nodes. Dense: 3 n_interior unknowns, nonsymmetric.

    Raises ValueError when the arguments are inconsistent or a patch node is not on the boundary, SupportError when a
    node has too few neighbors.
    """
    held, interior, surface = _partition(cloud, fixed, contacts)
    operators = Operators(cloud, material, support_radius_factor)

    # Rows act on all nodal values; columns: interior, free surface, tips. Fixed values are zero.
    patch_shapes = held.patch_shapes
    columns = components(interior, 3), components(surface, 3)

    def split(rows: Array) -> tuple[Array, Array, Array]:
        return rows[:, columns[0]], rows[:, columns[1]], rows @ patch_shapes

    values = NodalValues(operators.h.value)
    l_i, l_s, l_t = split(values.vector_operator(operators.divergence_of_stress(interior)))
    t_i, t_s, t_t = split(values.vector_operator(operators.traction(surface)))
    traction_factor = lu_factor(t_s, check_finite=False)
    surface_from_interior = -lu_solve(traction_factor, t_i, check_finite=False)
    surface_from_tips = -lu_solve(traction_factor, t_t, check_finite=False)

    density = material.density_kg_per_m3
    stiffness = -(l_i + l_s @ surface_from_interior) / density
    driving = -(l_t + l_s @ surface_from_tips) / density
    squared_frequencies, vectors = eig(stiffness, overwrite_a=True, check_finite=False)
    ascending = np.argsort(np.abs(squared_frequencies), kind="stable")
    squared_frequencies, vectors = squared_frequencies[ascending], vectors[:, ascending]

    shapes = np.zeros((3 * cloud.n_nodes, len(squared_frequencies)), dtype=np.complex128)
    shapes[columns[0]] = vectors
    shapes[columns[1]] = surface_from_interior @ vectors
    patch_shapes[columns[1]] = surface_from_tips
    force = values.vector_operator(operators.patch_force(held.contacts))
    return ElasticModes(
        squared_frequencies=squared_frequencies,
        input_coupling=np.linalg.solve(vectors, driving.astype(np.complex128)),
        output_coupling=force @ shapes,
        direct_stiffness=force @ patch_shapes,
        shapes=shapes,
        patch_shapes=patch_shapes,
    )


def equations_of_motion(
    cloud: NodeCloud,
    material: Material,
    fixed: ArrayLike,
    contacts: Sequence[ArrayLike],
    *,
    support_radius_factor: float = SUPPORT_RADIUS_FACTOR,
) -> EquationsOfMotion:
    """The same model for time integration, sparse: Eq. 30-33 as they stand, in the shape functions' parameters.

    Rows are momentum at interior nodes, traction at free boundary nodes, displacement at held and driven nodes.
    Raises as `elastic_modes`.
    """
    held, interior, surface = _partition(cloud, fixed, contacts)
    operators = Operators(cloud, material, support_radius_factor)
    value = csr_array(kron(operators.h.value, np.eye(3)))
    tips = csr_array(kron(held.tips, np.eye(3)))
    inside, prescribed = components(interior, 3), components(held.prescribed, 3)
    n, n_traction = value.shape[1], 3 * len(surface)

    momentum = operators.divergence_of_stress(interior)
    below = csr_array((n_traction + len(prescribed), n))
    above = csr_array((len(inside) + n_traction, n))
    return EquationsOfMotion(
        mass=csr_array(vstack([material.density_kg_per_m3 * value[inside], below])),
        elastic=csr_array(vstack([-momentum, operators.traction(surface), 0 * value[prescribed]])),
        algebraic=csr_array(vstack([above, value[prescribed]])),
        driving=csr_array(vstack([above[:, : tips.shape[1]], tips[prescribed]])),
        force_elastic=operators.patch_force(held.contacts),
        force_algebraic=csr_array((tips.shape[1], n)),
        value=value,
    )


class Operators:
    """Stress rows of Eq. 11 and 12, sparse, acting on the parameters: x, y, z of node 0, then of node 1, ..."""

    def __init__(self, cloud: NodeCloud, material: Material, support_radius_factor: float) -> None:
        self._cloud = cloud
        self._lam, self._mu = material.lame_lambda_pa, material.shear_modulus_pa
        self.h = nodal_shape_functions(cloud, support_radius_factor, derivatives=2)

    def divergence_of_stress(self, nodes: NDArray[np.int64]) -> csr_array:
        """(3 k, 3 n_nodes), N/m³ per m, at k nodes: mu lap(u) + (lambda + mu) grad(div u)."""
        xx, yy, zz, xy, yz, zx = (m[nodes] for m in self.h.hessian)
        second = ((xx, xy, zx), (xy, yy, yz), (zx, yz, zz))
        laplacian = self._mu * (xx + yy + zz)
        return _interleaved(
            lambda a, b: (self._lam + self._mu) * second[a][b] + (laplacian if a == b else 0 * laplacian)
        )

    def traction(self, nodes: NDArray[np.int64]) -> csr_array:
        """(3 k, 3 n_nodes), Pa per m, at k nodes: sigma n = lambda n div u + mu (grad u + grad u^T) n."""
        gradient = [m[nodes] for m in self.h.gradient]
        normal = [diags_array(n) for n in self._cloud.normals[nodes].T]
        along = self._mu * sum((n @ g for n, g in zip(normal, gradient, strict=True)), start=0 * gradient[0])
        return _interleaved(
            lambda a, b: (
                self._lam * (normal[a] @ gradient[b])
                + self._mu * (normal[b] @ gradient[a])
                + (along if a == b else 0 * along)
            )
        )

    def patch_force(self, contacts: Sequence[NDArray[np.int64]]) -> csr_array:
        """(3 n_contacts, 3 n_nodes), N per m: traction times tributary area, summed over each patch."""
        empty = csr_array((0, 3 * self._cloud.n_nodes))
        sums = [
            csr_array(kron(self._cloud.areas[patch][None, :], np.eye(3))) @ self.traction(patch)
            for patch in contacts
        ]
        return csr_array(vstack([empty, *sums]))


def _interleaved(block: Callable[[int, int], csr_array]) -> csr_array:
    """(3 k, 3 n) from the 3 x 3 blocks (k, n) of components a (rows) and b (columns), components running fastest."""
    rows = [[csr_array(block(a, b)) for b in range(3)] for a in range(3)]
    k, n = rows[0][0].shape
    stacked = csr_array(block_array(rows))
    return stacked[np.arange(3 * k).reshape(3, k).T.ravel()][:, np.arange(3 * n).reshape(3, n).T.ravel()]


def _partition(
    cloud: NodeCloud, fixed: ArrayLike, contacts: Sequence[ArrayLike]
) -> tuple[Supports, NDArray[np.int64], NDArray[np.int64]]:
    """The supports, the free interior nodes and the free boundary nodes."""
    held = supports(cloud.n_nodes, fixed, contacts)
    on_boundary = cloud.boundary
    for k, patch in enumerate(held.contacts):
        inside = patch[~on_boundary[patch]]
        if len(inside):
            raise ValueError(
                f"contacts[{k}] holds node {inside[0]}, which is not on the boundary and has no traction"
            )
    interior = held.free[~on_boundary[held.free]]
    if not len(interior):
        raise ValueError("no interior node is free: expected a finer cloud")
    return held, interior, held.free[on_boundary[held.free]]
