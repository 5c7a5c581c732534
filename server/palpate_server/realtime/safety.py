"""The safety chain as pure compiled functions, in the order in which a tick calls them for each port.

Input between commands; workspace and speed; scale of the force, by staleness and jumps; passivity; rate of the force;
its magnitude. Everything is in the frame of the client that holds the tool.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from palpate_client.wire import Flags
from palpate_server.realtime.compiled import compiled

Floats = NDArray[np.float64]

HOLD_NS = 20_000_000  # the last position of a silent client is held for this time,
DECAY_NS = 50_000_000  # then its force fades to zero in this time: gone after 70 ms.
SOFT_START_NS = 200_000_000  # A force fades in over this time.
EXTRAPOLATE_NS = 5_000_000  # The position moves on with the command's velocity for this time.


class Limits(NamedTuple):
    """Limits of one tool, each above zero; with a damping of zero, passivity is observed and not enforced."""

    max_force_n: float
    max_force_rate_n_per_s: float
    max_speed_m_per_s: float
    workspace_radius_m: float
    max_damping_n_s_per_m: float


def least_force_rate(max_force_n: float) -> float:
    """The smallest limit of the rate, N/s, with which the largest force reaches zero within DECAY_NS."""
    return max_force_n * 1e9 / DECAY_NS


# The numba compiler reads module constants, not enum members.
_WORKSPACE_CLAMPED = int(Flags.WORKSPACE_CLAMPED)
_SPEED_LIMITED = int(Flags.SPEED_LIMITED)
_SLEW_LIMITED = int(Flags.SLEW_LIMITED)
_FORCE_CLAMPED = int(Flags.FORCE_CLAMPED)
_PASSIVITY_LIMITED = int(Flags.PASSIVITY_LIMITED)
_JUMPED = int(Flags.JUMPED)


@compiled
def reconstruct(target: Floats, velocity: Floats, age_ns: int, position: Floats) -> None:
    """Write the tip's position `age_ns` after a command: it moves with `velocity` for EXTRAPOLATE_NS, then is held.

    target, velocity, position (3,), m and m/s
    """
    seconds = min(max(age_ns, 0), EXTRAPOLATE_NS) * 1e-9
    for i in range(3):
        position[i] = target[i] + velocity[i] * seconds


@compiled
def is_finite(value: float) -> bool:
    return math.isfinite(value)


@compiled
def follow(
    target: Floats, applied: Floats, home: Floats, workspace_radius: float, max_step: float, jump: float
) -> int:
    """Move `applied` (3,) towards `target` (3,) by at most `max_step`, inside the workspace. Returns the flags.

    The workspace is a ball around `home` (3,). Sets JUMPED if the distance exceeds `jump`. `applied` is changed in place;
    it stays when `target` is not finite. All in m.
    """
    flags = 0
    x, y, z = target[0] - home[0], target[1] - home[1], target[2] - home[2]
    length = math.sqrt(x * x + y * y + z * z)
    if not is_finite(length):
        return _WORKSPACE_CLAMPED
    wanted_x, wanted_y, wanted_z = target[0], target[1], target[2]
    if length > workspace_radius:
        inside = workspace_radius / length
        wanted_x, wanted_y, wanted_z = home[0] + x * inside, home[1] + y * inside, home[2] + z * inside
        flags |= _WORKSPACE_CLAMPED
    dx, dy, dz = wanted_x - applied[0], wanted_y - applied[1], wanted_z - applied[2]
    distance = math.sqrt(dx * dx + dy * dy + dz * dz)
    if distance > max_step:
        share = max_step / distance
        applied[0] += dx * share
        applied[1] += dy * share
        applied[2] += dz * share
        if distance > jump:
            flags |= _JUMPED
        return flags | _SPEED_LIMITED
    applied[0], applied[1], applied[2] = wanted_x, wanted_y, wanted_z
    return flags


@compiled
def fade(scale: float, live: bool, period_ns: int) -> float:
    """The next force scale, 0 to 1: a linear ramp up over SOFT_START_NS while `live`, else down over DECAY_NS."""
    if live:
        return min(1.0, scale + period_ns / SOFT_START_NS)
    return max(0.0, scale - period_ns / DECAY_NS)


@compiled
def all_finite(values: Floats) -> bool:
    """Whether all of values (n,) are finite."""
    for value in values:  # noqa: SIM110, numba has no all()
        if not math.isfinite(value):
            return False
    return True


@compiled
def keep_passive(
    energy: float, rendered: Floats, step: Floats, force: Floats, max_damping: float, period_s: float
) -> tuple[float, int]:
    """Time-domain passivity observer and controller (Hannaford & Ryu 2002). Returns the energy so far, J, and the flags.

    `rendered` (3,) is the force on the device while it moved by `step` (3,). A device holds its force between updates, so
    the port took in exactly -rendered · step. When more came out than went in, `force` (3,) gets a damping that takes
    it back, at most `max_damping`.
    """
    energy -= rendered[0] * step[0] + rendered[1] * step[1] + rendered[2] * step[2]
    square = step[0] ** 2 + step[1] ** 2 + step[2] ** 2
    if energy >= 0.0 or square == 0.0 or max_damping == 0.0:
        return energy, 0
    damping = min(max_damping, -energy * period_s / square)
    for i in range(3):
        force[i] -= damping * step[i] / period_s
    return energy, _PASSIVITY_LIMITED


@compiled
def bound(force: Floats, previous: Floats, max_change: float, max_magnitude: float) -> int:
    """Limit `force` (3,) in place: its change from `previous` (3,), then its magnitude. Returns the flags.

    The limit of the change always holds. With |previous| <= max_magnitude the magnitude holds too: projecting on a ball
    moves no two points apart. A previous force above `max_magnitude`, which was lowered, first decreases along its
    direction as fast as allowed; only the rest of `max_change` is used to follow `force`. In N.
    """
    flags = 0
    before = math.sqrt(previous[0] ** 2 + previous[1] ** 2 + previous[2] ** 2)
    largest = max(max_magnitude, before - max_change)
    inward, left = 1.0, max_change
    if before > largest:
        inward, left = largest / before, max(0.0, max_change - (before - largest))
    x, y, z = previous[0] * inward, previous[1] * inward, previous[2] * inward
    dx, dy, dz = force[0] - x, force[1] - y, force[2] - z
    change = math.sqrt(dx * dx + dy * dy + dz * dz)
    if change > left:
        share = left / change
        force[0], force[1], force[2] = x + dx * share, y + dy * share, z + dz * share
        flags |= _SLEW_LIMITED
    magnitude = math.sqrt(force[0] ** 2 + force[1] ** 2 + force[2] ** 2)
    if magnitude > largest:
        share = largest / magnitude
        for i in range(3):
            force[i] *= share
        flags |= _FORCE_CLAMPED
    return flags
