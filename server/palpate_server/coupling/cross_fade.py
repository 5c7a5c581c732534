"""What connects the ports with the model that runs; while another model is loaded, its force fades in.

All arrays of the functions below are in the model's frame.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from palpate_server.coupling import running as models
from palpate_server.coupling.running import Running
from palpate_server.realtime.compiled import compiled
from palpate_server.realtime.records import REACTION

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Records = NDArray[np.void]
Record = Any  # one element of a structured array


class Coupling(NamedTuple):
    """The model that runs, and the one that is being faded in.

    fade (2,): the share of the following model's force, and by how much it grows each tick: 0 without a following model
    force (n_tools, 3), reactions (n_tools,), ledger (2,): of the following model
    """

    running: Running
    following: Running
    fade: Floats
    force: Floats
    reactions: Records
    ledger: Floats

    @property
    def n_tools(self) -> int:
        return len(self.force)

    def state_size(self) -> int:
        return self.running.state_size() + self.following.state_size() + len(self.fade)

    def shown_size(self) -> int:
        return self.running.shown_size()

    def restore(self, state: Floats) -> None:
        """Restore a state that `save` wrote, of a coupling with the same models. Raises ValueError for another size."""
        if state.shape != (self.state_size(),):
            raise ValueError(f"state has shape {state.shape}: expected ({self.state_size()},)")
        size = self.running.state_size()
        self.running.restore(state[:size])
        self.following.restore(state[size:-2])
        self.fade[:] = state[-2:]


def make(running: Running, n_tools: int) -> Coupling:
    """A coupling with one model."""
    return _make(running, models.empty(), n_tools, 0.0)


def to_another(coupling: Coupling, following: Running, step: float) -> Coupling:
    """The coupling that fades over to another model; `step`: by how much the share of its force grows each tick."""
    return _make(coupling.running, following, coupling.n_tools, step)


def after(fading: Coupling) -> Coupling:
    """The coupling after the cross-fade, with the following model alone."""
    return make(fading.following, fading.n_tools)


def _make(running: Running, following: Running, n_tools: int, step: float) -> Coupling:
    force, reactions = np.zeros((n_tools, 3)), np.zeros(n_tools, REACTION)
    return Coupling(running, following, np.array([0.0, step]), force, reactions, np.zeros(2))


@compiled
def advance(
    coupling: Coupling,
    displacement: Floats,
    wanted: Integers,
    force: Floats,
    reactions: Records,
    ledger: Floats,
) -> None:
    """One tick, as `running.advance`. While another model is faded in, the reactions and the ledger are the running one's."""
    models.advance(coupling.running, displacement, wanted, force, reactions, ledger)
    fade = coupling.fade
    if fade[1] > 0.0:
        following = coupling.force
        models.advance(
            coupling.following, displacement, wanted, following, coupling.reactions, coupling.ledger
        )
        fade[0] = min(1.0, fade[0] + fade[1])
        for i in range(force.shape[0]):
            for j in range(3):
                force[i, j] += fade[0] * (following[i, j] - force[i, j])


@compiled
def is_still(
    coupling: Coupling, displacement: Floats, force: Floats, reactions: Records, ledger: Floats
) -> bool:
    """Whether no model is being faded in, and nothing moves that anybody would notice."""
    return coupling.fade[1] == 0.0 and models.is_still(
        coupling.running, displacement, force, reactions, ledger
    )


@compiled
def set_tip(coupling: Coupling, tool: int, settings: Record) -> None:
    """Give a tool that touches nothing the tip in its settings (SETTINGS)."""
    models.set_tip(coupling.running, tool, settings)
    models.set_tip(coupling.following, tool, settings)


@compiled
def put_to_rest(coupling: Coupling) -> None:
    models.put_to_rest(coupling.running)
    models.put_to_rest(coupling.following)


@compiled
def save_shown(coupling: Coupling, state: Floats) -> None:
    """Copy what the surface of the running model depends on into `state` (shown_size,)."""
    models.save_shown(coupling.running, state)


@compiled
def save(coupling: Coupling, state: Floats) -> None:
    """Copy all that ticks change into `state` (state_size,)."""
    place = models.save(coupling.running, state, 0)
    place = models.save(coupling.following, state, place)
    state[place] = coupling.fade[0]
    state[place + 1] = coupling.fade[1]
