"""Each port is bound to a patch of a reduced state space: the displacement of its tip goes in, the force comes out."""

from __future__ import annotations

import sys
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from palpate.model_file import StateSpace
from palpate_server import coupling as couplings
from palpate_server.bodies import state_space
from palpate_server.bodies.state_space import StateSpaceBody

Floats = NDArray[np.float64]


class FixedPatch(NamedTuple):
    """A body, and the one that is being faded in.

    fade (2,): the share of the following body's force, and by how much it grows each tick: 0 without a following body
    """

    body: StateSpaceBody
    following: StateSpaceBody
    fade: Floats

    @property
    def n_tools(self) -> int:
        return len(self.body.force) // 3

    def state_size(self) -> int:
        return len(self.body.state) + len(self.following.state) + len(self.fade)

    def restore(self, state: Floats) -> None:
        """Restore a state that `save` wrote, of a coupling with the same models. Raises ValueError for another size."""
        if state.shape != (self.state_size(),):
            raise ValueError(f"state has shape {state.shape}: expected ({self.state_size()},)")
        order = len(self.body.state)
        self.body.state[:] = state[:order]
        self.following.state[:] = state[order:-2]
        self.fade[:] = state[-2:]


def make(system: StateSpace) -> FixedPatch:
    """A coupling with a body at rest."""
    return FixedPatch(state_space.make_body(system), state_space.empty_body(len(system.c)), np.zeros(2))


def cross_fade(running: FixedPatch, system: StateSpace, displacement: Floats, step: float) -> FixedPatch:
    """The coupling that cross-fades to another model, whose body begins settled at `displacement` (n_tools, 3), m.

    step: by how much the share of its force grows each tick
    """
    following = state_space.make_body(system, displacement.ravel())
    return FixedPatch(running.body, following, np.array([0.0, step]))


def after_cross_fade(fading: FixedPatch) -> FixedPatch:
    """The coupling after the cross-fade: of the following body alone."""
    return FixedPatch(fading.following, state_space.empty_body(len(fading.body.force)), np.zeros(2))


# For compiled code; see `palpate_server.coupling`.


def advance(coupling: FixedPatch, displacement: Floats, force: Floats) -> None:
    inputs = displacement.reshape(displacement.size)
    state_space.output(coupling.body, inputs)
    state_space.update(coupling.body, inputs)
    share = 0.0
    if coupling.fade[1] > 0.0:
        state_space.output(coupling.following, inputs)
        state_space.update(coupling.following, inputs)
        share = min(1.0, coupling.fade[0] + coupling.fade[1])
        coupling.fade[0] = share
    outputs = force.reshape(force.size)
    for i in range(outputs.size):
        holding = coupling.body.force[i]  # the force that holds the tissue there
        if share > 0.0:
            holding += share * (coupling.following.force[i] - coupling.body.force[i])
        outputs[i] = -holding


def is_fading(coupling: FixedPatch) -> bool:
    return coupling.fade[1] > 0.0


def put_to_rest(coupling: FixedPatch) -> None:
    coupling.body.state[:] = 0.0
    coupling.following.state[:] = 0.0


def save(coupling: FixedPatch, state: Floats) -> None:
    place = 0  # element by element: a slice would compile numpy's checks of shapes
    for values in (coupling.body.state, coupling.following.state, coupling.fade):
        for i in range(values.size):
            state[place] = values[i]
            place += 1


couplings.register(FixedPatch, sys.modules[__name__])
