"""Ritz modes beside the lowest modes: the body in the span of the modes and of further fields.

The fields are made orthonormal in the mass, to the modes, too. These are modes of the larger span as well, so they change by no
more than what they had not converged, and the Ritz modes have higher frequencies than the highest of them. All are taken from
one Galerkin projection: so what it leaves of the static compliance is semidefinite, whatever the fields are.

Which fields: what the static responses to the smallest tool leave out beside the modes, a field for each point and direction,
differs from the truth in the band by its inertia. So those combinations of them are taken that have the most inertia: the
first principal directions in the mass, by the randomized method of Halko, Martinsson & Tropp 2011.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import eigh
from scipy.sparse import csr_array

from palpate.modes.held_body import HeldBody
from palpate.modes.krylov import KrylovSpace
from palpate.modes.lanczos import LowestModes

Array = NDArray[np.float64]

BLOCK = 96
"""Fields that are made orthonormal at once."""

_PASSES, _SPARE = 3, 16


@dataclass(frozen=True)
class Added:
    """Modes, and fields beside them.

    vectors    (c n_nodes, n_modes + k), orthonormal in the mass, the modes first
    stiffness  (n_modes + k, n_modes + k), between them
    ends       numbers of vectors behind the modes that span the first fields, ascending, the last of them k
    """

    vectors: Array
    stiffness: Array
    ends: tuple[int, ...]

    def ritz(self, end: int) -> tuple[Array, Array]:
        """Squared frequencies (n,), ascending, and combinations (n, n) of the modes and the first `end` vectors behind them."""
        n = len(self.stiffness) - self.ends[-1] + end
        mu, rotation = eigh(self.stiffness[:n, :n])
        return mu, rotation

    def ritz_modes(self, end: int) -> LowestModes:
        """Modes and Ritz modes in the modes and the first `end` vectors behind them."""
        mu, rotation = self.ritz(end)
        return LowestModes(mu, self.vectors[:, : len(mu)] @ rotation)


def added(held: HeldBody, modes: LowestModes, fields: Array, n_powers: int = 0, block: int = BLOCK) -> Added:
    """The modes and the span of fields (c n_nodes, k), K⁻¹ M fields, ..., (K⁻¹ M)^n_powers fields.

    block  fields from one of `Added.ends` to the next

    Raises MemoryError where the vectors do not fit.
    """
    known = modes.parameters.shape[1]
    space = KrylovSpace(held.body, held.constraints, known + (1 + n_powers) * fields.shape[1])
    space.resume(modes.parameters, 0)
    ends, source = [], fields
    for power in range(1 + n_powers):
        first = space.size
        for start in range(0, source.shape[1], block):
            part = source[:, start : start + block]
            space.append(held.approximate(held.body.inertia(part)) if power else part)
            ends.append(space.size - known)
        source = space.vectors[:, first:].copy()
    vectors = space.vectors
    stiffness = vectors.T @ (held.body.stiffness @ vectors)
    return Added(vectors, (stiffness + stiffness.T) / 2, tuple(ends))


def dominant_fields(
    held: HeldBody, responses: NDArray[np.float32], spread: csr_array, weights: Array, count: int
) -> Array:
    """(c n_nodes, count): the combinations of static responses with the most inertia, the largest first.

    responses  (3 n_points, c n_nodes), to unit forces at points
    spread     (3 n_points, 3 n_points), that spreads unit forces over footprints
    weights    (n_points,), of the footprints
    """
    load = csr_array(spread.multiply(np.repeat(weights, 3)[:, None]))
    some = min(count + _SPARE, len(responses))
    directions = np.random.default_rng(0).standard_normal((len(responses), some))
    for _ in range(_PASSES):
        images = load @ (responses @ held.body.inertia(_fields(responses, load, directions)))
        directions, _ = np.linalg.qr(images)
    fields = _fields(responses, load, directions)
    # Rayleigh and Ritz once more, to have the directions in order.
    inertia, rotation = eigh(fields.T @ held.body.inertia(fields))
    return np.asarray(fields @ rotation[:, np.argsort(-inertia)[:count]])


def _fields(responses: NDArray[np.float32], load: csr_array, directions: Array) -> Array:
    return np.asarray(responses.T @ (load.T @ directions).astype(np.float32), dtype=np.float64)
