"""Finite elements as a reference: membranes and the cube by scikit-fem, linear as in the paper or quadratic.

BaniHani & De 2009, section 4, compares with linear triangles and tetrahedra; the quadratic elements here are the finer
reference. scikit-fem is needed for this module only.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import csr_array, eye_array
from scipy.sparse.linalg import eigsh

from palpate.scene.material import Material
from palpate_paper.time_integration import EquationsOfMotion, with_multipliers

try:
    import skfem
    from skfem.helpers import dot, grad
    from skfem.models.elasticity import linear_elasticity
except ImportError as error:
    raise ImportError(
        "the finite-element reference needs scikit-fem: pip install 'palpate[dev]', or scikit-fem by itself"
    ) from error

Array = NDArray[np.float64]
Where = Callable[[Array], NDArray[np.bool_]]


@dataclass(frozen=True)
class FiniteElements:
    """Matrices of a body without supports.

    places      (n_dofs, dim), m: where each degree of freedom sits
    components  (n_dofs,): 0, 1, 2 for the displacement along x, y, z; 0 for a membrane
    stiffness   (n_dofs, n_dofs), N/m
    mass        (n_dofs, n_dofs), kg
    """

    places: Array
    components: NDArray[np.int64]
    stiffness: csr_array
    mass: csr_array

    @property
    def n_dofs(self) -> int:
        return len(self.places)

    def at(self, where: Where) -> NDArray[np.int64]:
        """Indices of the degrees of freedom whose places (n_dofs, dim) the predicate chooses."""
        return np.flatnonzero(where(self.places))


def disc(refinements: int, degree: int = 1) -> FiniteElements:
    """Unit disc membrane of unit tension and density: 4^refinements triangles a quadrant, the edge refined with them.

    degree 1: straight linear triangles; degree 2: quadratic ones with curved edges.
    """
    mesh_type = skfem.MeshTri if _degree(degree) == 1 else skfem.MeshTri2
    return _membrane(mesh_type.init_circle(refinements), degree)


def square(intervals: int, degree: int = 1) -> FiniteElements:
    """Unit square membrane of unit tension and density: 2 intervals² triangles."""
    axis = np.linspace(0, 1, intervals + 1)
    return _membrane(skfem.MeshTri.init_tensor(axis, axis), degree)


def cube(intervals: int, material: Material, degree: int = 1) -> FiniteElements:
    """Unit cube, elastic constants at rest: 6 intervals³ tetrahedra."""
    axis = np.linspace(0, 1, intervals + 1)
    mesh = skfem.MeshTet.init_tensor(axis, axis, axis)
    element = skfem.ElementTetP1() if _degree(degree) == 1 else skfem.ElementTetP2()
    return _solid(skfem.Basis(mesh, skfem.ElementVector(element), intorder=2 * degree), material)


def quarter_cube(intervals: int, material: Material) -> FiniteElements:
    """The quarter x, y >= 1/2 of the unit cube: quadratic hexahedra, an even number `intervals` to an edge of the whole."""
    if intervals % 2:
        raise ValueError(f"intervals = {intervals}: expected an even number")
    half, whole = np.linspace(0.5, 1, intervals // 2 + 1), np.linspace(0, 1, intervals + 1)
    mesh = skfem.MeshHex.init_tensor(half, half, whole)
    return _solid(skfem.Basis(mesh, skfem.ElementVector(skfem.ElementHex2()), intorder=4), material)


def frequencies(body: FiniteElements, fixed: ArrayLike, count: int) -> Array:
    """(count,), rad/s: the lowest angular frequencies with the degrees of freedom `fixed` held at zero."""
    free = np.setdiff1d(np.arange(body.n_dofs), np.asarray(fixed))
    stiffness, mass = (m[free][:, free].tocsc() for m in (body.stiffness, body.mass))
    squared = eigsh(stiffness, count, mass, sigma=0.0, return_eigenvectors=False)
    return np.sqrt(np.sort(squared))


def equations_of_motion(
    body: FiniteElements, fixed: ArrayLike, tips: Sequence[Sequence[ArrayLike]]
) -> EquationsOfMotion:
    """For time integration: `fixed` degrees of freedom held, and each tip's, one list an input, moved together.

    tips holds one entry a patch: a sequence of index arrays, one for each component that is driven.
    As in the meshfree models the held and driven degrees of freedom carry no mass.
    """
    groups = [np.asarray(group, dtype=np.int64) for patch in tips for group in patch]
    driven = np.concatenate([np.zeros(0, np.int64), *groups])
    inputs = np.repeat(np.arange(len(groups)), [len(g) for g in groups])
    selection = csr_array((np.ones(len(driven)), (driven, inputs)), shape=(body.n_dofs, len(groups)))
    prescribed = np.concatenate([np.asarray(fixed, dtype=np.int64), driven])
    if len(np.unique(prescribed)) < len(prescribed):
        raise ValueError(
            "a degree of freedom is prescribed twice: expected fixed ones and tips to be disjoint"
        )
    moving = np.ones(body.n_dofs)
    moving[prescribed] = 0.0
    keep = csr_array((moving, (np.arange(body.n_dofs),) * 2))
    identity = csr_array(eye_array(body.n_dofs))
    return with_multipliers(
        csr_array(keep @ body.mass @ keep), body.stiffness, identity, identity, prescribed, selection
    )


def _degree(degree: int) -> int:
    if degree not in (1, 2):
        raise ValueError(f"degree = {degree}: expected 1 or 2")
    return degree


def _membrane(mesh: Any, degree: int) -> FiniteElements:
    element = skfem.ElementTriP1() if _degree(degree) == 1 else skfem.ElementTriP2()
    basis = skfem.Basis(mesh, element, intorder=2 * degree + 2)
    return _assembled(basis, skfem.BilinearForm(lambda u, v, _: dot(grad(u), grad(v))), 1.0, 1)


def _solid(basis: Any, material: Material) -> FiniteElements:
    stiffness = linear_elasticity(material.lame_lambda_pa, material.shear_modulus_pa)
    return _assembled(basis, stiffness, material.density_kg_per_m3, 3)


def _assembled(basis: Any, stiffness: Any, density: float, n_components: int) -> FiniteElements:
    inertia = skfem.BilinearForm(lambda u, v, _: density * (dot(u, v) if n_components > 1 else u * v))
    components = np.zeros(basis.N, dtype=np.int64)
    if n_components > 1:
        everywhere = basis.get_dofs(elements=np.arange(basis.mesh.t.shape[1]))
        for k in range(n_components):
            components[everywhere.all([f"u^{k + 1}"])] = k
    return FiniteElements(
        places=np.ascontiguousarray(basis.doflocs.T),
        components=components,
        stiffness=csr_array(skfem.asm(stiffness, basis)),
        mass=csr_array(skfem.asm(inertia, basis)),
    )
