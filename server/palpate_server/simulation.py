"""A surface model stepped in process, without a server: positions of the tools in, forces and contacts out."""

from __future__ import annotations

import contextlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from palpate.model_file import SurfaceModel
from palpate_client.wire import MAX_POSITION_M, Flags
from palpate_server.coupling import sphere_contact, spheres
from palpate_server.coupling.spheres import DEFAULT_STIFFNESS_N_PER_M
from palpate_server.realtime import native_image
from palpate_server.realtime.compiled import compiled
from palpate_server.realtime.native_image import Image, view
from palpate_server.realtime.records import REACTION

Floats = NDArray[np.float64]
Records = NDArray[np.void]

_LEAST_STIFFNESS_N_PER_M, _MOST_STIFFNESS_N_PER_M = 1e-6, 1e12


@dataclass(frozen=True)
class Reaction:
    """What a tool feels, and how it touches; energies since the simulation began.

    force_n        (3,), of the tissue on the tool
    normal         (3,), of the contact, out of the tissue, of length 1; zero without contact
    penetration_m  of the tool beneath the surface at rest
    slip_m         of the tool along the tissue in this step
    n_points       points of the surface in contact
    flags          IN_CONTACT, SLIDING, ATTACHED
    work_j, stored_j, dissipated_j  work that the tool did, energy in its coupling spring, energy lost in its contact
    """

    force_n: Floats
    normal: Floats
    penetration_m: float
    slip_m: float
    n_points: int
    flags: Flags
    work_j: float
    stored_j: float
    dissipated_j: float


class Simulation:
    """A body and its tools, which advance by `model.period_s` with each step. The same steps give the same bits.

    Example
    -------
    >>> model = load_model("liver.npz")
    >>> simulation = Simulation(model)
    >>> tool = model.tools[0]
    >>> position = np.array(tool.home_m)
    >>> for _ in range(200):  # 0.2 s
    ...     position[2] -= 1e-4  # 0.1 m/s downward
    ...     reaction = simulation.step({tool.name: position})[tool.name]
    >>> reaction.force_n, reaction.n_points
    >>> simulation.positions()  # (n_points, 3), the deformed surface

    Parameters
    ----------
    model                a surface model
    stiffness_n_per_m    of the coupling spring between each tool's position and its sphere: of all tools, or by name

    Raises TypeError for another kind of model, ValueError for a stiffness that is out of range, and for modes above half the
    sampling rate.
    """

    def __init__(
        self, model: SurfaceModel, stiffness_n_per_m: float | Mapping[str, float] = DEFAULT_STIFFNESS_N_PER_M
    ) -> None:
        if not isinstance(model, SurfaceModel):
            raise TypeError(
                f"model is a {type(model).__name__}: expected a SurfaceModel, built from a scene with [[tool]]"
            )
        self.model = model
        self._index = {tool.name: i for i, tool in enumerate(model.tools)}
        self._contact = spheres.make(model, self._stiffnesses(stiffness_n_per_m))
        self._image = native_image.make_image(self._contact)
        n = len(self._index)
        self._positions = np.array([tool.home_m for tool in model.tools], float).reshape(n, 3)
        self._wanted = np.full(n, spheres.LIFTED)
        self._forces, self._reactions = np.zeros((n, 3)), np.zeros(n, REACTION)
        self._shown = np.zeros(self._contact.shown_size())

    def step(self, positions_m: Mapping[str, Iterable[float]]) -> dict[str, Reaction]:
        """Move the named tools to positions (3,), m, of their spheres' centers in the model frame, and advance one period.

        A tool that is not named touches nothing. Raises ValueError for an unknown tool or a position that is not three
        numbers up to 1000 m; then nothing has changed.
        """
        wanted = {self._tool(name): _position(name, values) for name, values in positions_m.items()}
        for i in range(len(self._index)):
            if i not in wanted:
                self._wanted[i] = spheres.LIFTED
            elif self._wanted[i] == spheres.LIFTED:
                self._wanted[i] = spheres.TOUCHING
        for i, position in wanted.items():
            self._positions[i] = position
        _advance(self._image, self._positions, self._wanted, self._forces, self._reactions)
        return {name: self._reaction(self._index[name]) for name in positions_m}

    def attach(self, tool: str) -> None:
        """From the next step on the tool holds on to the points it presses, or to the first that it will."""
        self._wanted[self._tool(tool)] = spheres.GRABBING

    def release(self, tool: str) -> None:
        """From the next step on the tool lets go: what it pulled with fades within some 0.1 s."""
        self._wanted[self._tool(tool)] = spheres.TOUCHING

    def positions(self) -> Floats:
        """(n_points, 3), m: the surface as it is now."""
        _save_shown(self._image, self._shown)
        return self.model.points + spheres.shown(self.model, self._shown).reshape(-1, 3)

    def energy(self) -> tuple[float, float]:
        """J, stored in the body, and dissipated in it since the simulation began."""
        out = np.zeros(2)
        _ledger(self._image, out)
        return float(out[0]), float(out[1])

    def save(self) -> Floats:
        """All that steps change, for `restore` of a simulation of the same model."""
        state = np.zeros(self._contact.state_size())
        _save(self._image, state)
        return state

    def restore(self, state: Floats) -> None:
        """Continue from a saved state. Raises ValueError for one that `save` did not write with the same model."""
        self._contact.restore(np.asarray(state, float))
        self._wanted[:] = self._contact.tools.wanted

    def _stiffnesses(self, stiffness: float | Mapping[str, float]) -> list[float]:
        if isinstance(stiffness, Mapping):
            for name in stiffness:
                self._tool(name)
            values = [float(stiffness.get(name, DEFAULT_STIFFNESS_N_PER_M)) for name in self._index]
        else:
            values = [float(stiffness)] * len(self._index)
        for value in values:
            if not _LEAST_STIFFNESS_N_PER_M <= value <= _MOST_STIFFNESS_N_PER_M:
                raise ValueError(
                    f"stiffness_n_per_m = {value:g}: expected {_LEAST_STIFFNESS_N_PER_M:g} to {_MOST_STIFFNESS_N_PER_M:g}"
                )
        return values

    def _tool(self, name: str) -> int:
        if name not in self._index:
            raise ValueError(f"{name!r} is not a tool of the model: expected one of {sorted(self._index)}")
        return self._index[name]

    def _reaction(self, i: int) -> Reaction:
        one = self._reactions[i]
        return Reaction(
            force_n=self._forces[i].copy(),
            normal=one["normal"].copy(),
            penetration_m=float(one["penetration_m"]),
            slip_m=float(one["slip_m"]),
            n_points=int(one["n_contact_points"]),
            flags=Flags(int(one["flags"])),
            work_j=float(one["work_j"]),
            stored_j=float(one["stored_j"]),
            dissipated_j=float(one["dissipated_j"]),
        )


def _position(name: str, values: Iterable[float]) -> Floats:
    position = np.zeros(0)
    if not isinstance(values, str | bytes | Mapping):
        with contextlib.suppress(TypeError, ValueError):
            values = values if isinstance(values, np.ndarray) else list(values)
            if (given := np.asarray(values)).dtype.kind in "iuf":
                position = given.astype(float)
    if position.shape != (3,) or not np.all(np.abs(position) <= MAX_POSITION_M):
        raise ValueError(
            f"position of {name!r} is {values!r}: expected three finite numbers, in m, up to {MAX_POSITION_M:g}"
        )
    return position


@compiled
def _advance(
    image: Image, positions: Floats, wanted: NDArray[np.int64], forces: Floats, reactions: Records
) -> None:
    sphere_contact.advance(view(image), positions, wanted, forces, reactions)


@compiled
def _save(image: Image, state: Floats) -> None:
    spheres.save(view(image), state, 0)


@compiled
def _save_shown(image: Image, state: Floats) -> None:
    spheres.save_shown(view(image), state)


@compiled
def _ledger(image: Image, out: Floats) -> None:
    sphere_contact.ledger(view(image), out)


native_image.register("sphere_contact", spheres.empty(1))
