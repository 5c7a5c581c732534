"""The transverse vibration of a membrane held at its edge, rho u'' = T lap(u), by both discretizations.

BaniHani & De 2009, section 4.1. Inputs are the deflections of node groups (the paper's tool tip is the middle node),
outputs the transverse forces there, newton. The assembled body has one component a node.
"""

from __future__ import annotations

from collections.abc import Sequence

from numpy.typing import ArrayLike
from scipy.sparse import csr_array, diags_array, eye_array

from palpate.discretization.assembled_body import AssembledBody
from palpate.discretization.consistency import consistent_gradient, obeying_divergence_theorem
from palpate.discretization.nodal import SUPPORT_RADIUS_FACTOR, NodalBasis, nodal_basis
from palpate.discretization.supports import supports
from palpate_paper.local_fit import local_fit_laplacian
from palpate_paper.membranes import Membrane


def conservative(
    membrane: Membrane,
    contacts: Sequence[ArrayLike] = (),
    *,
    tension_n_per_m: float = 1.0,
    density_kg_per_m2: float = 1.0,
) -> AssembledBody:
    """K = T sum_a G_a^T A G_a and the nodal mass rho A, A being the nodal areas, G the consistent gradient."""
    basis, h = nodal_basis(membrane.points, membrane.spacing, SUPPORT_RADIUS_FACTOR, derivatives=1)
    edge, rim = membrane.edge.copy(), membrane.on_edge
    edge[rim] = obeying_divergence_theorem(edge[rim], membrane.points[rim], float(membrane.areas.sum()))
    points, target = membrane.points, h.value.T @ edge
    gradient = consistent_gradient(points, points, membrane.areas, membrane.spacing, target, h, basis.radii)
    tension = diags_array(tension_n_per_m * membrane.areas)
    return AssembledBody(
        basis=basis,
        stiffness=csr_array(sum((g.T @ tension @ g for g in gradient), start=0 * h.value)),
        mass=density_kg_per_m2 * membrane.areas,
        supports=supports(membrane.n_nodes, membrane.on_edge, contacts),
        symmetric=True,
    )


def collocation(
    membrane: Membrane,
    contacts: Sequence[ArrayLike] = (),
    *,
    tension_n_per_m: float = 1.0,
    density_kg_per_m2: float = 1.0,
    order: int = 2,
) -> AssembledBody:
    """The collocated rho u'' = T lap(u), each row times the nodal area.

    With basis order 2 the frequencies converge at second order. The linear basis (order 1), the paper's choice in
    three dimensions, is inconsistent for a second derivative: some 10 % off at any number of nodes. The force on a tip
    is minus the divergence of the stress there times the nodal area (the paper's c_tooltip).
    """
    basis, laplacian = _laplacian(membrane, order)
    return AssembledBody(
        basis=basis,
        stiffness=csr_array(diags_array(-tension_n_per_m * membrane.areas) @ laplacian),
        mass=density_kg_per_m2 * membrane.areas,
        supports=supports(membrane.n_nodes, membrane.on_edge, contacts),
        symmetric=False,
    )


def _laplacian(membrane: Membrane, order: int) -> tuple[NodalBasis, csr_array]:
    """The Laplacian at the nodes, (n_nodes, n_nodes), 1/m², and the basis whose parameters it acts on."""
    if order == 2:  # a fit through the nodal values themselves
        identity = csr_array(eye_array(membrane.n_nodes))
        return NodalBasis(membrane.points, membrane.spacing, identity), local_fit_laplacian(membrane.points)
    if order != 1:
        raise ValueError(f"order = {order}: expected 1 or 2")
    basis, h = nodal_basis(membrane.points, membrane.spacing, SUPPORT_RADIUS_FACTOR, derivatives=2)
    xx, yy, _ = h.hessian
    return basis, csr_array(xx + yy)
