"""Deflections and displacements of the convergence studies by finite elements, the reference included. Needs scikit-fem."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import RegularGridInterpolator
from scipy.linalg import eigh
from scipy.sparse import csc_array
from scipy.sparse.linalg import splu
from scipy.spatial import Delaunay

from palpate.scene.material import Material
from palpate_paper.spot_load import spot

if TYPE_CHECKING:
    from palpate_paper.finite_elements import FiniteElements

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]
Profile = Callable[[Array, Array], Array]
"""A displacement over the top, by x and y."""


def require_scikit_fem() -> None:
    """Raise ValueError with what to install when scikit-fem is missing."""
    if importlib.util.find_spec("skfem") is None:
        raise ValueError("finite elements need scikit-fem: pip install 'palpate[experiments]'")


def membrane_modes(
    points: Array, edge: NDArray[np.intp], center: Array, radius: float
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
        return spot(np.hypot(w.x[0] - center[0], w.x[1] - center[1]), radius) * v

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
    nodes_an_edge: int, material: Material, omega: float, top: Profile
) -> tuple[Array, Complex]:
    """(points (n, 3), displacement (n, 3)) of linear tetrahedra under u_z = top(x, y) e^{j omega t} on z = 1, held at z = 0."""
    require_scikit_fem()
    from palpate_paper import finite_elements

    body = finite_elements.cube(nodes_an_edge - 1, material)
    return _harmonic(body, material, omega, top, ())


class QuadraticCube:
    """The same by quadratic hexahedra on a quarter of the cube, with its two planes of symmetry: the reference.

    top must be even in x and y about 0.5, elements_an_edge (of the whole cube) even.
    """

    def __init__(self, elements_an_edge: int, material: Material, omega: float, top: Profile) -> None:
        require_scikit_fem()
        from palpate_paper import finite_elements

        body = finite_elements.quarter_cube(elements_an_edge, material)
        locations, values = _harmonic(body, material, omega, top, (0, 1))
        axes = tuple(np.unique(np.round(locations[:, i], 9)) for i in range(3))
        grid = values.reshape(*(len(a) for a in axes), 3)
        self._field = RegularGridInterpolator(axes, grid, method="cubic")

    def __call__(self, points: Array) -> Complex:
        """(n, 3), complex displacement at the points (n, 3), cubic between the nodes."""
        away = points - 0.5
        folded = points.copy()
        folded[:, :2] = 0.5 + np.abs(away[:, :2])
        values = np.asarray(self._field(folded), dtype=np.complex128)
        values[:, :2] *= np.sign(away[:, :2])
        return values


def _harmonic(
    body: FiniteElements, material: Material, omega: float, top: Profile, symmetric: tuple[int, ...]
) -> tuple[Array, Complex]:
    """(places, displacements), (n, 3) each, the nodes by x, then y, then z; `symmetric` axes have a plane of symmetry at 0.5."""
    memory = complex(material.prony.transfer_factor(np.array([1j * omega]))[0])
    system = csc_array(memory * body.stiffness - omega**2 * body.mass)
    places = np.round(body.places, 9)
    x, y, z = places.T
    known = (z == 0) | (z == 1)
    for axis in symmetric:
        known |= (body.components == axis) & (places[:, axis] == 0.5)
    u = np.zeros(body.n_dofs, dtype=np.complex128)
    driven = (z == 1) & (body.components == 2)
    u[driven] = top(x[driven], y[driven])
    free = np.flatnonzero(~known)
    right = -(system[:, known] @ u[known])[free]
    u[free] = splu(system[free][:, free], permc_spec="MMD_AT_PLUS_A").solve(right)
    by_place = np.lexsort((body.components, z, y, x)).reshape(-1, 3)
    return places[by_place[:, 0]], u[by_place]
