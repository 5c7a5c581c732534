"""Linear finite elements, as the paper sets beside its method, and a quadratic reference. Needs scikit-fem."""

from __future__ import annotations

import importlib.util
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import RegularGridInterpolator
from scipy.linalg import eigh
from scipy.sparse import csc_array
from scipy.sparse.linalg import splu
from scipy.spatial import Delaunay

from palpate.experiments.spot_load import spot
from palpate.material import Material

Array = NDArray[np.float64]


def require_scikit_fem() -> None:
    """Raises ValueError with the way out when scikit-fem is not installed."""
    if importlib.util.find_spec("skfem") is None:
        raise ValueError("finite elements need scikit-fem: pip install 'palpate[experiments]'")


def membrane_modes(
    points: Array, edge: NDArray[np.intp], centre: Array, radius: float
) -> tuple[Array, Array, Array]:
    """(mu, shapes, load) of linear triangles on the nodes (Delaunay), consistent mass, everything 1, held at `edge`.

    shapes (n_nodes, n_free), load (n_free,): the unit force on the spot of that radius, by quadrature.
    """
    require_scikit_fem()
    from skfem import Basis, BilinearForm, ElementTriP1, LinearForm, MeshTri
    from skfem.helpers import dot, grad

    corners = Delaunay(points).simplices
    a, b, c = points[corners].transpose(1, 0, 2)
    (px, py), (qx, qy) = (b - a).T, (c - a).T
    area = (px * qy - py * qx) / 2
    corners = corners[np.abs(area) > 1e-9 * np.abs(area).max()]
    mesh = MeshTri(np.ascontiguousarray(points.T), np.ascontiguousarray(corners.T))
    basis = Basis(mesh, ElementTriP1(), intorder=8)
    stiffness = BilinearForm(lambda u, v, w: dot(grad(u), grad(v))).assemble(basis).toarray()
    mass = BilinearForm(lambda u, v, w: u * v).assemble(basis).toarray()

    def pressure(v: Any, w: Any) -> Any:
        return spot(np.hypot(w.x[0] - centre[0], w.x[1] - centre[1]), radius) * v

    load = LinearForm(pressure).assemble(basis)
    free = np.setdiff1d(np.arange(len(points)), edge)
    mu, vectors = eigh(stiffness[np.ix_(free, free)], mass[np.ix_(free, free)])
    shapes = np.zeros((len(points), len(free)))
    shapes[free] = vectors
    return mu, shapes, shapes.T @ load


def n_triangles(points: Array) -> int:
    """Number of triangles of the nodes' Delaunay triangulation."""
    return len(Delaunay(points).simplices)


def cube_of_tetrahedra(
    nodes_an_edge: int, material: Material, omega: float, top: Any
) -> tuple[Array, NDArray[np.complex128]]:
    """(points (n, 3), displacement (n, 3)) of linear tetrahedra under u_z = top(x, y) e^{j omega t} on z = 1, held at z = 0."""
    require_scikit_fem()
    from skfem import ElementTetP1, MeshTet

    axis = np.linspace(0, 1, nodes_an_edge)
    mesh = MeshTet.init_tensor(axis, axis, axis)
    locations, values = _harmonic(mesh, ElementTetP1(), material, omega, top, ())
    return locations, values


class QuadraticCube:
    """The same by quadratic hexahedra on a quarter of the cube, with its two planes of symmetry: the reference.

    top must be even in x and y about 0.5.
    """

    def __init__(self, elements_an_edge: int, material: Material, omega: float, top: Any) -> None:
        require_scikit_fem()
        from skfem import ElementHex2, MeshHex

        if elements_an_edge % 2:
            raise ValueError(f"elements_an_edge = {elements_an_edge}: expected an even number")
        half = np.linspace(0.5, 1, elements_an_edge // 2 + 1)
        whole = np.linspace(0, 1, elements_an_edge + 1)
        mesh = MeshHex.init_tensor(half, half, whole)
        locations, values = _harmonic(mesh, ElementHex2(), material, omega, top, (0, 1))
        order = np.lexsort(np.round(locations, 9).T[::-1])
        axes = tuple(np.unique(np.round(locations[:, i], 9)) for i in range(3))
        grid = values[order].reshape(*(len(a) for a in axes), 3)
        self._field = RegularGridInterpolator(axes, grid, method="cubic")

    def __call__(self, points: Array) -> NDArray[np.complex128]:
        """(n, 3), complex displacement at the points (n, 3), cubic between the nodes."""
        away = points - 0.5
        folded = points.copy()
        folded[:, :2] = 0.5 + np.abs(away[:, :2])
        values = np.asarray(self._field(folded), dtype=np.complex128)
        values[:, :2] *= np.sign(away[:, :2])
        return values


def _harmonic(
    mesh: Any, element: Any, material: Material, omega: float, top: Any, symmetric: tuple[int, ...]
) -> tuple[Array, NDArray[np.complex128]]:
    """(locations, displacements) of the nodes; `symmetric` axes have a plane of symmetry at 0.5."""
    from skfem import Basis, BilinearForm, ElementVector
    from skfem.helpers import dot
    from skfem.models.elasticity import linear_elasticity

    basis = Basis(mesh, ElementVector(element))
    lam, mu = material.lame_lambda_pa, material.shear_modulus_pa
    stiffness = linear_elasticity(lam, mu).assemble(basis)
    mass = BilinearForm(lambda u, v, w: material.density_kg_per_m3 * dot(u, v)).assemble(basis)
    memory = complex(material.prony.transfer_factor(np.array([1j * omega]))[0])
    system = csc_array(memory * stiffness - omega**2 * mass)
    x, y, z = basis.doflocs
    component = np.zeros(basis.N, dtype=int)
    node_dofs = _components(basis)
    for i, dofs in enumerate(node_dofs):
        component[dofs] = i
    known = (z == 0) | (z == 1)
    for axis in symmetric:
        known |= (component == axis) & (basis.doflocs[axis] == 0.5)
    u = np.zeros(basis.N, dtype=np.complex128)
    driven = (z == 1) & (component == 2)
    u[driven] = top(x[driven], y[driven])
    free = np.flatnonzero(~known)
    right = -(system[:, known] @ u[known])[free]
    u[free] = splu(system[free][:, free], permc_spec="MMD_AT_PLUS_A").solve(right)
    return basis.doflocs[:, node_dofs[0]].T, np.column_stack([u[dofs] for dofs in node_dofs])


def _components(basis: Any) -> list[NDArray[np.intp]]:
    """The unknowns of x, y and z, the nodes in the same order in each."""
    parts = [basis.nodal_dofs, basis.edge_dofs, basis.facet_dofs, basis.interior_dofs]
    return [np.concatenate([p[i::3].ravel() for p in parts if p is not None and p.size]) for i in range(3)]
