"""The record types of what ticks read and write, as numpy structured types. Needs numpy alone, so that any process can read them.

Vectors are (3,). Positions, velocities and forces are in the frame of the client that holds the tool; a force is what the
device renders: the force of the tissue on the tool.
"""

from __future__ import annotations

from enum import IntEnum

import numpy as np

RECORDS = 4096  # ticks that the ring keeps


class Change(IntEnum):
    """What is changed between two ticks."""

    NONE = 0
    LIMITS = 1  # of a port
    FRAME = 2  # of a port, whose tip is put to rest
    RESET = 3  # the body and all tips are put to rest
    EXCHANGE = 4  # the memory goes on with another coupling
    SAVE = 5  # nothing: the state is saved, as it is by every change
    TIP = 6  # of a tool that touches nothing: its radius, friction and stiffness, and where it starts


_INTEGER, _FLOAT = np.int64, np.float64
_VECTOR = (_FLOAT, (3,))

COMMAND = np.dtype(
    [
        ("tool", _INTEGER),
        ("lease", _INTEGER),  # of the hold that the command was checked for
        ("sequence", _INTEGER),  # -1: no command
        ("client_time_ns", _INTEGER),
        ("arrival_ns", _INTEGER),
        ("rendered_tick", _INTEGER),  # whose force the device was rendering until then; -1: not told
        ("position_m", *_VECTOR),
        ("velocity_m_per_s", *_VECTOR),
        ("attach", _INTEGER),  # 1: the tip is to hold the tissue under it
    ]
)
"""A command for one tool."""

SETTINGS = np.dtype(
    [
        ("max_force_n", _FLOAT),  # the limits, as in safety.Limits
        ("max_force_rate_n_per_s", _FLOAT),
        ("max_speed_m_per_s", _FLOAT),
        ("workspace_radius_m", _FLOAT),
        ("max_damping_n_s_per_m", _FLOAT),
        ("rotation", _FLOAT, (3, 3)),  # the frame, as in `frames`
        ("scale", _FLOAT),
        ("home_m", *_VECTOR),
        # Of the sphere that touches a surface model, in the model:
        ("radius_m", _FLOAT),
        ("friction", _FLOAT),
        ("stiffness_n_per_m", _FLOAT),  # of the spring between device and sphere
        ("start_m", *_VECTOR),  # where its center is when the tool is at its start
    ]
)
"""Limits and frame of a port, and what its tool is."""

REACTION = np.dtype(
    [
        ("normal", *_VECTOR),  # of the contact, outward, of length 1; zero without one
        ("penetration_m", _FLOAT),  # of the tip into the undeformed tissue
        ("slip_m", _FLOAT),  # of the tip along the tissue in this tick
        ("n_contact_points", _INTEGER),
        ("flags", _INTEGER),  # wire.Flags: IN_CONTACT, SLIDING, ATTACHED
        # J, since the tissue was at rest:
        ("work_j", _FLOAT),  # that the tool did
        ("stored_j", _FLOAT),  # in the spring between device and tip
        ("dissipated_j", _FLOAT),  # in the contact
    ]
)
"""How a tool touches the tissue, and its energies; vectors in the model's frame."""

PORT = np.dtype(
    [
        ("fresh", _INTEGER),  # 1 when the command is another one than in the tick before
        ("flags", _INTEGER),
        ("commanded_ticks", _INTEGER),  # ticks in which a client held the tool, since the start
        ("fresh_ticks", _INTEGER),  # of these, ticks with a new command
        ("position_m", *_VECTOR),  # where the tip is wanted
        ("device_m", *_VECTOR),  # where the device is
        ("step_m", *_VECTOR),  # how far the device has moved since the tick before
        ("applied_m", *_VECTOR),  # where the tip is
        ("raw_force_n", *_VECTOR),  # on the way through the safety chain
        ("force_n", *_VECTOR),  # what the device renders
        ("rendered_force_n", *_VECTOR),  # the force that the device rendered while it moved by `step_m`
        ("force_scale", _FLOAT),  # share of the force that is given out
        ("energy_j", _FLOAT),  # that the port took in
        ("before_m", *_VECTOR),  # where the tip was in the tick before
        ("rendered_work_j", _FLOAT),  # that the tip did against `force_n`, since the tissue was at rest
    ]
)
"""The state of a port between two ticks, beside its newest command."""

COUNTERS = np.dtype(
    [
        ("ticks", _INTEGER),
        ("ticks_on_arrival", _INTEGER),
        ("late_ticks", _INTEGER),
        ("caught_up_ticks", _INTEGER),
        ("skipped_ticks", _INTEGER),
        ("faults", _INTEGER),
        ("shifted_at", _INTEGER),  # tick before which the deadlines were shifted last
        ("quiet_ticks", _INTEGER),  # in a row, with every tip at its start and no force
    ]
)

TICK = np.dtype(
    [
        ("tick", _INTEGER),
        ("start_ns", _INTEGER),
        ("deadline_ns", _INTEGER),
        ("compute_ns", _INTEGER),
        ("flags", _INTEGER),
        ("change", _INTEGER),  # a Change that was made right before the tick
        ("tissue_stored_j", _FLOAT),
        ("tissue_dissipated_j", _FLOAT),  # since the tissue was at rest
    ]
)
"""What one tick was, for all ports."""

PORT_RECORD = np.dtype(
    [
        ("sequence", _INTEGER),  # the command as it was used; -1: none
        ("client_time_ns", _INTEGER),
        ("input_age_ns", _INTEGER),
        ("rendered_tick", _INTEGER),
        ("attach", _INTEGER),
        ("target_m", *_VECTOR),
        ("velocity_m_per_s", *_VECTOR),
        ("rendered_force_n", *_VECTOR),
        ("flags", _INTEGER),
        ("position_m", *_VECTOR),  # of the tip, as it was applied
        ("force_n", *_VECTOR),
        ("force_scale", _FLOAT),
        ("energy_j", _FLOAT),
        ("normal", *_VECTOR),  # from here on as REACTION, in the client's frame
        ("penetration_m", _FLOAT),
        ("slip_m", _FLOAT),
        ("n_contact_points", _INTEGER),
        ("work_j", _FLOAT),
        ("stored_j", _FLOAT),
        ("dissipated_j", _FLOAT),
        ("withheld_j", _FLOAT),  # of work_j, what was not felt: by fading, limits and passivity control
    ]
)
"""What one port did in one tick: the command as it was used, and what came of it."""
