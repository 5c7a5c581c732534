"""One tick: newest commands through the ports, one step of the coupling, forces back through the ports, and a record.

Nothing here allocates, waits or raises.
"""

from __future__ import annotations

from palpate_client.wire import Flags
from palpate_server.coupling import cross_fade
from palpate_server.coupling.spheres import GRABBING, LIFTED, TOUCHING
from palpate_server.realtime import frames, port, safety
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
from palpate_server.realtime.records import RECORDS
from palpate_server.realtime.shared_memory import (
    COMPUTE_TIME,
    HEAD,
    HISTOGRAM_BINS,
    INPUT_AGE,
    TICK_LATENESS,
    Memory,
)

_BIN_NS = 1_000  # of a histogram

# When the tissue was still for so long, its state is set to zero: it would decay into denormal numbers, which are slow.
_REST_TICKS = 500

_FAULT = int(Flags.FAULT)
_LATE = int(Flags.LATE)
_CAUGHT_UP = int(Flags.CAUGHT_UP)


@compiled
def run_tick(m: Memory, deadline: int, start: int, missed: bool) -> None:
    """Run the tick that was due at `deadline`, from `start` on, ns; `missed`: another due tick follows at once."""
    counters = m.counters[0]
    tick = counters.ticks
    record = m.ring.ticks[tick % RECORDS]
    record.flags = _note_lateness(m, deadline, start, missed)
    _read_commands(m)
    for i in range(m.ports.shape[0]):
        _move(m, i, start, record.flags)
    if tick % m.snapshot.every[0] == 0:
        _write_snapshot(m, tick)
    cross_fade.advance(m.coupling, m.displacement, m.wanted, m.force, m.reactions, m.ledger)
    fault = 0
    if not safety.all_finite(m.force.reshape(m.force.size)):
        fault = _FAULT
        counters.faults += 1
        put_tissue_to_rest(m)
        m.force[:] = 0.0
        for i in range(m.ports.shape[0]):
            m.ports[i].force_scale = 0.0
    for i in range(m.ports.shape[0]):
        _render(m, i, tick, fault)
    _settle(m)

    record.tick = tick
    record.tissue_stored_j = m.ledger[0]
    record.tissue_dissipated_j = m.ledger[1]
    record.start_ns = start
    record.deadline_ns = deadline
    counters.ticks = tick + 1
    compute = monotonic_ns() - start
    record.compute_ns = compute
    count(m, COMPUTE_TIME, compute)
    store_release(m.shared, HEAD, tick + 1)
    m.ring.ticks[(tick + 1) % RECORDS].change = 0


@compiled
def _note_lateness(m: Memory, deadline: int, start: int, missed: bool) -> int:
    """Count the tick's lateness. Returns the flags of the tick: LATE, CAUGHT_UP."""
    counters = m.counters[0]
    flags = 0
    lateness = start - deadline
    if lateness > m.period_ns[0] // 4:
        flags |= _LATE
        counters.late_ticks += 1
    if missed:
        flags |= _CAUGHT_UP
        counters.caught_up_ticks += 1
    count(m, TICK_LATENESS, lateness)
    return flags


@compiled
def _move(m: Memory, i: int, start: int, tick_flags: int) -> None:
    """Move a port's tip, write its displacement in the model's frame, and begin the port's record."""
    one, settings, command = m.ports[i], m.settings[i], m.used[i]
    # A command may come between the start of the tick and here.
    age = max(0, start - command.arrival_ns) if command.sequence >= 0 else -1
    if 0 <= age <= safety.HOLD_NS:
        count(m, INPUT_AGE, age)
    flags = tick_flags | port.move(one, settings, command, age, m.period_ns[0])
    frames.to_model(settings.rotation, settings.scale, settings.home_m, one.applied_m, m.displacement[i])
    if (
        one.force_scale == 0.0
    ):  # it may be on its way through the tissue, to its start or to a client that jumped
        m.wanted[i] = LIFTED
    else:
        m.wanted[i] = GRABBING if command.attach else TOUCHING
    record = m.ring.ports[m.counters[0].ticks % RECORDS, i]
    record.sequence = command.sequence
    record.client_time_ns = command.client_time_ns if age >= 0 else -1
    record.input_age_ns = age
    record.rendered_tick = command.rendered_tick
    record.attach = command.attach
    record.flags = flags
    for j in range(3):
        record.target_m[j] = command.position_m[j]
        record.velocity_m_per_s[j] = command.velocity_m_per_s[j]


@compiled
def _render(m: Memory, i: int, tick: int, fault: int) -> None:
    """Turn the coupling's force on a port into the device's, and complete the port's record."""
    one = m.ports[i]
    rendered = m.ring.ports[rendered_before(tick, m.used[i].rendered_tick) % RECORDS, i]
    for j in range(3):
        one.rendered_force_n[j] = rendered.force_n[j]
    flags = port.render(one, m.settings[i], m.force[i], m.period_ns[0] * 1e-9)
    if flags & _FAULT:
        m.counters[0].faults += 1
    record = m.ring.ports[tick % RECORDS, i]
    reaction = m.reactions[i]
    port.finish(one, flags | fault | record.flags | reaction.flags)
    record.flags = one.flags
    for j in range(3):
        record.rendered_force_n[j] = one.rendered_force_n[j]
        record.position_m[j] = one.applied_m[j]
        record.force_n[j] = one.force_n[j]
    record.force_scale = one.force_scale
    record.energy_j = one.energy_j
    scale = m.settings[i].scale
    frames.to_device(m.settings[i].rotation, 1.0, reaction.normal, record.normal)
    record.penetration_m = reaction.penetration_m / scale
    record.slip_m = reaction.slip_m / scale
    record.n_contact_points = reaction.n_contact_points
    record.work_j = reaction.work_j
    record.stored_j = reaction.stored_j
    record.dissipated_j = reaction.dissipated_j
    record.withheld_j = reaction.work_j - one.rendered_work_j


@compiled
def rendered_before(tick: int, rendered_tick: int) -> int:
    """The tick whose force the device rendered before `tick`: the one that its client names, if the ring still holds it.

    rendered_tick  of the command, -1 without one; then the device is taken to render the force of the tick before
    """
    is_held = 0 <= rendered_tick < tick and tick - rendered_tick < RECORDS
    return rendered_tick if is_held else tick - 1


@compiled
def _settle(m: Memory) -> None:
    """Zero the state exactly after _REST_TICKS quiet ticks."""
    counters = m.counters[0]
    still = cross_fade.is_still(m.coupling, m.displacement, m.force, m.reactions, m.ledger)
    counters.quiet_ticks = counters.quiet_ticks + 1 if still else 0
    if counters.quiet_ticks == _REST_TICKS:
        put_tissue_to_rest(m)


@compiled
def _read_commands(m: Memory) -> None:
    """Take the newest command of every tool, and mark the ports whose command is new.

    The read is tried MAX_READS times. If a writer was interrupted in between, this tick uses the previous commands.
    """
    commands = m.commands
    for i in range(m.ports.shape[0]):
        m.ports[i].fresh = 0
    for _ in range(MAX_READS):
        version = begin_read(commands.versions, 0)
        for i in range(m.read.shape[0]):
            m.read[i] = commands.newest[i]
            if m.read[i].lease != commands.lease[i]:
                m.read[i].sequence = -1  # stale lease: discard
        if is_whole(commands.versions, 0, version):
            for i in range(m.read.shape[0]):
                m.ports[i].fresh = m.read[i].sequence != m.used[i].sequence
                m.used[i] = m.read[i]
            return


@compiled
def _write_snapshot(m: Memory, tick: int) -> None:
    begin_write(m.snapshot.versions, 0)
    m.snapshot.tick[0] = tick
    cross_fade.save_shown(m.coupling, m.snapshot.state)
    for i in range(m.displacement.shape[0]):
        for j in range(3):
            m.snapshot.displacement[i, j] = m.displacement[i, j]
    end_write(m.snapshot.versions, 0)


@compiled
def count(m: Memory, histogram: int, duration_ns: int) -> None:
    """Add a duration to a histogram."""
    duration = max(duration_ns, 0)
    m.longest_ns[histogram] = max(m.longest_ns[histogram], duration)
    m.histograms[histogram, min(duration // _BIN_NS, HISTOGRAM_BINS - 1)] += 1


@compiled
def put_tissue_to_rest(m: Memory) -> None:
    """Zero the state of the model, and all energies that are counted since then."""
    cross_fade.put_to_rest(m.coupling)
    m.ledger[:] = 0.0
    for i in range(m.ports.shape[0]):
        m.ports[i].rendered_work_j = 0.0
        reaction = m.reactions[i]
        reaction.normal[:] = 0.0
        reaction.penetration_m = reaction.slip_m = 0.0
        reaction.n_contact_points = reaction.flags = 0
        reaction.work_j = reaction.stored_j = reaction.dissipated_j = 0.0


@compiled
def put_to_rest(m: Memory, i: int) -> None:
    """Move a port's tip to its tool's start."""
    port.put_to_rest(m.ports[i], m.settings[i].home_m)
    for j in range(3):
        m.displacement[i, j] = 0.0
