"""The tick: newest displacement in, one model step, force out, exactly once each period.

Deadlines lie one period apart on the monotonic clock. A tick runs when a command arrives shortly before its deadline,
so that the answer leaves at once; otherwise a compiled loop that never needs the GIL runs it at the deadline. Whoever
comes first takes the tick lock; the other finds the deadline moved on. The deadlines slowly shift so that a steady
client's commands arrive a quarter of a period before them.

Nobody else ever takes that lock: limits, frames, a reset or another model are left in a slot, and the next tick takes
them out of it before it begins. So no thread of ordinary priority can hold a tick up.

A tick that is missed is made up for at once with the newest input, up to MAX_CATCH_UP of them; what is missed beyond
that is skipped: model time then stands still, and the skipped ticks are counted.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numba import int32, typeof, types, uint64
from numpy.typing import NDArray

from palpate.model import StateSpace
from palpate_server import frames, kernel, safety
from palpate_server.atomics import (
    begin_read,
    begin_write,
    compare_and_swap,
    end_write,
    is_whole,
    load_acquire,
    store_release,
)
from palpate_server.clock import monotonic_ns, sleep_until
from palpate_server.compiled import compiled, compiled_without_gil
from palpate_server.image import WORDS, Image, make_view
from palpate_server.safety import Flags, Limits

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

RECORDS = 4096  # ticks that are kept: what publishers have not sent yet, and the recent past
MAX_CATCH_UP = 20
HISTOGRAM_BINS = 10_000  # of a microsecond; the last one also holds what is longer
_BIN_NS = 1_000

_RETRIES = 100  # of a read that a writer disturbs; afterwards the value before is used again
_RETRY_NS = 20_000  # the deadline loop's nap while the other side runs the tick
_PHASE_SHIFT_NS = 2_000  # the most that the deadlines move in a tick: 0.2 % of a millisecond
_PHASE_GAIN = 16

# The tissue counts as at rest when no tip touches it and no contact's force is above this for so many ticks; its state
# is then put to zero exactly, which also keeps it from decaying into slow denormal numbers.
_REST_FORCE_N = 1e-9
_REST_TICKS = 500

# Columns of Memory.shared: int64 that both sides load and store atomically. CHANGE is one of the kinds of Changes.
LOCK, DEADLINE_NS, STOP, HEAD, CHANGE = range(5)
# Columns of Memory.counters: written under the tick lock alone. AT_REST_SINCE is a tick, -1 while something moves.
(
    TICKS,
    TICKS_ON_ARRIVAL,
    LATE_TICKS,
    CAUGHT_UP_TICKS,
    SKIPPED_TICKS,
    FAULTS,
    SHIFTED_AT,
    AT_REST_SINCE,
    QUIET_TICKS,
) = range(9)
# Columns of Memory.tallies: ticks in which a client had the contact, and those with a new command in time.
COMMANDED_TICKS, FRESH_TICKS = range(2)
# Kinds of Changes, and the columns of its integers.
NO_CHANGE, LIMITS, FRAME, RESET, EXCHANGE = range(5)
CHANGED_CONTACT, CHANGED_AT_TICK = range(2)
# Columns of Commands.integers; Memory.record_inputs has the age and the flags behind the first two.
SEQUENCE, CLIENT_TIME_NS, ARRIVAL_NS, RENDERED_TICK = range(4)
AGE_NS, CONTACT_FLAGS = 2, 3
# Columns of Memory.record_times.
START_NS, TICK_DEADLINE_NS, COMPUTE_NS, TICK_FLAGS = range(4)
# Columns of Memory.record_motion: displacement 0:3, force 3:6, then these.
SCALE, ENERGY_J = 6, 7
# Columns of Memory.limits.
MAX_FORCE, MAX_FORCE_RATE, MAX_SPEED, WORKSPACE, MAX_DAMPING = range(5)
# Rows of Memory.histograms.
TIMER_LATENESS, TICK_LATENESS, COMPUTE_TIME, INPUT_AGE = range(4)

_HELD = int(Flags.HELD)
_DECAYING = int(Flags.DECAYING)
_STALE = int(Flags.STALE)
_SOFT_START = int(Flags.SOFT_START)
_FAULT = int(Flags.FAULT)
_SPEED_LIMITED = int(Flags.SPEED_LIMITED)
_JUMPED = int(Flags.JUMPED)
_LATE = int(Flags.LATE)
_CAUGHT_UP = int(Flags.CAUGHT_UP)

_eventfd_write: Any = types.ExternalFunction("eventfd_write", int32(int32, uint64))


class Commands(NamedTuple):
    """The newest command of each contact, handed over under sequence locks. n = n_contacts.

    versions (n,); integers (n, 4): SEQUENCE (-1: none yet), CLIENT_TIME_NS, ARRIVAL_NS, RENDERED_TICK (the tick whose
    force the device was rendering until then, -1: not told); target (n, 3), m; velocity (n, 3), m/s
    """

    versions: Integers
    integers: Integers
    target: Floats
    velocity: Floats


class Changes(NamedTuple):
    """The slot for one change between two ticks; Memory.shared[CHANGE] is its kind while it waits.

    integers (2,): CHANGED_CONTACT, and CHANGED_AT_TICK, the first tick after it; limits (5,); rotation (3, 3), scale
    (1,), origin (3,), m: a frame; image: of the memory to go on with
    """

    integers: Integers
    limits: Floats
    rotation: Floats
    scale: Floats
    origin: Floats
    image: Image


class Model(NamedTuple):
    """A discrete model and its state, as in `kernel`, and the force it gives, (n_contacts, 3), N."""

    diagonal: Floats
    cross: Floats
    b_transposed: Floats
    c: Floats
    d: Floats
    state: Floats
    force: Floats


class Memory(NamedTuple):
    """All that the tick reads and writes, made once. n = n_contacts; int64 and float64.

    period_ns        (1,)
    shared           (5,), LOCK, DEADLINE_NS, STOP, HEAD: the number of complete records, CHANGE
    changes          what is to be changed before the next tick
    counters         (9,)
    tallies          (n, 2)
    histograms       (4, HISTOGRAM_BINS) counts, and longest_ns (4,)
    limits           (n, 5), the fields of safety.Limits
    rotation (n, 3, 3), frame_scale (n,), origin (n, 3): the holders' frames, as in frames.Frame
    commands         what clients want; read_integers (4,), read_motion (6,): a read that may be torn; newest_integers, target, velocity: what the tick last read of it
    position, applied, step, device_force, previous_force, rendered_force  (n, 3), m and N, in the holders' frames:
                     where the tip is wanted, where it is, how far that is from the tick before, the force, the one
                     before, and the one that the device was rendering
    displacement, force  (n, 3), m and N, the model's input and output
    scale, energy    (n,), how much of the force is given out; J that the port took in
    model, next_model  the one that runs, and the one that is faded in; fade (2,): the share of the latter's force, and by
                     how much it grows each tick, 0 without a next model
    record_times     (RECORDS, 4), record_inputs (RECORDS, n, 4), record_motion (RECORDS, n, 8): a ring, tick t at
                     t % RECORDS
    snapshot_every   (1,), ticks between two snapshots
    snapshot_version (1,), sequence lock of snapshot_tick (1,), snapshot_state (order,), snapshot_displacement (n, 3)
    """

    period_ns: Integers
    shared: Integers
    changes: Changes
    counters: Integers
    tallies: Integers
    histograms: Integers
    longest_ns: Integers
    limits: Floats
    rotation: Floats
    frame_scale: Floats
    origin: Floats
    commands: Commands
    read_integers: Integers
    read_motion: Floats
    newest_integers: Integers
    target: Floats
    velocity: Floats
    position: Floats
    applied: Floats
    step: Floats
    device_force: Floats
    previous_force: Floats
    rendered_force: Floats
    displacement: Floats
    force: Floats
    scale: Floats
    energy: Floats
    model: Model
    next_model: Model
    fade: Floats
    record_times: Integers
    record_inputs: Integers
    record_motion: Floats
    snapshot_every: Integers
    snapshot_version: Integers
    snapshot_tick: Integers
    snapshot_state: Floats
    snapshot_displacement: Floats


def make_model(system: StateSpace, displacement: Floats | None = None) -> Model:
    """The model at rest, or where it settles when `displacement` (n_inputs,), m, stays: xi = (1 - A)^-1 B u."""
    state: Floats = np.zeros(system.order)
    if displacement is not None:
        drive = (system.b @ displacement).reshape(-1, 2, 1)
        blocks = np.empty((system.order // 2, 2, 2))
        blocks[:, 0, 0], blocks[:, 1, 1] = 1 - system.diagonal[0::2], 1 - system.diagonal[1::2]
        blocks[:, 0, 1], blocks[:, 1, 0] = -system.cross[0::2], -system.cross[1::2]
        state[:] = np.linalg.solve(blocks, drive).ravel()
    return Model(
        diagonal=kernel.aligned(system.diagonal),
        cross=kernel.aligned(system.cross),
        b_transposed=kernel.aligned(system.b.T),
        c=kernel.aligned(system.c),
        d=kernel.aligned(system.d),
        state=kernel.aligned(state),
        force=np.zeros((len(system.c) // 3, 3)),
    )


def _nothing(n_contacts: int) -> StateSpace:
    n = 3 * n_contacts
    return StateSpace(np.zeros(0), np.zeros(0), np.zeros((0, n)), np.zeros((n, 0)), np.zeros((n, n)))


def make_memory(
    system: StateSpace, period_s: float, limits: Sequence[Limits], snapshot_period_s: float
) -> Memory:
    """A model at rest, with no command yet, whose first deadline is a period from now."""
    n = len(limits)
    period_ns = round(period_s * 1e9)
    no_command = np.zeros((n, 4), np.int64)
    no_command[:, SEQUENCE] = no_command[:, RENDERED_TICK] = -1
    shared = np.zeros(5, np.int64)
    shared[DEADLINE_NS] = time.monotonic_ns() + period_ns
    counters = np.zeros(9, np.int64)
    counters[SHIFTED_AT] = -1
    return Memory(
        period_ns=np.array([period_ns]),
        shared=shared,
        changes=Changes(
            np.zeros(2, np.int64),
            np.zeros(len(Limits._fields)),
            np.zeros((3, 3)),
            np.zeros(1),
            np.zeros(3),
            np.zeros(WORDS, np.int64),
        ),
        counters=counters,
        tallies=np.zeros((n, 2), np.int64),
        histograms=np.zeros((4, HISTOGRAM_BINS), np.int64),
        longest_ns=np.zeros(4, np.int64),
        limits=np.array(limits, np.float64),
        rotation=np.tile(np.eye(3), (n, 1, 1)),
        frame_scale=np.ones(n),
        origin=np.zeros((n, 3)),
        commands=Commands(np.zeros(n, np.int64), no_command, np.zeros((n, 3)), np.zeros((n, 3))),
        read_integers=np.zeros(4, np.int64),
        read_motion=np.zeros(6),
        newest_integers=no_command.copy(),
        target=np.zeros((n, 3)),
        velocity=np.zeros((n, 3)),
        position=np.zeros((n, 3)),
        applied=np.zeros((n, 3)),
        step=np.zeros((n, 3)),
        device_force=np.zeros((n, 3)),
        previous_force=np.zeros((n, 3)),
        rendered_force=np.zeros((n, 3)),
        displacement=np.zeros((n, 3)),
        force=np.zeros((n, 3)),
        scale=np.zeros(n),
        energy=np.zeros(n),
        model=make_model(system),
        next_model=make_model(_nothing(n)),
        fade=np.zeros(2),
        record_times=np.zeros((RECORDS, 4), np.int64),
        record_inputs=np.zeros((RECORDS, n, 4), np.int64),
        record_motion=np.zeros((RECORDS, n, 8)),
        snapshot_every=np.array([max(1, round(snapshot_period_s / period_s))]),
        snapshot_version=np.zeros(1, np.int64),
        snapshot_tick=np.zeros(1, np.int64),
        snapshot_state=np.zeros(system.order),
        snapshot_displacement=np.zeros((n, 3)),
    )


_typeof: Callable[[object], Any] = typeof
_memory = make_view(_typeof(make_memory(_nothing(1), 1e-3, [Limits(1.0, 1.0, 1.0, 1.0, 1.0)], 1.0)))


@compiled
def write_command(
    commands: Commands,
    contact: int,
    sequence: int,
    client_time_ns: int,
    arrival_ns: int,
    rendered_tick: int,
    target: tuple[float, float, float],
    velocity: tuple[float, float, float],
) -> None:
    """Hand the newest displacement (m, finite) of a contact to the loop. One thread at a time may call this."""
    begin_write(commands.versions, contact)
    commands.integers[contact, SEQUENCE] = sequence
    commands.integers[contact, CLIENT_TIME_NS] = client_time_ns
    commands.integers[contact, ARRIVAL_NS] = arrival_ns
    commands.integers[contact, RENDERED_TICK] = rendered_tick
    for i in range(3):
        commands.target[contact, i] = target[i]
        commands.velocity[contact, i] = velocity[i]
    end_write(commands.versions, contact)


@compiled
def forget_command(commands: Commands, contact: int) -> None:
    """The contact's client is gone: its force fades from the next tick on, without being held first."""
    begin_write(commands.versions, contact)
    commands.integers[contact, SEQUENCE] = -1
    end_write(commands.versions, contact)


@compiled
def is_silent(image: Image, contact: int) -> bool:
    """True when the force of a contact has faded to zero."""
    return _has_faded(_memory(image), contact)


# A change is left in the slot by one thread at a time, which then waits for it with `changed_at`.


@compiled
def set_limits(image: Image, contact: int, limits: Floats) -> None:
    """Ask for other limits of a contact, (5,), the fields of safety.Limits."""
    m = _memory(image)
    m.changes.integers[CHANGED_CONTACT] = contact
    m.changes.limits[:] = limits
    store_release(m.shared, CHANGE, LIMITS)


@compiled
def set_frame(image: Image, contact: int, rotation: Floats, scale: float, origin: Floats) -> None:
    """Ask for another frame of a silent contact, and for its tip to be put to rest: who comes next starts clean.

    rotation (3, 3), origin (3,), m
    """
    m = _memory(image)
    m.changes.integers[CHANGED_CONTACT] = contact
    m.changes.rotation[:] = rotation
    m.changes.scale[0] = scale
    m.changes.origin[:] = origin
    store_release(m.shared, CHANGE, FRAME)


@compiled
def reset(image: Image) -> None:
    """Ask for the model and all tips to be put to rest; every force fades in again.

    A force that a device is rendering is not forgotten: it comes down at the allowed rate.
    """
    store_release(_memory(image).shared, CHANGE, RESET)


@compiled
def exchange(image: Image, replacement: Image) -> None:
    """Ask the loop to go on with another memory.

    `replacement` is the image of the same memory with other `model`, `next_model`, `fade`, or snapshot arrays.
    """
    m = _memory(image)
    m.changes.image[:] = replacement
    store_release(m.shared, CHANGE, EXCHANGE)


@compiled
def changed_at(image: Image) -> int:
    """The first tick after the change that was asked for, or -1 while no tick has taken it up."""
    m = _memory(image)
    if load_acquire(m.shared, CHANGE) != NO_CHANGE:
        return -1
    return m.changes.integers[CHANGED_AT_TICK]


@compiled
def take_up_change(image: Image) -> None:
    """Carry out what is in the slot. Called with the tick lock held, or in a replay; afterwards the image may be another."""
    m = _memory(image)
    kind = load_acquire(m.shared, CHANGE)
    if kind == NO_CHANGE:
        return
    changes = m.changes
    contact = changes.integers[CHANGED_CONTACT]
    if kind == LIMITS:
        m.limits[contact] = changes.limits
    elif kind == FRAME:
        m.rotation[contact] = changes.rotation
        m.frame_scale[contact] = changes.scale[0]
        m.origin[contact] = changes.origin
        _put_to_rest(m, contact)
    elif kind == RESET:
        m.model.state[:] = 0.0
        m.next_model.state[:] = 0.0
        m.scale[:] = 0.0
        for i in range(m.applied.shape[0]):
            _put_to_rest(m, i)
    else:
        m.counters[AT_REST_SINCE] = -1
        m.counters[QUIET_TICKS] = 0
        image[:] = changes.image
    changes.integers[CHANGED_AT_TICK] = m.counters[TICKS]
    store_release(m.shared, CHANGE, NO_CHANGE)


@compiled
def repeat_tick(image: Image, start_ns: int) -> None:
    """Run the next tick as if it began at `start_ns`: for replays, where no other thread is at work."""
    take_up_change(image)
    _run_tick(_memory(image), start_ns, start_ns, False)


@compiled
def _put_to_rest(m: Memory, contact: int) -> None:
    """The tip is where its frame has its rest, on the undeformed surface, and nothing has gone through its port."""
    for i in range(3):
        m.target[contact, i] = m.position[contact, i] = m.applied[contact, i] = m.origin[contact, i]
        m.velocity[contact, i] = 0.0
        m.displacement[contact, i] = 0.0
    m.energy[contact] = 0.0


@compiled
def _has_faded(m: Memory, contact: int) -> bool:
    force = m.previous_force[contact]
    return m.scale[contact] == 0.0 and force[0] == 0.0 and force[1] == 0.0 and force[2] == 0.0


@compiled
def tick_on_arrival(image: Image, arrival_ns: int) -> int:
    """A command came at `arrival_ns`: run the tick if its deadline is near, and pull the deadlines towards it.

    `image` is that of a Memory. Returns the number of ticks that ran.
    """
    m = _memory(image)
    if not compare_and_swap(m.shared, LOCK, 0, 1):
        return 0  # the deadline loop is at it; the command is in its slot for this tick or the next
    period = m.period_ns[0]
    deadline = m.shared[DEADLINE_NS]
    half = period // 2
    error = (arrival_ns + period // 4 - deadline + half) % period - half
    before = m.counters[TICKS]
    if (
        m.counters[SHIFTED_AT] != before
    ):  # of a burst for one tick, the first counts: no client drags model time along
        m.counters[SHIFTED_AT] = before
        deadline += min(max(error // _PHASE_GAIN, -_PHASE_SHIFT_NS), _PHASE_SHIFT_NS)
        store_release(m.shared, DEADLINE_NS, deadline)
    ticks = 0
    if arrival_ns >= deadline - period // 2:
        take_up_change(image)
        _run_due_ticks(_memory(image), arrival_ns)
        ticks = m.counters[TICKS] - before
        m.counters[TICKS_ON_ARRIVAL] += 1
    store_release(m.shared, LOCK, 0)
    return ticks


@compiled_without_gil
def run_at_deadlines(image: Image, event_fd: int) -> None:
    """Run every tick that no command has triggered, waking whoever reads `event_fd`; until STOP is set."""
    m = _memory(image)
    counted = 0
    while load_acquire(m.shared, STOP) == 0:
        deadline = load_acquire(m.shared, DEADLINE_NS)
        sleep_until(deadline)
        now = monotonic_ns()
        if deadline > counted:  # once a deadline, also when the tick is already done or must wait
            _count(m, TIMER_LATENESS, now - deadline)
            counted = deadline
        if load_acquire(m.shared, DEADLINE_NS) > now:
            continue
        if compare_and_swap(m.shared, LOCK, 0, 1):
            if m.shared[DEADLINE_NS] <= now:
                take_up_change(image)
                _run_due_ticks(_memory(image), now)  # the image is another after an exchange
            store_release(m.shared, LOCK, 0)
            _eventfd_write(event_fd, 1)
        else:
            sleep_until(now + _RETRY_NS)


@compiled
def stop(shared: Integers) -> None:
    store_release(shared, STOP, 1)


@compiled
def records_written(shared: Integers) -> int:
    """The number of ticks whose record is complete."""
    return load_acquire(shared, HEAD)


@compiled
def read_snapshot(image: Image, state: Floats, displacement: Floats) -> int:
    """Copy the last snapshot of the model into `state` (order,) and `displacement` (n_contacts, 3), m; its tick, or -1."""
    m = _memory(image)
    for _ in range(_RETRIES):
        version = begin_read(m.snapshot_version, 0)
        state[:] = m.snapshot_state
        displacement[:] = m.snapshot_displacement
        tick = m.snapshot_tick[0]
        if is_whole(m.snapshot_version, 0, version):
            return tick
    return -1


@compiled
def _run_due_ticks(m: Memory, now: int) -> None:
    """Run the next tick, and with it those whose deadlines have passed since. Called with the lock held."""
    period = m.period_ns[0]
    deadline = m.shared[DEADLINE_NS]
    due = 1
    if now > deadline:
        due += (now - deadline) // period
    if due > MAX_CATCH_UP:
        m.counters[SKIPPED_TICKS] += due - MAX_CATCH_UP
        deadline += (due - MAX_CATCH_UP) * period
        due = MAX_CATCH_UP
    for i in range(due):
        _run_tick(m, deadline, monotonic_ns(), i < due - 1)
        deadline += period
    store_release(m.shared, DEADLINE_NS, deadline)


@compiled
def _run_tick(m: Memory, deadline: int, start: int, missed: bool) -> None:
    period = m.period_ns[0]
    period_s = period * 1e-9
    tick = m.counters[TICKS]
    row = tick % m.record_times.shape[0]
    n_contacts = m.applied.shape[0]

    lateness = start - deadline
    tick_flags = 0
    if lateness > period // 4:
        tick_flags |= _LATE
        m.counters[LATE_TICKS] += 1
    if missed:
        tick_flags |= _CAUGHT_UP
        m.counters[CAUGHT_UP_TICKS] += 1
    _count(m, TICK_LATENESS, lateness)

    for i in range(n_contacts):
        fresh = _read_command(m, i)
        integers = m.newest_integers[i]
        known = integers[SEQUENCE] >= 0
        # A command may come between the start of the tick and here.
        age = max(0, start - integers[ARRIVAL_NS]) if known else -1
        live = known and age <= safety.HOLD_NS
        flags = tick_flags
        if known:
            m.tallies[i, COMMANDED_TICKS] += 1
            if fresh:
                m.tallies[i, FRESH_TICKS] += 1
        if live:
            if not fresh:
                flags |= _HELD
            _count(m, INPUT_AGE, age)
            safety.reconstruct(m.target[i], m.velocity[i], age, m.position[i])
        elif _has_faded(m, i):
            # Nobody feels it any more: withdraw the tip, so that the tissue comes to rest.
            m.position[i] = m.origin[i]
            m.energy[i] = 0.0
        for j in range(3):
            m.step[i, j] = m.applied[i, j]
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
        for j in range(3):
            m.step[i, j] = m.applied[i, j] - m.step[i, j]
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
    kernel.output(model.c, model.d, model.state, displacement, model.force.reshape(3 * n_contacts))
    if tick % m.snapshot_every[0] == 0:
        _write_snapshot(m, tick)
    kernel.update(model.diagonal, model.cross, model.b_transposed, model.state, displacement)
    share = 0.0
    if m.fade[1] > 0.0:
        following = m.next_model
        kernel.output(
            following.c, following.d, following.state, displacement, following.force.reshape(3 * n_contacts)
        )
        kernel.update(
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
        told = 0 <= rendered_tick < tick and tick - rendered_tick < m.record_times.shape[0]
        rendered = m.record_motion[(rendered_tick if told else tick - 1) % m.record_times.shape[0], i]
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
        if flags & _DECAYING and _has_faded(m, i):
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
    _count(m, COMPUTE_TIME, compute)
    store_release(m.shared, HEAD, tick + 1)


@compiled
def _settle(m: Memory, tick: int) -> None:
    """Note whether everything is at rest, and put the model's state to zero when what is left of it is negligible."""
    moving = m.fade[1] > 0.0
    for i in range(m.applied.shape[0]):
        moving = moving or not _has_faded(m, i)
        for j in range(3):
            moving = moving or m.displacement[i, j] != 0.0
    if moving:
        m.counters[AT_REST_SINCE] = -1
        m.counters[QUIET_TICKS] = 0
    elif m.counters[AT_REST_SINCE] < 0:
        for i in range(m.force.shape[0]):
            for j in range(3):
                if abs(m.force[i, j]) > _REST_FORCE_N:
                    m.counters[QUIET_TICKS] = 0
                    return
        m.counters[QUIET_TICKS] += 1
        if m.counters[QUIET_TICKS] >= _REST_TICKS:
            m.model.state[:] = 0.0
            m.counters[AT_REST_SINCE] = tick + 1


@compiled
def _read_command(m: Memory, contact: int) -> bool:
    """Take the newest command of a contact from its slot; True when it is another one than before.

    A writer that is interrupted in the middle can't hold the loop up: after some tries the value before stays.
    """
    commands = m.commands
    before = m.newest_integers[contact, SEQUENCE]
    for _ in range(_RETRIES):
        version = begin_read(commands.versions, contact)
        for i in range(4):
            m.read_integers[i] = commands.integers[contact, i]
        for i in range(3):
            m.read_motion[i] = commands.target[contact, i]
            m.read_motion[3 + i] = commands.velocity[contact, i]
        if is_whole(commands.versions, contact, version):
            sequence = m.read_integers[SEQUENCE]
            m.newest_integers[contact] = m.read_integers
            if sequence >= 0:
                for i in range(3):
                    m.target[contact, i] = m.read_motion[i]
                    m.velocity[contact, i] = m.read_motion[3 + i]
            return sequence != before
    return False


@compiled
def _write_snapshot(m: Memory, tick: int) -> None:
    begin_write(m.snapshot_version, 0)
    m.snapshot_tick[0] = tick
    m.snapshot_state[:] = m.model.state
    m.snapshot_displacement[:] = m.displacement
    end_write(m.snapshot_version, 0)


@compiled
def _count(m: Memory, histogram: int, duration_ns: int) -> None:
    duration = max(duration_ns, 0)
    m.longest_ns[histogram] = max(m.longest_ns[histogram], duration)
    m.histograms[histogram, min(duration // _BIN_NS, HISTOGRAM_BINS - 1)] += 1
