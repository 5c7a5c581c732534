"""The discretisation of BaniHani & De 2009: momentum at interior nodes, traction at free boundary nodes (Eq. 11-14, 30-33).

Nonsymmetric, so its modes are complex and may grow: look at `stability` before trusting a model. Linear consistency is
order 0 for second derivatives, so on scattered nodes it does not converge. It is here for the paper's examples and for
comparison; `conservative` is the one to build organs with.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import eig, lu_factor, lu_solve
from scipy.sparse import csr_array

from palpate.discretization.nodal import NodalValues, nodal_shape_functions
from palpate.discretization.supports import supports
from palpate.geometry.cloud import NodeCloud
from palpate.material import Material
from palpate.system import ElasticModes

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
    node has too few neighbours.
    """
    held = supports(cloud.n_nodes, fixed, contacts)
    on_boundary = cloud.boundary
    for k, patch in enumerate(held.contacts):
        inside = patch[~on_boundary[patch]]
        if len(inside):
            raise ValueError(
                f"contacts[{k}] holds node {inside[0]}, which is not on the boundary and has no traction"
            )
    interior = held.free[~on_boundary[held.free]]
    surface = held.free[on_boundary[held.free]]
    if not len(interior):
        raise ValueError("no interior node is free: expected a finer cloud")
    operators = Operators(cloud, material, support_radius_factor)

    # Rows act on all nodal values; columns: interior, free surface, tips. Fixed values are zero.
    patch_shapes = held.patch_shapes
    columns = _dofs(interior), _dofs(surface)

    def split(rows: Array) -> tuple[Array, Array, Array]:
        return rows[:, columns[0]], rows[:, columns[1]], rows @ patch_shapes

    l_i, l_s, l_t = split(operators.divergence_of_stress(interior))
    t_i, t_s, t_t = split(operators.traction(surface))
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
    force = _patch_force(operators, cloud, held.contacts)
    return ElasticModes(
        squared_frequencies=squared_frequencies,
        input_coupling=np.linalg.solve(vectors, driving.astype(np.complex128)),
        output_coupling=force @ shapes,
        direct_stiffness=force @ patch_shapes,
        shapes=shapes,
        patch_shapes=patch_shapes,
    )


class Operators:
    """Stress rows of Eq. 11 and 12 acting on the nodal values of all nodes, x, y, z of node 0, then of node 1, ..."""

    def __init__(self, cloud: NodeCloud, material: Material, support_radius_factor: float) -> None:
        self._cloud = cloud
        self._lam, self._mu = material.lame_lambda_pa, material.shear_modulus_pa
        self._h = nodal_shape_functions(cloud, support_radius_factor, derivatives=2)
        self._values = NodalValues(self._h.value)

    def divergence_of_stress(self, nodes: NDArray[np.int64]) -> Array:
        """(3 k, 3 n_nodes), N/m³ per m, at k nodes: mu lap(u) + (lambda + mu) grad(div u)."""
        xx, yy, zz, xy, yz, zx = (self._rows(m, nodes) for m in self._h.hessian)
        second = ((xx, xy, zx), (xy, yy, yz), (zx, yz, zz))
        laplacian = self._mu * (xx + yy + zz)
        rows = np.empty((len(nodes), 3, self._cloud.n_nodes, 3))
        for a in range(3):
            for b in range(3):
                rows[:, a, :, b] = (self._lam + self._mu) * second[a][b]
            rows[:, a, :, a] += laplacian
        return rows.reshape(3 * len(nodes), -1)

    def traction(self, nodes: NDArray[np.int64]) -> Array:
        """(3 k, 3 n_nodes), Pa per m, at k boundary nodes: sigma n = lambda n div u + mu (grad u + grad u^T) n."""
        gradient = [self._rows(m, nodes) for m in self._h.gradient]
        normal = self._cloud.normals[nodes]
        along = sum((normal[:, b, None] * gradient[b] for b in range(3)), start=np.zeros_like(gradient[0]))
        rows = np.empty((len(nodes), 3, self._cloud.n_nodes, 3))
        for a in range(3):
            for b in range(3):
                rows[:, a, :, b] = self._lam * normal[:, a, None] * gradient[b]
                rows[:, a, :, b] += self._mu * normal[:, b, None] * gradient[a]
            rows[:, a, :, a] += self._mu * along
        return rows.reshape(3 * len(nodes), -1)

    def _rows(self, matrix: csr_array, nodes: NDArray[np.int64]) -> Array:
        return self._values.operator(matrix[nodes])


def _patch_force(operators: Operators, cloud: NodeCloud, contacts: Sequence[NDArray[np.int64]]) -> Array:
    """(3 n_contacts, 3 n_nodes), N per m: traction times tributary area, summed over each patch."""
    forces = np.zeros((len(contacts), 3, 3 * cloud.n_nodes))
    for force, patch in zip(forces, contacts, strict=True):
        traction = operators.traction(patch).reshape(len(patch), 3, -1)
        force[:] = np.einsum("k,kax->ax", cloud.areas[patch], traction)
    return forces.reshape(-1, 3 * cloud.n_nodes)


def _dofs(nodes: NDArray[np.int64]) -> NDArray[np.int64]:
    return (3 * nodes[:, None] + np.arange(3)).ravel()
