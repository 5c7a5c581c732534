"""The transverse vibration of a membrane held at its edge, rho u'' = T lap(u), by both discretizations.

BaniHani & De 2009, section 4.1. Inputs are the deflections of node groups (the paper's tool tip is the middle node),
outputs the transverse forces there, newton. `ElasticModes` has one component a node here.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import eig, eigh
from scipy.sparse import csr_array, diags_array, eye_array

from palpate.discretization.consistency import consistent_gradient, obeying_divergence_theorem
from palpate.discretization.nodal import NodalValues
from palpate.discretization.supports import Supports, supports
from palpate.meshfree import ShapeFunctions, shape_functions
from palpate.meshfree.local_fit import local_fit_laplacian
from palpate.modes.elastic_modes import ElasticModes
from palpate_paper.membranes import Membrane
from palpate_paper.time_integration import EquationsOfMotion, with_multipliers

Array = NDArray[np.float64]

SUPPORT_RADIUS_FACTOR = 2.2
"""Support radius over node spacing of the linear basis."""


def conservative_modes(
    membrane: Membrane,
    contacts: Sequence[ArrayLike] = (),
    *,
    tension_n_per_m: float = 1.0,
    density_kg_per_m2: float = 1.0,
) -> ElasticModes:
    """All modes from K = T sum_a D_a^T A D_a and the mass rho A, A being the nodal areas, D the consistent gradient."""
    held = supports(membrane.n_nodes, membrane.on_edge, contacts)
    stiffness = tension_n_per_m * conservative_stiffness(membrane)
    free, tips = held.free, held.tips.toarray()
    inverse_root_mass = (density_kg_per_m2 * membrane.areas[free]) ** -0.5
    dynamic = inverse_root_mass[:, None] * stiffness[np.ix_(free, free)] * inverse_root_mass
    squared_frequencies, vectors = eigh(dynamic, overwrite_a=True)
    shapes = np.zeros((membrane.n_nodes, len(free)))
    shapes[free] = inverse_root_mass[:, None] * vectors
    input_coupling = shapes.T @ stiffness @ tips
    return ElasticModes(
        squared_frequencies=squared_frequencies,
        input_coupling=input_coupling,
        output_coupling=input_coupling.T,
        direct_stiffness=tips.T @ stiffness @ tips,
        shapes=shapes,
        patch_shapes=tips,
    )


def conservative_equations(
    membrane: Membrane,
    contacts: Sequence[ArrayLike] = (),
    *,
    tension_n_per_m: float = 1.0,
    density_kg_per_m2: float = 1.0,
) -> EquationsOfMotion:
    """The model of `conservative_modes` for time integration, sparse, in the shape functions' parameters."""
    held = supports(membrane.n_nodes, membrane.on_edge, contacts)
    h, gradient = _consistent_gradient(membrane)
    areas = diags_array(membrane.areas)
    mass = np.zeros(membrane.n_nodes)
    mass[held.free] = density_kg_per_m2 * membrane.areas[held.free]
    stiffness = sum((g.T @ areas @ g for g in gradient), start=0 * h.value)
    return with_multipliers(
        csr_array(h.value.T @ diags_array(mass) @ h.value),
        csr_array(tension_n_per_m * stiffness),
        h.value,
        held.prescribed,
        held.tips,
    )


def conservative_stiffness(membrane: Membrane) -> Array:
    """(n_nodes, n_nodes): sum_a D_a^T A D_a in nodal values, for unit tension."""
    h, gradient = _consistent_gradient(membrane)
    values = NodalValues(h.value)
    stiffness = np.zeros((membrane.n_nodes, membrane.n_nodes))
    for d in map(values.operator, gradient):
        stiffness += d.T @ (membrane.areas[:, None] * d)
    return stiffness


def _consistent_gradient(membrane: Membrane) -> tuple[ShapeFunctions, list[csr_array]]:
    radii = SUPPORT_RADIUS_FACTOR * membrane.spacing
    h = shape_functions(membrane.points, membrane.points, radii, order=1, derivatives=1)
    edge = membrane.edge.copy()
    rim = membrane.on_edge
    edge[rim] = obeying_divergence_theorem(edge[rim], membrane.points[rim], float(membrane.areas.sum()))
    return h, consistent_gradient(membrane.points, membrane.areas, membrane.spacing, edge, h, radii)


def collocation_modes(
    membrane: Membrane,
    contacts: Sequence[ArrayLike] = (),
    *,
    tension_n_per_m: float = 1.0,
    density_kg_per_m2: float = 1.0,
    order: int = 2,
) -> ElasticModes:
    """All modes of the collocated rho u'' = T lap(u); complex, since the operator is not symmetric.

    With basis order 2 the frequencies converge at second order. The linear basis (order 1), the paper's choice in
    three dimensions, is inconsistent for a second derivative: some 10 % off at any number of nodes. The force on a tip
    is minus the divergence of the stress there times the nodal area (the paper's c_tooltip).
    """
    held = supports(membrane.n_nodes, membrane.on_edge, contacts)
    free, tips = held.free, held.tips.toarray()
    operator = -tension_n_per_m * laplacian(membrane, order)
    squared_frequencies, vectors = eig(operator[np.ix_(free, free)] / density_kg_per_m2)
    ascending = np.argsort(np.abs(squared_frequencies), kind="stable")
    squared_frequencies, vectors = squared_frequencies[ascending], vectors[:, ascending]
    shapes = np.zeros((membrane.n_nodes, len(free)), dtype=np.complex128)
    shapes[free] = vectors
    driving = (operator[free] @ tips / density_kg_per_m2).astype(np.complex128)
    force = _tip_force(held, membrane, operator)
    return ElasticModes(
        squared_frequencies=squared_frequencies,
        input_coupling=np.linalg.solve(vectors, driving),
        output_coupling=force @ shapes,
        direct_stiffness=force @ tips,
        shapes=shapes,
        patch_shapes=tips,
    )


def collocation_equations(
    membrane: Membrane,
    contacts: Sequence[ArrayLike] = (),
    *,
    tension_n_per_m: float = 1.0,
    density_kg_per_m2: float = 1.0,
) -> EquationsOfMotion:
    """The model of `collocation_modes` with the quadratic basis for time integration, sparse, in nodal values."""
    held = supports(membrane.n_nodes, membrane.on_edge, contacts)
    n, tips = membrane.n_nodes, held.tips
    is_free = np.zeros(n)
    is_free[held.free] = 1.0
    free, prescribed = diags_array(is_free), diags_array(1.0 - is_free)
    operator = -tension_n_per_m * local_fit_laplacian(membrane.points)
    return EquationsOfMotion(
        mass=csr_array(density_kg_per_m2 * free),
        elastic=csr_array(free @ operator),
        algebraic=csr_array(prescribed),
        driving=tips,
        force_elastic=csr_array(tips.T @ diags_array(membrane.areas) @ operator),
        force_algebraic=csr_array((tips.shape[1], n)),
        value=csr_array(eye_array(n)),
    )


def laplacian(membrane: Membrane, order: int = 2) -> Array:
    """(n_nodes, n_nodes), 1/m²: the Laplacian at the nodes from the nodal values, by basis order 1 or 2."""
    if order == 2:
        return local_fit_laplacian(membrane.points).toarray()
    if order != 1:
        raise ValueError(f"order = {order}: expected 1 or 2")
    radii = SUPPORT_RADIUS_FACTOR * membrane.spacing
    h = shape_functions(membrane.points, membrane.points, radii, order=1, derivatives=2)
    xx, yy, _ = h.hessian
    return NodalValues(h.value).operator(xx + yy)


def _tip_force(held: Supports, membrane: Membrane, operator: Array) -> Array:
    """(n_contacts, n_nodes), N/m: force density times nodal area, summed over each patch."""
    return held.tips.T @ (membrane.areas[:, None] * operator)
