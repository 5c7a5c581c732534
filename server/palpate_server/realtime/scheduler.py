"""When ticks run: exactly one step each period, on the arrival of a command or else at its deadline.

Deadlines are one period apart on the monotonic clock. A tick runs when a command arrives less than half a period before its
deadline, so that the answer is sent at once; otherwise a compiled loop without the GIL runs it at the deadline. The thread that
takes the tick lock first runs the tick and moves the deadline on. The deadlines slowly shift until a steady client's commands
arrive a quarter of a period before them.

No other thread takes that lock: new limits, frames, a reset or another model are written to a slot, and the next tick applies them
before it begins. So no thread of ordinary priority can delay a tick.

When ticks are missed, up to MAX_CATCH_UP are run at once with the newest input. The others are skipped and counted; they take
no model time.
"""

from __future__ import annotations

from typing import Any

from numba import int32, types, uint64

from palpate_client.wire import MAX_POSITION_M, MAX_VELOCITY_M_PER_S
from palpate_server.coupling import cross_fade
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
from palpate_server.realtime.tick import count, put_tissue_to_rest, put_to_rest, run_tick

MAX_CATCH_UP = 20
_RETRY_NS = 20_000  # how long the deadline loop sleeps while the other thread runs the tick
_PHASE_SHIFT_NS = 2_000  # the most that the deadlines move in a tick: 0.2 % of a millisecond
_PHASE_GAIN = 16

# Why a command is refused: results of `arrive`, indices into REFUSALS.
REFUSALS = ("", "out_of_range", "not_finite", "old_sequence")
_OUT_OF_RANGE, _NOT_FINITE, _OLD_SEQUENCE = -1, -2, -3

_eventfd_write: Any = types.ExternalFunction("eventfd_write", int32(int32, uint64))


@compiled
def hand_over(image: Image, n_tools: int) -> int:
    """As `arrive`, but without a tick, for tests and benchmarks. Returns zero, or minus the reason's index."""
    m = view(image)
    refused = _check(m.commands, n_tools)
    if not refused:
        _hand_over(m.commands, n_tools)
    return refused


@compiled
def _check(commands: Commands, n_tools: int) -> int:
    """Check all commands of one message. Returns zero, or minus the index of the reason in REFUSALS."""
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
    """Store the incoming commands of one message as the newest, under the sequence lock: a tick reads all or none."""
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


# One thread at a time writes a change to the slot, and waits for it with `is_changed`.


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
def set_tip(image: Image, tool: int, tip: Floats, start: Floats) -> None:
    """Ask for another tip of a silent tool of a surface model.

    tip (3,): radius, m, friction, stiffness, N/m, as in `running.Tip`; start (3,), m
    """
    m = view(image)
    settings = _prepare(m, tool)
    settings.radius_m = tip[0]
    settings.friction = tip[1]
    settings.stiffness_n_per_m = tip[2]
    for j in range(3):
        settings.start_m[j] = start[j]
    store_release(m.shared, CHANGE, Change.TIP)


@compiled
def _prepare(m: Memory, tool: int) -> Record:
    """The slot's settings, which are those of the tool until they are changed."""
    m.changes.port[0] = tool
    m.changes.settings[0] = m.settings[tool]
    return m.changes.settings[0]


@compiled
def reset(image: Image) -> None:
    """Ask for the body and all tips to be put to rest; every force fades in again.

    A force that a device renders at that moment decreases at the allowed rate.
    """
    store_release(view(image).shared, CHANGE, Change.RESET)


@compiled
def exchange(image: Image, replacement: Image) -> None:
    """Ask the loop to continue with another memory: the same arrays with another coupling."""
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
    """Remove the change from the slot. Returns False if a tick has taken it already."""
    m = view(image)
    kind = load_acquire(m.shared, CHANGE)
    return kind > Change.NONE and compare_and_swap(m.shared, CHANGE, kind, Change.NONE)


@compiled
def take_up_change(image: Image) -> None:
    """Carry out the change in the slot, and save the state. Called with the tick lock held, or in a replay.

    The content of the image may be replaced.
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
        for j in range(3):  # not so after a reset, where the device has not moved
            m.ports[tool].device_m[j] = m.settings[tool].home_m[j]
        put_to_rest(m, tool)
    elif kind == Change.TIP:
        m.settings[tool] = changes.settings[0]
        cross_fade.set_tip(m.coupling, tool, m.settings[tool])
    elif kind == Change.RESET:
        put_tissue_to_rest(m)
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
    cross_fade.save(m.coupling, m.saved.state)


@compiled
def repeat_tick(image: Image, deadline_ns: int, start_ns: int, missed: bool) -> None:
    """Run the next tick as `tick.run_tick`: for replays, where no other thread is at work."""
    take_up_change(image)
    run_tick(view(image), deadline_ns, start_ns, missed)


@compiled
def _tick_on_arrival(image: Image, arrival_ns: int) -> int:
    """Run the tick if its deadline is near, and shift the deadlines towards this command. Returns the number of ticks."""
    m = view(image)
    if not compare_and_swap(m.shared, LOCK, 0, 1):
        return 0  # the deadline loop runs the tick; the command is used by this tick or the next
    counters = m.counters[0]
    period = m.period_ns[0]
    deadline = m.shared[DEADLINE_NS]
    half = period // 2
    error = (arrival_ns + period // 4 - deadline + half) % period - half
    before = counters.ticks
    if counters.shifted_at != before:  # only the first command of a tick shifts the deadlines
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
    """Check the first `n_tools` incoming commands, one message; store them as the newest; run the tick if its deadline is near.

    Returns the number of ticks that ran; or minus the index of the reason in REFUSALS, and then nothing is stored.
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
    """Run every tick that no command has triggered, and write to the eventfd `event_fd` after it, until STOP is set."""
    m = view(image)
    counted = 0
    while load_acquire(m.shared, STOP) == 0:
        deadline = load_acquire(m.shared, DEADLINE_NS)
        sleep_until(deadline)
        now = monotonic_ns()
        if deadline > counted:  # once for each deadline, even if its tick already ran or must wait
            count(m, TIMER_LATENESS, now - deadline)
            counted = deadline
        if load_acquire(m.shared, DEADLINE_NS) > now:
            continue
        if compare_and_swap(m.shared, LOCK, 0, 1):
            if m.shared[DEADLINE_NS] <= now:
                take_up_change(image)
                _run_due_ticks(view(image), now)  # after an exchange the image has changed
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
    """Copy the last snapshot into `state` (shown_size,) and `displacement` (n_tools, 3), m; its tick, or -1."""
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
    """Run the next tick and all others whose deadlines have passed. Called with the lock held."""
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
