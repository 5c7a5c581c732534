"""Load-dependent Ritz modes: what the contact patches can feel of a large body, from one factorization.

The body is projected onto the block Krylov vectors that the static responses to the patches start (Wilson, Yuan & Dickens
1982; Nour-Omid & Clough 1984). K and M stay symmetric, so the model is stable and passive, and the static response lies in
the space, so it is exact at 0 Hz. Diagonalized, it has the form of any other `ElasticModes`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import eigh

from palpate.discretization.assembled_body import AssembledBody
from palpate.modes.elastic_modes import ElasticModes
from palpate.modes.held_body import hold
from palpate.modes.krylov import KrylovSpace

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

STEPS_JUDGED = 20
"""Steps (60 vectors of one patch) after which the force is compared with what it was before them."""

MOST_STEPS = 200
"""Steps at 0 Hz after which a body counts as not converged."""


@dataclass(frozen=True)
class StaticSpace:
    """The Krylov vectors at 0 Hz, which depend on the shape of the body, its supports and Poisson's ratio alone.

    vectors    (c n_nodes, n), V
    stiffness  (n, n), Vᵀ K V
    ends       numbers of vectors at which the force is compared, ascending
    last       number of vectors of the last step
    exhausted  whether a further step would hold nothing new
    """

    vectors: Array
    stiffness: Array
    ends: tuple[int, ...]
    last: int
    exhausted: bool


@dataclass(frozen=True)
class RitzModes:
    """The projected body, and how far it has converged.

    modes   of the body
    change  largest change of the force over the last 20 steps at 0 Hz, relative to the force at the same frequency, in
            2-norms: about the error of a model with that many steps fewer, and so above the error of this one
    space   all vectors at 0 Hz that are known, to be given to the next call for the same body
    """

    modes: ElasticModes
    change: float
    space: StaticSpace


def ritz_modes(
    body: AssembledBody,
    squared_s: Complex,
    tolerance: float,
    known: StaticSpace | None = None,
) -> RitzModes:
    """Static responses until the force changes by at most `tolerance`, or for 200 steps.

    squared_s  (n_frequencies,), (rad/s)²: s² / h(s) at the frequencies where the force is compared, h being the material's
               transfer factor
    known      vectors of a call before; the body is not factorized where they are enough

    Raises as `hold`; ValueError where no node is in a patch.
    """
    supports, c = body.supports, body.n_components
    if not supports.contacts:
        raise ValueError("the body has no contact patch: expected one, to which the Ritz vectors respond")
    patch: Array = np.kron(body.basis.parameters(supports.tips.toarray()), np.eye(c)).astype(np.float64)
    n_inputs = patch.shape[1]
    patch_force = body.stiffness @ patch
    direct = patch.T @ patch_force
    empty = _Projected(body, patch_force, (direct + direct.T) / 2, np.zeros((0, n_inputs)), np.zeros((0, 0)))
    static = known or StaticSpace(np.zeros((len(patch), 0)), np.zeros((0, 0)), (), 0, False)
    end, change = _enough(empty, static, squared_s, tolerance)
    if end is None:
        static, end, change = _extended(empty, static, squared_s, tolerance)

    projected = empty.on(static, end)
    return RitzModes(projected.modes(static.vectors[:, :end], patch), change, static)


def _enough(
    empty: _Projected, static: StaticSpace, squared_s: Complex, tolerance: float
) -> tuple[int | None, float]:
    """The number of vectors after which the force changes no more, None where they are too few, and the last change."""
    force, change = None, np.inf
    for end in static.ends:
        before, force = force, empty.on(static, end).force(squared_s)
        if before is not None:
            change = _largest_relative(force - before, force)
        if change <= tolerance:
            return end, change
    return (static.ends[-1] if static.exhausted else None), change


def _extended(
    empty: _Projected, static: StaticSpace, squared_s: Complex, tolerance: float
) -> tuple[StaticSpace, int, float]:
    """More static responses until they are enough: the space, the number of vectors to use, and the last change."""
    body = empty.body
    held = hold(body, body.supports.prescribed)
    most = MOST_STEPS * empty.patch_force.shape[1]
    space = KrylovSpace(body, held.constraints, most)
    space.resume(static.vectors, static.last)
    end = None
    while end is None:
        growing = True
        if not space.size:
            growing = space.append(held.solve(empty.patch_force))
        else:
            for _ in range(STEPS_JUDGED):
                growing = growing and space.append(held.approximate(body.inertia(space.last_block)))
        projected = empty.on(static, static.vectors.shape[1]).extended(space.vectors)
        exhausted = not growing or space.size >= most
        last = space.last_block.shape[1]
        static = StaticSpace(space.vectors, projected.stiffness, (*static.ends, space.size), last, exhausted)
        end, change = _enough(empty, static, squared_s, tolerance)
    return static, end, change


@dataclass(frozen=True)
class _Projected:
    """The body in the coordinates of vectors V: D = U_tᵀ K U_t, Vᵀ K U_t and Vᵀ K V, for patch parameters U_t."""

    body: AssembledBody
    patch_force: Array
    direct: Array
    coupling: Array
    stiffness: Array

    def on(self, static: StaticSpace, end: int) -> _Projected:
        """On the first `end` vectors of a space."""
        return replace(
            self,
            coupling=static.vectors[:, :end].T @ self.patch_force,
            stiffness=static.stiffness[:end, :end],
        )

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


def _largest_relative(difference: NDArray[np.complex128], force: NDArray[np.complex128]) -> float:
    ratios = np.linalg.norm(difference, 2, axis=(1, 2)) / np.linalg.norm(force, 2, axis=(1, 2))
    return float(np.max(ratios))
