"""A model that runs: what ticks do with it, whatever its kind. `models` makes one."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from palpate_server.coupling import fixed_patch
from palpate_server.coupling.fixed_patch import FixedPatch
from palpate_server.realtime.compiled import compiled

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Records = NDArray[np.void]

LIFTED, TOUCHING, GRABBING = range(3)  # what is wanted of a tool in a tick

_REST_FORCE_N = 1e-9


class Running(NamedTuple):
    """A model with its state. Both kinds have a place, so that compiled code has one type for all models; one is empty.

    patch: of a patch model
    """

    patch: FixedPatch

    def state_size(self) -> int:
        return self.patch.state_size()

    def shown_size(self) -> int:
        return self.patch.body.state.size

    def restore(self, state: Floats) -> None:
        """Restore the state (state_size,) that `save` wrote, of the same model."""
        self.patch.restore(state)


def empty() -> Running:
    """No model: nothing that `advance` changes, and a state of size 0."""
    return Running(fixed_patch.empty())


@compiled
def advance(
    running: Running,
    displacement: Floats,
    wanted: Integers,
    force: Floats,
    reactions: Records,
    ledger: Floats,
) -> None:
    """One tick: write the forces on the tools, and how they touch; advance the state.

    displacement (n, 3), m, of each tip from its tool's start; wanted (n,), LIFTED, TOUCHING or GRABBING; force (n, 3), N;
    reactions (n,) REACTION; ledger (2,), J: stored in the tissue, dissipated in it. All in the model's frame.
    """
    if running.patch.normals.shape[0] > 0:
        fixed_patch.advance(running.patch, displacement, force, reactions)


@compiled
def is_still(running: Running, displacement: Floats, force: Floats) -> bool:
    """Whether nothing moves that anybody would notice, after the tick with this displacement and force, each (n, 3)."""
    for i in range(force.shape[0]):
        for j in range(3):
            if displacement[i, j] != 0.0 or not abs(force[i, j]) <= _REST_FORCE_N:
                return False
    return True


@compiled
def put_to_rest(running: Running) -> None:
    fixed_patch.put_to_rest(running.patch)


@compiled
def save_shown(running: Running, state: Floats) -> None:
    """Write what the shown surface depends on into `state` (shown_size,)."""
    fixed_patch.save_shown(running.patch, state)


@compiled
def save(running: Running, state: Floats, place: int) -> int:
    """Write the state into `state` from `place` on. Returns the place behind it."""
    return fixed_patch.save(running.patch, state, place)
