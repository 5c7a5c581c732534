"""One tick: newest commands in, one step of the model, forces out, and a record of it all.

For each contact: the newest command, the safety chain up to the displacement that is applied, the step of the model (two,
while another model is faded in), the safety chain back to the device. Nothing here allocates, waits or raises.
"""

from __future__ import annotations

from palpate_server.bodies import state_space
from palpate_server.realtime import frames, safety
from palpate_server.realtime.atomics import (
    MAX_READS,
    begin_read,
    begin_write,
    end_write,
    is_whole,
    store_release,
)
from palpate_server.realtime.clock import monotonic_ns
from palpate_server.realtime.compiled import compiled
from palpate_server.realtime.safety import Flags
from palpate_server.realtime.shared_memory import (
    AGE_NS,
    ARRIVAL_NS,
    AT_REST_SINCE,
    CAUGHT_UP_TICKS,
    CLIENT_TIME_NS,
    COMMANDED_TICKS,
    COMPUTE_NS,
    COMPUTE_TIME,
    CONTACT_FLAGS,
    ENERGY_J,
    FAULTS,
    FRESH_TICKS,
    HEAD,
    HISTOGRAM_BINS,
    INPUT_AGE,
    LATE_TICKS,
    LEASE,
    MAX_DAMPING,
    MAX_FORCE,
    MAX_FORCE_RATE,
    MAX_SPEED,
    NEWEST,
    QUIET_TICKS,
    RECORDS,
    RENDERED_TICK,
    SCALE,
    SEQUENCE,
    START_NS,
    TICK_DEADLINE_NS,
    TICK_FLAGS,
    TICK_LATENESS,
    TICKS,
    WORKSPACE,
    Memory,
)

_BIN_NS = 1_000  # of a histogram

# The tissue counts as at rest when every tip is at the undeformed surface and the model's force is not above this for so
# many ticks; its state is then put to zero exactly, which also keeps it from decaying into slow denormal numbers.
_REST_FORCE_N = 1e-9
_REST_TICKS = 500

_HELD = int(Flags.HELD)
_DECAYING = int(Flags.DECAYING)
_STALE = int(Flags.STALE)
_SOFT_START = int(Flags.SOFT_START)
_FAULT = int(Flags.FAULT)
_SPEED_LIMITED = int(Flags.SPEED_LIMITED)
_JUMPED = int(Flags.JUMPED)
_LATE = int(Flags.LATE)
_CAUGHT_UP = int(Flags.CAUGHT_UP)


@compiled
def run_tick(m: Memory, deadline: int, start: int, missed: bool) -> None:
    """The tick that is due at `deadline` and begins at `start`; `missed`, when a later one follows at once."""
    period = m.period_ns[0]
    period_s = period * 1e-9
    tick = m.counters[TICKS]
    row = tick % RECORDS
    n_contacts = m.applied.shape[0]

    lateness = start - deadline
    tick_flags = 0
    if lateness > period // 4:
        tick_flags |= _LATE
        m.counters[LATE_TICKS] += 1
    if missed:
        tick_flags |= _CAUGHT_UP
        m.counters[CAUGHT_UP_TICKS] += 1
    count(m, TICK_LATENESS, lateness)

    _read_commands(m)
    for i in range(n_contacts):
        integers = m.newest_integers[i]
        known = integers[SEQUENCE] >= 0
        # A command may come between the start of the tick and here.
        age = max(0, start - integers[ARRIVAL_NS]) if known else -1
        live = known and age <= safety.HOLD_NS
        flags = tick_flags
        if known:
            m.tallies[i, COMMANDED_TICKS] += 1
            if m.fresh[i]:
                m.tallies[i, FRESH_TICKS] += 1
        if live:
            if not m.fresh[i]:
                flags |= _HELD
            count(m, INPUT_AGE, age)
            safety.reconstruct(m.target[i], m.velocity[i], age, m.position[i])
        elif has_faded(m, i):
            # Nobody feels it any more: withdraw the tip, so that the tissue comes to rest.
            m.position[i] = m.device[i] = m.origin[i]
            m.energy[i] = 0.0
        m.step[i] = 0.0
        if live and safety.all_finite(m.position[i]):
            # Energy goes through the port as the device moves, however slowly the tip is let after it.
            for j in range(3):
                m.step[i, j] = m.position[i, j] - m.device[i, j]
                m.device[i, j] = m.position[i, j]
        flags |= safety.follow(
            m.position[i],
            m.applied[i],
            m.origin[i],
            m.limits[i, WORKSPACE] / max(1.0, m.frame_scale[i]),  # at the device and in the model
            m.limits[i, MAX_SPEED] * period_s,
            m.limits[i, MAX_SPEED] * safety.HOLD_NS * 1e-9,
        )
        if not live:
            flags &= ~_JUMPED  # that is our own withdrawal
        elif flags & _SPEED_LIMITED and m.record_inputs[(tick - 1) % RECORDS, i, CONTACT_FLAGS] & _JUMPED:
            flags |= _JUMPED  # still on its way
        frames.to_model(m.rotation[i], m.frame_scale[i], m.origin[i], m.applied[i], m.displacement[i])
        scale = safety.fade(m.scale[i], live and not flags & _JUMPED, period)
        if live:
            if scale < 1.0:
                flags |= _SOFT_START
        else:
            flags |= _DECAYING
        m.scale[i] = scale
        inputs = m.record_inputs[row, i]
        inputs[SEQUENCE] = integers[SEQUENCE]
        inputs[CLIENT_TIME_NS] = integers[CLIENT_TIME_NS] if known else -1
        inputs[AGE_NS] = age
        inputs[CONTACT_FLAGS] = flags

    displacement = m.displacement.reshape(3 * n_contacts)
    model = m.model
    state_space.output(model.c, model.d, model.state, displacement, model.force.reshape(3 * n_contacts))
    if tick % m.snapshot_every[0] == 0:
        _write_snapshot(m, tick)
    state_space.update(model.diagonal, model.cross, model.b_transposed, model.state, displacement)
    share = 0.0
    if m.fade[1] > 0.0:
        following = m.next_model
        state_space.output(
            following.c, following.d, following.state, displacement, following.force.reshape(3 * n_contacts)
        )
        state_space.update(
            following.diagonal, following.cross, following.b_transposed, following.state, displacement
        )
        share = min(1.0, m.fade[0] + m.fade[1])
        m.fade[0] = share
    for i in range(n_contacts):
        for j in range(3):
            m.force[i, j] = model.force[i, j]
            if share > 0.0:
                m.force[i, j] += share * (m.next_model.force[i, j] - model.force[i, j])

    finite = safety.all_finite(m.force.reshape(3 * n_contacts))
    if not finite:
        m.counters[FAULTS] += 1
        model.state[:] = 0.0
        m.next_model.state[:] = 0.0
        m.force[:] = 0.0
        m.scale[:] = 0.0

    for i in range(n_contacts):
        flags = 0 if finite else _FAULT
        force = m.device_force[i]
        frames.to_device(m.rotation[i], m.frame_scale[i], m.force[i], force)
        for j in range(3):
            force[j] *= m.scale[i]
        rendered_tick = m.newest_integers[i, RENDERED_TICK]
        told = 0 <= rendered_tick < tick and tick - rendered_tick < RECORDS
        rendered = m.record_motion[(rendered_tick if told else tick - 1) % RECORDS, i]
        for j in range(3):
            m.rendered_force[i, j] = rendered[3 + j]
        m.energy[i], limited = safety.keep_passive(
            m.energy[i],
            m.rendered_force[i],
            m.step[i],
            force,
            m.limits[i, MAX_DAMPING] * m.scale[i],
            period_s,
        )
        flags |= limited
        # The largest force fades too: of a force far above it, cut to it, the fading would show only at its very end.
        flags |= safety.bound(
            force,
            m.previous_force[i],
            m.limits[i, MAX_FORCE_RATE] * period_s,
            m.limits[i, MAX_FORCE] * m.scale[i],
        )
        if not (safety.all_finite(force) and safety.all_finite(m.energy[i : i + 1])):
            # The last word before the device: whatever went wrong above, it feels nothing, and the next client starts
            # from a clean state.
            m.counters[FAULTS] += 1
            force[:] = 0.0
            m.energy[i] = 0.0
            m.scale[i] = 0.0
            flags |= _FAULT
        motion = m.record_motion[row, i]
        for j in range(3):
            m.previous_force[i, j] = force[j]
            motion[j] = m.applied[i, j]
            motion[3 + j] = force[j]
        flags |= m.record_inputs[row, i, CONTACT_FLAGS]
        if flags & _DECAYING and has_faded(m, i):
            flags ^= _DECAYING | _STALE
        m.record_inputs[row, i, CONTACT_FLAGS] = flags
        motion[SCALE] = m.scale[i]
        motion[ENERGY_J] = m.energy[i]

    _settle(m, tick)

    m.record_times[row, START_NS] = start
    m.record_times[row, TICK_DEADLINE_NS] = deadline
    m.record_times[row, TICK_FLAGS] = tick_flags
    m.counters[TICKS] = tick + 1
    compute = monotonic_ns() - start
    m.record_times[row, COMPUTE_NS] = compute
    count(m, COMPUTE_TIME, compute)
    store_release(m.shared, HEAD, tick + 1)


@compiled
def _settle(m: Memory, tick: int) -> None:
    """Put the model's state to zero when what is left of it is negligible, and note since when all is at rest."""
    faded, still = True, m.fade[1] == 0.0
    for i in range(m.applied.shape[0]):
        faded = faded and has_faded(m, i)
        for j in range(3):
            still = still and m.displacement[i, j] == 0.0
    if not (faded and still):
        m.counters[AT_REST_SINCE] = -1
    for i in range(m.force.shape[0]):
        for j in range(3):
            still = still and abs(m.force[i, j]) <= _REST_FORCE_N
    m.counters[QUIET_TICKS] = m.counters[QUIET_TICKS] + 1 if still else 0
    if m.counters[QUIET_TICKS] == _REST_TICKS:
        m.model.state[:] = 0.0
    if m.counters[QUIET_TICKS] >= _REST_TICKS and faded and m.counters[AT_REST_SINCE] < 0:
        m.counters[AT_REST_SINCE] = tick + 1


@compiled
def _read_commands(m: Memory) -> None:
    """Take the newest command of every contact from its slot, and note which are others than before.

    A writer that is interrupted in the middle can't hold the loop up: after some tries the commands before stay.
    """
    commands = m.commands
    m.fresh[:] = 0
    for _ in range(MAX_READS):
        version = begin_read(commands.versions, 0)
        m.read_integers[:] = commands.integers[NEWEST]
        m.read_motion[:] = commands.motion[NEWEST]
        for i in range(m.fresh.shape[0]):
            if m.read_integers[i, LEASE] != commands.lease[i]:
                # Checked while its client held the contact, written when it no longer did.
                m.read_integers[i, SEQUENCE] = -1
        if is_whole(commands.versions, 0, version):
            for i in range(m.fresh.shape[0]):
                sequence = m.read_integers[i, SEQUENCE]
                m.fresh[i] = sequence != m.newest_integers[i, SEQUENCE]
                m.newest_integers[i] = m.read_integers[i]
                if sequence >= 0:
                    m.target[i] = m.read_motion[i, 0:3]
                    m.velocity[i] = m.read_motion[i, 3:6]
            return


@compiled
def _write_snapshot(m: Memory, tick: int) -> None:
    begin_write(m.snapshot_version, 0)
    m.snapshot_tick[0] = tick
    m.snapshot_state[:] = m.model.state
    m.snapshot_displacement[:] = m.displacement
    end_write(m.snapshot_version, 0)


@compiled
def count(m: Memory, histogram: int, duration_ns: int) -> None:
    """Enter a duration into one of the histograms."""
    duration = max(duration_ns, 0)
    m.longest_ns[histogram] = max(m.longest_ns[histogram], duration)
    m.histograms[histogram, min(duration // _BIN_NS, HISTOGRAM_BINS - 1)] += 1


@compiled
def put_to_rest(m: Memory, contact: int) -> None:
    """The tip is where its frame has its rest, on the undeformed surface, and nothing has gone through its port."""
    for i in range(3):
        m.target[contact, i] = m.position[contact, i] = m.applied[contact, i] = m.origin[contact, i]
        m.velocity[contact, i] = 0.0
        m.displacement[contact, i] = 0.0
    m.energy[contact] = 0.0


@compiled
def has_faded(m: Memory, contact: int) -> bool:
    """Whether the force of a contact is zero, and stays so until it fades in again."""
    force = m.previous_force[contact]
    return m.scale[contact] == 0.0 and force[0] == 0.0 and force[1] == 0.0 and force[2] == 0.0
