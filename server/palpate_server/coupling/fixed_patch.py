"""Each tool is bound to a patch of a reduced state space: the displacement of its tip goes in, the force comes out."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from palpate.model_file import StateSpace
from palpate_server.bodies import state_space
from palpate_server.bodies.state_space import StateSpaceBody
from palpate_server.realtime.compiled import compiled

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Records = NDArray[np.void]


class FixedPatch(NamedTuple):
    """A body whose patches follow the tips.

    body: of 3 channels a tool; without channels, nothing is here
    normals: (n_tools, 3), outward, unit
    n_nodes: (n_tools,) of each patch
    before: (n_tools, 3), m, displacement at the tick before
    work: (n_tools,), J, that the tips did on the body
    """

    body: StateSpaceBody
    normals: Floats
    n_nodes: Integers
    before: Floats
    work: Floats

    def state_size(self) -> int:
        return self.body.state.size + self.before.size + self.work.size

    def restore(self, state: Floats) -> None:
        """Restore the state (state_size,) that `save` wrote, of the same model."""
        order, n = self.body.state.size, self.before.size
        self.body.state[:] = state[:order]
        self.before.ravel()[:] = state[order : order + n]
        self.work[:] = state[order + n :]


def make(
    system: StateSpace, normals: Floats, n_nodes: Integers, displacement: Floats | None = None
) -> FixedPatch:
    """Patches at rest, or settled at `displacement` (n_tools, 3), m."""
    n = len(system.c) // 3
    before = np.zeros((n, 3)) if displacement is None else displacement.copy()
    settled = None if displacement is None else displacement.ravel()
    return FixedPatch(state_space.make_body(system, settled), normals, n_nodes, before, np.zeros(n))


def empty() -> FixedPatch:
    """No patch."""
    nothing = state_space.empty_body(0)
    return FixedPatch(nothing, np.zeros((0, 3)), np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros(0))


@compiled
def advance(patch: FixedPatch, displacement: Floats, force: Floats, reactions: Records) -> None:
    """One tick: write the forces on the tools (n, 3), N, at these displacements (n, 3), m, and advance the body.

    reactions (n,) REACTION; all in the model's frame
    """
    inputs = displacement.reshape(displacement.size)
    state_space.output(patch.body, inputs)
    state_space.update(patch.body, inputs)
    holding = patch.body.force  # the force that holds the tissue there
    for i in range(displacement.shape[0]):
        reaction = reactions[i]
        depth = 0.0
        for j in range(3):
            force[i, j] = -holding[3 * i + j]
            reaction.normal[j] = patch.normals[i, j]
            depth -= patch.normals[i, j] * displacement[i, j]
            patch.work[i] += holding[3 * i + j] * (displacement[i, j] - patch.before[i, j])
            patch.before[i, j] = displacement[i, j]
        reaction.penetration_m = depth
        reaction.n_contact_points = patch.n_nodes[i]
        reaction.flags = 0  # what another model wrote before does not stay
        reaction.slip_m = reaction.stored_j = reaction.dissipated_j = 0.0
        reaction.work_j = patch.work[i]


@compiled
def put_to_rest(patch: FixedPatch) -> None:
    patch.body.state[:] = 0.0
    patch.before[:] = 0.0
    patch.work[:] = 0.0


@compiled
def save_shown(patch: FixedPatch, state: Floats) -> None:
    """Write what the shown surface depends on, beside the displacement: the body's state."""
    for i in range(patch.body.state.size):
        state[i] = patch.body.state[i]


@compiled
def save(patch: FixedPatch, state: Floats, place: int) -> int:
    """Write the state into `state` from `place` on, the body's first. Returns the place behind it."""
    body, before, work = patch.body.state, patch.before, patch.work
    for i in range(body.size):  # element by element: a slice would compile numpy's checks of shapes
        state[place + i] = body[i]
    place += body.size
    for i in range(before.shape[0]):
        for j in range(3):
            state[place] = before[i, j]
            place += 1
    for i in range(work.size):
        state[place] = work[i]
        place += 1
    return place
