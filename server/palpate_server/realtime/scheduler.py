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

from typing import Any

from numba import int32, types, uint64

from palpate_server.realtime.atomics import (
    MAX_READS,
    begin_read,
    begin_write,
    compare_and_swap,
    end_write,
    is_whole,
    load_acquire,
    store_release,
)
from palpate_server.realtime.clock import monotonic_ns, sleep_until
from palpate_server.realtime.compiled import compiled, compiled_without_gil
from palpate_server.realtime.native_image import Image
from palpate_server.realtime.shared_memory import (
    ARRIVAL_NS,
    AT_REST_SINCE,
    CHANGE,
    CHANGED_AT_TICK,
    CHANGED_CONTACT,
    CLIENT_TIME_NS,
    DEADLINE_NS,
    EXCHANGE,
    FRAME,
    HEAD,
    LEASE,
    LIMITS,
    LOCK,
    NEWEST,
    NO_CHANGE,
    QUIET_TICKS,
    RENDERED_TICK,
    RESET,
    SEQUENCE,
    SHIFTED_AT,
    SKIPPED_TICKS,
    STAGED,
    STOP,
    TAKEN,
    TICKS,
    TICKS_ON_ARRIVAL,
    TIMER_LATENESS,
    Commands,
    Floats,
    Integers,
    Memory,
    view,
)
from palpate_server.realtime.tick import count, has_faded, put_to_rest, run_tick

MAX_CATCH_UP = 20
_RETRY_NS = 20_000  # the deadline loop's nap while the other side runs the tick
_PHASE_SHIFT_NS = 2_000  # the most that the deadlines move in a tick: 0.2 % of a millisecond
_PHASE_GAIN = 16

_eventfd_write: Any = types.ExternalFunction("eventfd_write", int32(int32, uint64))


@compiled
def stage_command(
    commands: Commands,
    contact: int,
    sequence: int,
    client_time_ns: int,
    arrival_ns: int,
    rendered_tick: int,
    lease: int,
    target: tuple[float, float, float],
    velocity: tuple[float, float, float],
) -> None:
    """Have the displacement (m, finite) of a contact handed to the loop with the next `write_command`, in one act with it.

    One thread at a time may call this. lease: commands.lease[contact], read before it was checked whether the client holds
    the contact
    """
    integers, motion = commands.integers[STAGED, contact], commands.motion[STAGED, contact]
    integers[SEQUENCE] = sequence
    integers[CLIENT_TIME_NS] = client_time_ns
    integers[ARRIVAL_NS] = arrival_ns
    integers[RENDERED_TICK] = rendered_tick
    integers[LEASE] = lease
    for i in range(3):
        motion[i] = target[i]
        motion[3 + i] = velocity[i]


@compiled
def write_command(
    commands: Commands,
    contact: int,
    sequence: int,
    client_time_ns: int,
    arrival_ns: int,
    rendered_tick: int,
    lease: int,
    target: tuple[float, float, float],
    velocity: tuple[float, float, float],
) -> None:
    """Hand the newest displacement of a contact to the loop, and those that are staged: no tick comes in between."""
    stage_command(
        commands, contact, sequence, client_time_ns, arrival_ns, rendered_tick, lease, target, velocity
    )
    integers, motion = commands.integers, commands.motion
    begin_write(commands.versions, 0)
    for i in range(commands.lease.shape[0]):
        if integers[STAGED, i, SEQUENCE] >= 0:
            integers[NEWEST, i] = integers[STAGED, i]
            motion[NEWEST, i] = motion[STAGED, i]
            integers[STAGED, i, SEQUENCE] = -1
    end_write(commands.versions, 0)


@compiled
def forget_command(commands: Commands, contact: int) -> None:
    """The contact's client is gone: its force fades from the next tick on, without being held first.

    Nor is what the client may still have sent, and nobody has looked at yet, carried out.
    """
    begin_write(commands.versions, 0)
    commands.lease[contact] += 1
    commands.integers[NEWEST, contact, SEQUENCE] = -1
    end_write(commands.versions, 0)


@compiled
def is_silent(image: Image, contact: int) -> bool:
    """True when the force of a contact has faded to zero."""
    return has_faded(view(image), contact)


# A change is left in the slot by one thread at a time, which then waits for it with `changed_at`.


@compiled
def set_limits(image: Image, contact: int, limits: Floats) -> None:
    """Ask for other limits of a contact, (5,), the fields of safety.Limits."""
    m = view(image)
    m.changes.integers[CHANGED_CONTACT] = contact
    m.changes.limits[:] = limits
    store_release(m.shared, CHANGE, LIMITS)


@compiled
def set_frame(image: Image, contact: int, rotation: Floats, scale: float, origin: Floats) -> None:
    """Ask for another frame of a silent contact, and for its tip to be put to rest: who comes next starts clean.

    rotation (3, 3), origin (3,), m
    """
    m = view(image)
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
    store_release(view(image).shared, CHANGE, RESET)


@compiled
def exchange(image: Image, replacement: Image) -> None:
    """Ask the loop to go on with another memory.

    `replacement` is the image of the same memory with other `model`, `next_model`, `fade`, or snapshot arrays.
    """
    m = view(image)
    m.changes.image[:] = replacement
    store_release(m.shared, CHANGE, EXCHANGE)


@compiled
def changed_at(image: Image) -> int:
    """The first tick after the change that was asked for, or -1 while none has carried it out."""
    m = view(image)
    if load_acquire(m.shared, CHANGE) != NO_CHANGE:
        return -1
    return m.changes.integers[CHANGED_AT_TICK]


@compiled
def withdraw_change(image: Image) -> bool:
    """Take the change out of the slot again; False when a tick has taken it up already."""
    m = view(image)
    kind = load_acquire(m.shared, CHANGE)
    return kind > NO_CHANGE and compare_and_swap(m.shared, CHANGE, kind, NO_CHANGE)


@compiled
def take_up_change(image: Image) -> None:
    """Carry out what is in the slot. Called with the tick lock held, or in a replay; afterwards the image may be another."""
    m = view(image)
    kind = load_acquire(m.shared, CHANGE)
    if kind == NO_CHANGE or not compare_and_swap(m.shared, CHANGE, kind, TAKEN):
        return
    changes = m.changes
    contact = changes.integers[CHANGED_CONTACT]
    if kind == LIMITS:
        m.limits[contact] = changes.limits
    elif kind == FRAME:
        m.rotation[contact] = changes.rotation
        m.frame_scale[contact] = changes.scale[0]
        m.origin[contact] = changes.origin
        m.device[contact] = changes.origin  # after a reset, though, it is where it was
        put_to_rest(m, contact)
    elif kind == RESET:
        m.model.state[:] = 0.0
        m.next_model.state[:] = 0.0
        m.scale[:] = 0.0
        for i in range(m.applied.shape[0]):
            put_to_rest(m, i)
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
    run_tick(view(image), start_ns, start_ns, False)


@compiled
def tick_on_arrival(image: Image, arrival_ns: int) -> int:
    """A command came at `arrival_ns`: run the tick if its deadline is near, and pull the deadlines towards it.

    `image` is that of a Memory. Returns the number of ticks that ran.
    """
    m = view(image)
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
        _run_due_ticks(view(image), arrival_ns)
        ticks = m.counters[TICKS] - before
        m.counters[TICKS_ON_ARRIVAL] += 1
    store_release(m.shared, LOCK, 0)
    return ticks


@compiled_without_gil
def run_at_deadlines(image: Image, event_fd: int) -> None:
    """Run every tick that no command has triggered, waking whoever reads `event_fd`; until STOP is set."""
    m = view(image)
    counted = 0
    while load_acquire(m.shared, STOP) == 0:
        deadline = load_acquire(m.shared, DEADLINE_NS)
        sleep_until(deadline)
        now = monotonic_ns()
        if deadline > counted:  # once a deadline, also when the tick is already done or must wait
            count(m, TIMER_LATENESS, now - deadline)
            counted = deadline
        if load_acquire(m.shared, DEADLINE_NS) > now:
            continue
        if compare_and_swap(m.shared, LOCK, 0, 1):
            if m.shared[DEADLINE_NS] <= now:
                take_up_change(image)
                _run_due_ticks(view(image), now)  # the image is another after an exchange
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
    m = view(image)
    for _ in range(MAX_READS):
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
        run_tick(m, deadline, monotonic_ns(), i < due - 1)
        deadline += period
    store_release(m.shared, DEADLINE_NS, deadline)
