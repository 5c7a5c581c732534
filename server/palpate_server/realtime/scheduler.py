"""When ticks run: exactly one step each period, on the arrival of a command or else at its deadline.

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

from palpate_client.wire import MAX_POSITION_M, MAX_VELOCITY_M_PER_S
from palpate_server import coupling as couplings
from palpate_server.realtime import safety
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
from palpate_server.realtime.native_image import Image, view
from palpate_server.realtime.port import Record, has_faded
from palpate_server.realtime.records import RECORDS, Change
from palpate_server.realtime.shared_memory import (
    CHANGE,
    DEADLINE_NS,
    HEAD,
    LOCK,
    STOP,
    TAKEN,
    TIMER_LATENESS,
    Commands,
    Floats,
    Integers,
    Memory,
)
from palpate_server.realtime.tick import count, put_to_rest, run_tick

MAX_CATCH_UP = 20
_RETRY_NS = 20_000  # the deadline loop's nap while the other side runs the tick
_PHASE_SHIFT_NS = 2_000  # the most that the deadlines move in a tick: 0.2 % of a millisecond
_PHASE_GAIN = 16

# Why a command is refused: results of `arrive`, indices into REFUSALS.
REFUSALS = ("", "out_of_range", "not_finite", "old_sequence")
_OUT_OF_RANGE, _NOT_FINITE, _OLD_SEQUENCE = -1, -2, -3

_eventfd_write: Any = types.ExternalFunction("eventfd_write", int32(int32, uint64))


@compiled
def hand_over(image: Image, n_tools: int) -> int:
    """Like `arrive`, but without a tick, for replays and tests; zero, or minus the reason's index."""
    m = view(image)
    refused = _check(m.commands, n_tools)
    if not refused:
        _hand_over(m.commands, n_tools)
    return refused


@compiled
def _check(commands: Commands, n_tools: int) -> int:
    """Zero, or why a message is refused as a whole."""
    worst = 0
    for k in range(n_tools):
        command = commands.incoming[k]
        newest = commands.newest[command.tool]
        if newest.lease == command.lease and command.sequence <= newest.sequence:
            return _OLD_SEQUENCE
        for vector, largest in (
            (command.position_m, MAX_POSITION_M),
            (command.velocity_m_per_s, MAX_VELOCITY_M_PER_S),
        ):
            if not safety.all_finite(vector):
                worst = min(worst, _NOT_FINITE)
            for j in range(3):
                if abs(vector[j]) > largest:
                    worst = min(worst, _OUT_OF_RANGE)
    return worst


@compiled
def _hand_over(commands: Commands, n_tools: int) -> None:
    """Put the incoming commands of one message where ticks find them: no tick comes in between."""
    begin_write(commands.versions, 0)
    for k in range(n_tools):
        tool = commands.incoming[k].tool
        commands.newest[tool] = commands.incoming[k]
        commands.accepted[tool] += 1
    end_write(commands.versions, 0)


@compiled
def forget_command(commands: Commands, tool: int) -> None:
    """End the hold of a tool: its force fades from the next tick on, without being held first.

    Commands that were checked for this hold and come later are discarded.
    """
    begin_write(commands.versions, 0)
    commands.lease[tool] += 1
    commands.newest[tool].sequence = -1
    end_write(commands.versions, 0)


@compiled
def is_silent(image: Image, tool: int) -> bool:
    """Whether the force of a tool has faded to zero."""
    return has_faded(view(image).ports[tool])


# One thread at a time leaves a change in the slot and waits for it with `is_changed`.


@compiled
def set_limits(image: Image, tool: int, limits: Floats) -> None:
    """Ask for other limits of a tool, (5,), the fields of safety.Limits."""
    m = view(image)
    settings = _prepare(m, tool)
    settings.max_force_n = limits[0]
    settings.max_force_rate_n_per_s = limits[1]
    settings.max_speed_m_per_s = limits[2]
    settings.workspace_radius_m = limits[3]
    settings.max_damping_n_s_per_m = limits[4]
    store_release(m.shared, CHANGE, Change.LIMITS)


@compiled
def set_frame(image: Image, tool: int, rotation: Floats, scale: float, home: Floats) -> None:
    """Ask for another frame of a silent tool, and for its tip to be put to its start.

    rotation (3, 3), home (3,), m: as in `frames`
    """
    m = view(image)
    settings = _prepare(m, tool)
    for i in range(3):
        settings.home_m[i] = home[i]
        for j in range(3):
            settings.rotation[i, j] = rotation[i, j]
    settings.scale = scale
    store_release(m.shared, CHANGE, Change.FRAME)


@compiled
def _prepare(m: Memory, tool: int) -> Record:
    """The slot's settings, which are those of the tool until they are changed."""
    m.changes.port[0] = tool
    m.changes.settings[0] = m.settings[tool]
    return m.changes.settings[0]


@compiled
def reset(image: Image) -> None:
    """Ask for the body and all tips to be put to rest; every force fades in again.

    A force that a device is rendering is not forgotten: it comes down at the allowed rate.
    """
    store_release(view(image).shared, CHANGE, Change.RESET)


@compiled
def exchange(image: Image, replacement: Image) -> None:
    """Ask the loop to go on with another memory: the same one with another coupling."""
    m = view(image)
    m.changes.image[:] = replacement
    store_release(m.shared, CHANGE, Change.EXCHANGE)


@compiled
def save(image: Image) -> None:
    """Ask for the state to be saved."""
    store_release(view(image).shared, CHANGE, Change.SAVE)


@compiled
def is_changed(image: Image) -> bool:
    """Whether the change that was asked for has been carried out."""
    return load_acquire(view(image).shared, CHANGE) == Change.NONE


@compiled
def withdraw_change(image: Image) -> bool:
    """Take the change out of the slot again; False when a tick has taken it up already."""
    m = view(image)
    kind = load_acquire(m.shared, CHANGE)
    return kind > Change.NONE and compare_and_swap(m.shared, CHANGE, kind, Change.NONE)


@compiled
def take_up_change(image: Image) -> None:
    """Carry out what is in the slot, and save the state. Called with the tick lock held, or in a replay.

    Afterwards the image may be another.
    """
    m = view(image)
    kind = load_acquire(m.shared, CHANGE)
    if kind == Change.NONE or not compare_and_swap(m.shared, CHANGE, kind, TAKEN):
        return
    changes = m.changes
    tool = changes.port[0]
    if kind == Change.LIMITS:
        m.settings[tool] = changes.settings[0]
    elif kind == Change.FRAME:
        m.settings[tool] = changes.settings[0]
        for j in range(3):  # after a reset, though, the device is where it was
            m.ports[tool].device_m[j] = m.settings[tool].home_m[j]
        put_to_rest(m, tool)
    elif kind == Change.RESET:
        couplings.put_to_rest(m.coupling)
        for i in range(m.ports.shape[0]):
            m.ports[i].force_scale = 0.0
            put_to_rest(m, i)
    elif kind == Change.EXCHANGE:
        m.counters[0].quiet_ticks = 0
        image[:] = changes.image
    _save(view(image))
    m.ring.ticks[m.counters[0].ticks % RECORDS].change = kind
    store_release(m.shared, CHANGE, Change.NONE)


@compiled
def _save(m: Memory) -> None:
    m.saved.counters[0] = m.counters[0]
    for i in range(m.ports.shape[0]):
        m.saved.used[i] = m.used[i]
        m.saved.settings[i] = m.settings[i]
        m.saved.ports[i] = m.ports[i]
    couplings.save(m.coupling, m.saved.state)


@compiled
def repeat_tick(image: Image, deadline_ns: int, start_ns: int, missed: bool) -> None:
    """Run the next tick as `tick.run_tick`: for replays, where no other thread is at work."""
    take_up_change(image)
    run_tick(view(image), deadline_ns, start_ns, missed)


@compiled
def _tick_on_arrival(image: Image, arrival_ns: int) -> int:
    """A command came at `arrival_ns`: run the tick if its deadline is near, and pull the deadlines towards it."""
    m = view(image)
    if not compare_and_swap(m.shared, LOCK, 0, 1):
        return 0  # the deadline loop is at it; the command is in its slot for this tick or the next
    counters = m.counters[0]
    period = m.period_ns[0]
    deadline = m.shared[DEADLINE_NS]
    half = period // 2
    error = (arrival_ns + period // 4 - deadline + half) % period - half
    before = counters.ticks
    if counters.shifted_at != before:  # of a burst for one tick, the first counts
        counters.shifted_at = before
        deadline += min(max(error // _PHASE_GAIN, -_PHASE_SHIFT_NS), _PHASE_SHIFT_NS)
        store_release(m.shared, DEADLINE_NS, deadline)
    ticks = 0
    if arrival_ns >= deadline - period // 2:
        take_up_change(image)
        _run_due_ticks(view(image), arrival_ns)
        ticks = counters.ticks - before
        counters.ticks_on_arrival += 1
    store_release(m.shared, LOCK, 0)
    return ticks


@compiled
def arrive(image: Image, n_tools: int) -> int:
    """Hand over the first `n_tools` of the incoming commands, which are one message, and run the tick if it is near.

    The number of ticks that ran; or, below zero, minus the index of the reason in REFUSALS: then nothing is handed over.
    One thread at a time may fill Commands.incoming and call this.
    """
    m = view(image)
    result = _check(m.commands, n_tools)
    if result == 0:
        _hand_over(m.commands, n_tools)
        result = _tick_on_arrival(image, m.commands.incoming[0].arrival_ns)
    return result


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
    """Copy the last snapshot into `state` (order,) of the body and `displacement` (n_tools, 3), m; its tick, or -1."""
    m = view(image)
    for _ in range(MAX_READS):
        version = begin_read(m.snapshot.versions, 0)
        for i in range(state.shape[0]):
            state[i] = m.snapshot.state[i]
        for i in range(displacement.shape[0]):
            for j in range(3):
                displacement[i, j] = m.snapshot.displacement[i, j]
        tick = m.snapshot.tick[0]
        if is_whole(m.snapshot.versions, 0, version):
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
        m.counters[0].skipped_ticks += due - MAX_CATCH_UP
        deadline += (due - MAX_CATCH_UP) * period
        due = MAX_CATCH_UP
    for i in range(due):
        run_tick(m, deadline, monotonic_ns(), i < due - 1)
        deadline += period
    store_release(m.shared, DEADLINE_NS, deadline)
