"""Load-dependent Ritz modes: what the contact patches can feel of a large body, from one factorization.

The body is projected onto the block Krylov vectors that the static responses to the patches start (Wilson, Yuan & Dickens
1982; Nour-Omid & Clough 1984). K and M stay symmetric, so the model is stable and passive, and the static response lies in
the space, so it is exact at 0 Hz. Diagonalized, it has the form of any other `ElasticModes`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import eigh

from palpate.discretization.assembled_body import AssembledBody
from palpate.modes.elastic_modes import ElasticModes
from palpate.modes.held_body import HeldBody, hold
from palpate.modes.krylov import KrylovSpace

Array = NDArray[np.float64]

STEPS_JUDGED = 20
"""Steps (60 vectors of one patch) over whose last the change of the force is measured."""

MOST_STEPS = 200
"""Steps at 0 Hz after which a body counts as not converged."""


@dataclass(frozen=True)
class RitzModes:
    """The projected body, and how far it has converged.

    modes   of the body
    change  largest change of the force over the last 20 steps at 0 Hz, relative to the force at the same frequency, in
            2-norms: about the error of a model with that many steps fewer, and so above the error of this one
    solver  the direct solver that was used
    """

    modes: ElasticModes
    change: float
    solver: str


def ritz_modes(
    body: AssembledBody,
    squared_s: NDArray[np.complex128],
    tolerance: float,
    shifts: Sequence[tuple[float, int]] = (),
) -> RitzModes:
    """Add static responses until the force changes by at most `tolerance`, or for 200 steps; then those at the shifts.

    squared_s  (n_frequencies,), (rad/s)²: s² / h(s) at the frequencies where the force is compared, h being the material's
               transfer factor
    shifts     (sigma, number of steps) each: responses of K + sigma M, sigma in (rad/s)² above 0, which serve frequencies
               about sqrt(sigma) and take one factorization each

    Raises as `hold`; ValueError where no node is in a patch.
    """
    supports, c = body.supports, body.n_components
    if not supports.contacts:
        raise ValueError("the body has no contact patch: expected one, to which the Ritz vectors respond")
    patch: Array = np.kron(body.basis.parameters(supports.tips.toarray()), np.eye(c)).astype(np.float64)
    n_inputs = c * len(supports.contacts)
    patch_force = body.stiffness @ patch
    direct = patch.T @ patch_force
    n_steps = MOST_STEPS + sum(steps for _, steps in shifts)
    nothing = np.zeros((0, n_inputs)), np.zeros((0, 0))
    projected = _Projected(body, patch_force, (direct + direct.T) / 2, *nothing)
    space = KrylovSpace(len(patch), most=n_steps * n_inputs)

    held = hold(body, supports.prescribed)
    solver = held.factor.solver
    growing = space.append(held, held.solve(patch_force))
    projected = projected.extended(space.vectors)
    change, force = np.inf, projected.force(squared_s)
    while growing and change > tolerance and space.size < MOST_STEPS * n_inputs:
        for _ in range(STEPS_JUDGED):
            growing = growing and _extend(space, held)
        projected = projected.extended(space.vectors)
        before, force = force, projected.force(squared_s)
        change = _largest_relative(force - before, force)
    for sigma, steps in shifts:
        del held  # one factor at a time is all that a large body's memory holds
        held = hold(body, supports.prescribed, sigma)
        growing = True  # the last block holds more that is new than the response to the patch does
        for _ in range(steps):
            growing = growing and _extend(space, held)
    return RitzModes(projected.extended(space.vectors).modes(space.vectors, patch), change, solver)


@dataclass(frozen=True)
class _Projected:
    """The body in the coordinates of vectors V: D = U_tᵀ K U_t, Vᵀ K U_t and Vᵀ K V, for patch parameters U_t."""

    body: AssembledBody
    patch_force: Array
    direct: Array
    coupling: Array
    stiffness: Array

    def extended(self, vectors: Array) -> _Projected:
        """With further vectors; what is known of the first ones is kept."""
        known = len(self.stiffness)
        new = vectors.T @ (self.body.stiffness @ vectors[:, known:])
        corner = (new[known:] + new[known:].T) / 2
        stiffness = np.block([[self.stiffness, new[:known]], [new[:known].T, corner]])
        return replace(self, coupling=vectors.T @ self.patch_force, stiffness=stiffness)

    def force(self, squared_s: NDArray[np.complex128]) -> NDArray[np.complex128]:
        """(n_frequencies, n_inputs, n_inputs): the force over the transfer factor, per unit displacement."""
        mu, rotation = eigh(self.stiffness)
        coupling = rotation.T @ self.coupling
        return self.direct - np.einsum("ki,fk,kj->fij", coupling, 1 / (squared_s[:, None] + mu), coupling)

    def modes(self, vectors: Array, patch: Array) -> ElasticModes:
        """Diagonalized."""
        mu, rotation = eigh(self.stiffness)
        coupling = rotation.T @ self.coupling
        return ElasticModes(
            squared_frequencies=mu,
            input_coupling=coupling,
            output_coupling=coupling.T,
            direct_stiffness=self.direct,
            parameters=vectors @ rotation,
            patch_parameters=patch,
        )


def _extend(space: KrylovSpace, held: HeldBody) -> bool:
    """Append (K + sigma M)⁻¹ M times the last block.

    Without the correction in `respond` the responses at 0 Hz and at a shift would belong to bodies with supports of
    different compliance, and their difference, not the shift, would be what is new in the second ones.
    """
    return space.append(held, held.respond(held.body.inertia(space.last_block)))


def _largest_relative(difference: NDArray[np.complex128], force: NDArray[np.complex128]) -> float:
    ratios = np.linalg.norm(difference, 2, axis=(1, 2)) / np.linalg.norm(force, 2, axis=(1, 2))
    return float(np.max(ratios))
