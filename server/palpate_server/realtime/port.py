"""One tool's port: from a command to the tip's position, and from the tissue's force to what the device renders.

A port is a record (records.PORT); it knows nothing of a body. Everything is in the frame of the client that holds the tool.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate_client.wire import Flags
from palpate_server.realtime import frames, safety
from palpate_server.realtime.compiled import compiled

Floats = NDArray[np.float64]
Record = Any  # one element of a structured array

_HELD = int(Flags.HELD)
_DECAYING = int(Flags.DECAYING)
_STALE = int(Flags.STALE)
_SOFT_START = int(Flags.SOFT_START)
_FAULT = int(Flags.FAULT)
_SPEED_LIMITED = int(Flags.SPEED_LIMITED)
_JUMPED = int(Flags.JUMPED)


@compiled
def move(port: Record, settings: Record, command: Record, age: int, period_ns: int) -> int:
    """Move the tip to the command's position, within the limits, and fade the force in or out. Returns the flags.

    command (COMMAND) is `age` ns old; -1 if there is none.
    """
    flags = 0
    known = age >= 0
    live = known and age <= safety.HOLD_NS
    if known:
        port.commanded_ticks += 1
        port.fresh_ticks += port.fresh
    if live:
        if not port.fresh:
            flags |= _HELD
        safety.reconstruct(command.position_m, command.velocity_m_per_s, age, port.position_m)
    elif has_faded(port):
        # The force is zero: withdraw the tip, so that the tissue comes to rest.
        for j in range(3):
            port.position_m[j] = port.device_m[j] = settings.home_m[j]
        port.energy_j = 0.0
    moved = live and safety.all_finite(port.position_m)
    for j in range(3):
        # Energy passes the port with the motion of the device, even if the tip follows more slowly.
        port.step_m[j] = port.position_m[j] - port.device_m[j] if moved else 0.0
        port.before_m[j] = port.applied_m[j]
        if moved:
            port.device_m[j] = port.position_m[j]
    flags |= safety.follow(
        port.position_m,
        port.applied_m,
        settings.home_m,
        settings.workspace_radius_m / max(1.0, settings.scale),  # at the device and in the model
        settings.max_speed_m_per_s * (period_ns * 1e-9),
        settings.max_speed_m_per_s * safety.HOLD_NS * 1e-9,
    )
    if not live:
        flags &= ~_JUMPED  # the jump is the withdrawal of the tip, not the client's
    elif flags & _SPEED_LIMITED and port.flags & _JUMPED:
        flags |= _JUMPED  # the tip is still on its way
    port.force_scale = safety.fade(port.force_scale, live and not flags & _JUMPED, period_ns)
    if not live:
        flags |= _DECAYING
    elif port.force_scale < 1.0:
        flags |= _SOFT_START
    return flags


@compiled
def render(port: Record, settings: Record, model_force: Floats, period_s: float) -> int:
    """Turn the tissue's force on the tip, (3,), N, in the model's frame, into the device's force. Returns the flags."""
    force = port.raw_force_n
    frames.to_device(settings.rotation, settings.scale, model_force, force)
    for j in range(3):
        force[j] *= port.force_scale
    port.energy_j, flags = safety.keep_passive(
        port.energy_j,
        port.rendered_force_n,
        port.step_m,
        force,
        settings.max_damping_n_s_per_m * port.force_scale,
        period_s,
    )
    # The largest force fades too. Otherwise a force far above it would begin to fade only at the very end.
    flags |= safety.bound(
        force,
        port.force_n,
        settings.max_force_rate_n_per_s * period_s,
        settings.max_force_n * port.force_scale,
    )
    if not (safety.all_finite(force) and safety.is_finite(port.energy_j)):
        # The last check before the device. The next client starts from a clean state.
        force[:] = 0.0
        port.energy_j = 0.0
        port.force_scale = 0.0
        flags |= _FAULT
    for j in range(3):
        port.force_n[j] = force[j]
        port.rendered_work_j -= force[j] * (port.applied_m[j] - port.before_m[j])
    return flags


@compiled
def finish(port: Record, flags: int) -> None:
    """Store the flags of the tick, with STALE instead of DECAYING once the force has faded."""
    if flags & _DECAYING and has_faded(port):
        flags ^= _DECAYING | _STALE
    port.flags = flags


@compiled
def put_to_rest(port: Record, home: Floats) -> None:
    """Move the tip to its start, the client position `home` (3,), m, and set the energy to zero."""
    for j in range(3):
        port.position_m[j] = port.applied_m[j] = home[j]
    port.energy_j = 0.0


@compiled
def has_faded(port: Record) -> bool:
    """Whether the force has faded to zero."""
    force = port.force_n
    return port.force_scale == 0.0 and force[0] == 0.0 and force[1] == 0.0 and force[2] == 0.0
