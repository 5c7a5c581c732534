"""What stands between a client's numbers and the model, and between the model and a hand: pure compiled functions.

Each tick and contact, in this order: reconstruction of the input between commands; its workspace and speed; its
staleness and its jumps, which scale the force; passivity at the device's port; slew rate of the force; its magnitude. (That numbers
are finite is checked before they come here.) Everything is in the frame of the client that holds the contact.
"""

from __future__ import annotations

import math
from enum import IntFlag
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from palpate_server.realtime.compiled import compiled

Floats = NDArray[np.float64]

HOLD_NS = 20_000_000  # so long a silent client's last displacement and force are held,
DECAY_NS = 50_000_000  # then its force fades to zero in this time: dead after 70 ms,
SOFT_START_NS = 200_000_000  # and comes back in this one.
EXTRAPOLATE_NS = 5_000_000  # so far a command's velocity carries its displacement on.


class Flags(IntFlag):
    """What happened to one contact in one tick (LATE and CAUGHT_UP: to the tick)."""

    HELD = 1  # no command came since the last tick; the displacement before was used again
    DECAYING = 2  # the client has been silent for longer than HOLD_NS, or is gone: the force fades to zero
    STALE = 4  # it has faded: the force is zero and the tip is withdrawn from the tissue
    SOFT_START = 8  # commands are coming (again); the force fades in
    WORKSPACE_CLAMPED = 16  # the displacement was longer than the workspace's radius
    SPEED_LIMITED = 32  # the displacement moved faster than allowed and is followed at the allowed speed
    SLEW_LIMITED = 64  # the force changed faster than allowed
    FORCE_CLAMPED = 128  # the force was larger than allowed
    FAULT = 256  # the model gave a force that is not finite; it was put back to rest
    LATE = 512  # the tick began more than a quarter of a period after its deadline
    CAUGHT_UP = 1024  # the tick was missed and made up for, together with a later one
    PASSIVITY_LIMITED = 2048  # the port had given out energy; the force is damped to take it back
    JUMPED = 4096  # farther than a tip can move while input is held: the force fades while it goes there, then in again


class Limits(NamedTuple):
    """Bounds for one contact; each above zero, but for the damping: with zero, passivity is observed and left alone."""

    max_force_n: float
    max_force_rate_n_per_s: float
    max_speed_m_per_s: float
    workspace_radius_m: float
    max_damping_n_s_per_m: float


def least_force_rate(max_force_n: float) -> float:
    """N/s that any limit of the rate must allow, so that the largest force is gone when the fading is: in DECAY_NS."""
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
    """Where the tip is `age_ns` after a command: carried on with its velocity for EXTRAPOLATE_NS, then held.

    target, velocity, position (3,), m and m/s. A velocity of zero is a hold from the start.
    """
    seconds = min(max(age_ns, 0), EXTRAPOLATE_NS) * 1e-9
    for i in range(3):
        position[i] = target[i] + velocity[i] * seconds


@compiled
def is_finite(value: float) -> bool:
    return math.isfinite(value)


@compiled
def follow(
    target: Floats, applied: Floats, origin: Floats, workspace_radius: float, max_step: float, jump: float
) -> int:
    """Move `applied` (3,) towards `target` (3,), no further than `max_step` and not out of the workspace; flags.

    A way of more than `jump` is flagged as one. The workspace is a ball around `origin` (3,). `applied` is changed in place; it stays where it is when `target` has no finite length. All in m.
    """
    flags = 0
    x, y, z = target[0] - origin[0], target[1] - origin[1], target[2] - origin[2]
    length = math.sqrt(x * x + y * y + z * z)
    if not is_finite(length):
        return _WORKSPACE_CLAMPED
    wanted_x, wanted_y, wanted_z = target[0], target[1], target[2]
    if length > workspace_radius:
        inside = workspace_radius / length
        wanted_x, wanted_y, wanted_z = origin[0] + x * inside, origin[1] + y * inside, origin[2] + z * inside
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
    """The next force scale, in 0 to 1: rising over SOFT_START_NS while `live`, else falling over DECAY_NS.

    A linear ramp either way, so neither silence nor coming back makes the force jump.
    """
    if live:
        return min(1.0, scale + period_ns / SOFT_START_NS)
    return max(0.0, scale - period_ns / DECAY_NS)


@compiled
def all_finite(values: Floats) -> bool:
    """Whether every one of values (n,) is a finite number."""
    for value in values:  # noqa: SIM110, numba has no all()
        if not math.isfinite(value):
            return False
    return True


@compiled
def keep_passive(
    energy: float, rendered: Floats, step: Floats, force: Floats, max_damping: float, period_s: float
) -> tuple[float, int]:
    """Time-domain passivity observer and controller (Hannaford & Ryu 2002); the energy so far (J), and flags.

    `rendered` (3,) is the force the device held while it moved by `step` (3,): their product is the energy that the
    port took in, exactly, because a device holds its force between updates. When more came out than went in, `force`
    (3,) gets a damping that takes it back, no larger than `max_damping`.
    """
    energy += rendered[0] * step[0] + rendered[1] * step[1] + rendered[2] * step[2]
    square = step[0] ** 2 + step[1] ** 2 + step[2] ** 2
    if energy >= 0.0 or square == 0.0 or max_damping == 0.0:
        return energy, 0
    damping = min(max_damping, -energy * period_s / square)
    for i in range(3):
        force[i] += damping * step[i] / period_s
    return energy, _PASSIVITY_LIMITED


@compiled
def bound(force: Floats, previous: Floats, max_change: float, max_magnitude: float) -> int:
    """Limit `force` (3,) in place: its change from `previous` (3,), then its magnitude, directions kept; flags.

    The rate always holds. With |previous| <= max_magnitude the magnitude holds too: cutting to a ball brings no two
    points apart. A force above `max_magnitude`, because that was lowered, first comes down straight, as fast as the
    rate allows; only what is left of the rate is for following. In N.
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
