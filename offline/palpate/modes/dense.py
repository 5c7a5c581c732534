"""All modes of an assembled body by dense linear algebra: for bodies of a few thousand nodes."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import eig, eigh, lu_factor, lu_solve

from palpate.discretization.assembled_body import AssembledBody
from palpate.discretization.supports import components
from palpate.modes.elastic_modes import ElasticModes

Array = NDArray[np.float64]
RealOrComplex = NDArray[Any]
Factor = tuple[Array, NDArray[np.int32]]


def elastic_modes(body: AssembledBody) -> ElasticModes:
    """All modes, computed in nodal values: (c n_free)³ work."""
    c, held = body.n_components, body.supports
    free = components(held.free, c)
    mass = np.repeat(body.mass[held.free], c)
    moving, followers = np.flatnonzero(mass > 0), np.flatnonzero(mass == 0)
    factor = _factor(body)
    stiffness, following = _condensed(_nodal_stiffness(body, factor), len(mass), moving, followers)
    solve = _symmetric_modes if body.symmetric else _nonsymmetric_modes
    n = len(moving)
    coupling, force, direct = stiffness[:n, n:].copy(), stiffness[n:, :n].copy(), stiffness[n:, n:].copy()
    dynamic = np.array(stiffness[:n, :n], order="F")
    del stiffness
    squared_frequencies, vectors, input_coupling = solve(dynamic, mass[moving], coupling)

    shapes = np.zeros((c * body.n_nodes, n), dtype=vectors.dtype)
    shapes[free[moving]] = vectors
    shapes[free[followers]] = following[:, :n] @ vectors
    patch_shapes = np.kron(held.tips.toarray(), np.eye(c))
    patch_shapes[free[followers]] = following[:, n:]
    return ElasticModes(
        squared_frequencies=squared_frequencies,
        input_coupling=input_coupling,
        output_coupling=input_coupling.T if body.symmetric else force @ vectors,
        direct_stiffness=direct,
        parameters=_parameters(factor, shapes),
        patch_parameters=_parameters(factor, patch_shapes),
    )


def nodal_stiffness(body: AssembledBody) -> Array:
    """(c m, c m), N/m: forces on the m = n_free + n_contacts free nodes and tips from their displacements.

    K H⁻¹, and H⁻ᵀ K H⁻¹ of a symmetric body, in which the nodes of a patch move as one and their forces add up.
    """
    return _nodal_stiffness(body, _factor(body))


def _nodal_stiffness(body: AssembledBody, factor: Factor) -> Array:
    c, kinematics = body.n_components, body.supports.kinematics
    m = kinematics.shape[1]
    stiffness = np.empty((m, c, m, c))
    for a in range(c):
        for b in range(a + 1 if body.symmetric else c):
            block = lu_solve(factor, body.stiffness[a::c, b::c].T.toarray(order="F"), trans=1).T
            if body.symmetric:
                block = lu_solve(factor, block, trans=1)
                if a == b:
                    block = (block + block.T) / 2
            block = kinematics.T @ block @ kinematics
            stiffness[:, a, :, b] = block
            if body.symmetric:
                stiffness[:, b, :, a] = block.T
    return stiffness.reshape(c * m, c * m)


def _factor(body: AssembledBody) -> Factor:
    """The dense LU factor of H, faster than a sparse one for as many right-hand sides as there are nodes."""
    return lu_factor(body.basis.value.toarray(order="F"), overwrite_a=True, check_finite=False)


def _parameters(factor: Factor, values: RealOrComplex) -> RealOrComplex:
    """(c n_nodes, k): the parameters of fields given by their nodal values (c n_nodes, k)."""
    n_nodes = len(factor[0])
    return lu_solve(factor, values.reshape(n_nodes, -1), check_finite=False).reshape(values.shape)


def _condensed(
    stiffness: Array, n_free: int, moving: NDArray[np.intp], followers: NDArray[np.intp]
) -> tuple[Array, Array]:
    """The stiffness of the moving components and the tips, the massless `followers` being in equilibrium with them.

    Returns it and (n_followers, n_moving + n_tips), the displacements of the followers.
    """
    kept = np.concatenate([moving, np.arange(n_free, len(stiffness))])
    if not len(followers):
        return stiffness, np.zeros((0, len(kept)))
    following = -np.linalg.solve(stiffness[np.ix_(followers, followers)], stiffness[np.ix_(followers, kept)])
    return (
        stiffness[np.ix_(kept, kept)] + stiffness[np.ix_(kept, followers)] @ following,
        following,
    )


def _symmetric_modes(dynamic: Array, mass: Array, coupling: Array) -> tuple[Array, Array, Array]:
    """(mu ascending, mass-normalized vectors, input coupling); overwrites `dynamic`."""
    inverse_root_mass = mass**-0.5
    dynamic *= inverse_root_mass[:, None]
    dynamic *= inverse_root_mass
    mu, vectors = eigh(dynamic, driver="evd", overwrite_a=True, check_finite=False)
    vectors *= inverse_root_mass[:, None]
    return mu, vectors, vectors.T @ coupling


def _nonsymmetric_modes(
    dynamic: Array, mass: Array, coupling: Array
) -> tuple[RealOrComplex, RealOrComplex, RealOrComplex]:
    """(mu ascending in size, vectors, input coupling), complex; overwrites `dynamic`."""
    dynamic /= mass[:, None]
    mu, vectors = eig(dynamic, overwrite_a=True, check_finite=False)
    ascending = np.argsort(np.abs(mu), kind="stable")
    mu, vectors = mu[ascending], vectors[:, ascending]
    return mu, vectors, np.linalg.solve(vectors, (coupling / mass[:, None]).astype(np.complex128))


def dense_memory(n_nodes: int, n_free: int, n_components: int, symmetric: bool) -> float:
    """Bytes that all modes of a body need; n_free nodes are neither held nor in a patch."""
    matrices = 3 if symmetric else 6  # complex vectors count twice
    return 8.0 * (matrices * (n_components * n_free) ** 2 + 5 * n_nodes**2)
