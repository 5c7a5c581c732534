"""A model that runs: what ticks do with it, whatever its kind. `models` makes one."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from palpate_client.wire import Flags
from palpate_server.coupling import fixed_patch, sphere_contact, spheres
from palpate_server.coupling.fixed_patch import FixedPatch
from palpate_server.coupling.spheres import SphereContact
from palpate_server.realtime.compiled import compiled

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Records = NDArray[np.void]
Record = Any  # one element of a structured array

_REST_FORCE_N = 1e-9
_REST_ENERGY_J = 1e-15
_IN_CONTACT = int(Flags.IN_CONTACT)


class Tip(NamedTuple):
    """The sphere that a tool touches a surface model with.

    stiffness_n_per_m: of the spring between device and sphere, in the model
    start_m: where its center is when it touches the undeformed tissue without pressing, m, in the model's frame
    """

    radius_m: float
    friction: float
    stiffness_n_per_m: float
    start_m: tuple[float, float, float]


class Running(NamedTuple):
    """A model with its state. Both kinds have a place, so that compiled code has one type for all models; one is empty.

    patch: of a patch model
    contact: of a surface model
    start, center: (n_tools, 3), m, of the spheres of a surface model: where their tools start, and where they are wanted
    """

    patch: FixedPatch
    contact: SphereContact
    start: Floats
    center: Floats

    def state_size(self) -> int:
        return self.patch.state_size() + self.start.size + self.contact.state_size()

    def shown_size(self) -> int:
        return self.patch.body.state.size + self.contact.shown_size()

    def restore(self, state: Floats) -> None:
        """Restore the state (state_size,) that `save` wrote, of the same model."""
        of_patch = self.patch.state_size()
        of_contact = of_patch + self.start.size
        self.patch.restore(state[:of_patch])
        self.start.ravel()[:] = state[of_patch:of_contact]
        self.contact.restore(state[of_contact:])


def empty() -> Running:
    """No model: nothing that `advance` changes, and a state of size 0."""
    return of_patch(fixed_patch.empty())


def of_patch(patch: FixedPatch) -> Running:
    nowhere = np.zeros((0, 3))
    return Running(patch, spheres.empty(0), nowhere, nowhere)


def of_contact(contact: SphereContact, start: Floats) -> Running:
    """start (n_tools, 3), m"""
    return Running(fixed_patch.empty(), contact, start, start.copy())


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
        ledger[0] = ledger[1] = 0.0
    elif running.start.shape[0] > 0:
        for i in range(displacement.shape[0]):
            for j in range(3):
                running.center[i, j] = running.start[i, j] + displacement[i, j]
        sphere_contact.advance(running.contact, running.center, wanted, force, reactions)
        sphere_contact.ledger(running.contact, ledger)


@compiled
def is_still(
    running: Running, displacement: Floats, force: Floats, reactions: Records, ledger: Floats
) -> bool:
    """Whether nothing moves that anybody would notice, after the tick with these arrays of `advance`."""
    if running.patch.normals.shape[0] == 0:
        for i in range(reactions.shape[0]):
            if reactions[i].flags & _IN_CONTACT:
                return False
        return ledger[0] <= _REST_ENERGY_J
    for i in range(force.shape[0]):
        for j in range(3):
            if displacement[i, j] != 0.0 or not abs(force[i, j]) <= _REST_FORCE_N:
                return False
    return True


@compiled
def set_tip(running: Running, tool: int, settings: Record) -> None:
    """Give a tool that touches nothing the tip in its settings (SETTINGS). A tool of a patch model has none."""
    if running.start.shape[0] > 0:
        for j in range(3):
            running.start[tool, j] = settings.start_m[j]
        spheres.set_tool(
            running.contact, tool, settings.radius_m, settings.friction, settings.stiffness_n_per_m
        )


@compiled
def put_to_rest(running: Running) -> None:
    fixed_patch.put_to_rest(running.patch)
    spheres.put_to_rest(running.contact)


@compiled
def save_shown(running: Running, state: Floats) -> None:
    """Write what the shown surface depends on into `state` (shown_size,)."""
    fixed_patch.save_shown(running.patch, state)
    spheres.save_shown(running.contact, state)


@compiled
def save(running: Running, state: Floats, place: int) -> int:
    """Write the state into `state` from `place` on. Returns the place behind it."""
    place = fixed_patch.save(running.patch, state, place)
    for i in range(running.start.shape[0]):
        for j in range(3):
            state[place] = running.start[i, j]
            place += 1
    return spheres.save(running.contact, state, place)
