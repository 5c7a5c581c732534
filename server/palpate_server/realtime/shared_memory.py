"""All that ticks and the threads around them share: arrays that are made once, and what their columns mean."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numba import typeof
from numpy.typing import NDArray

from palpate.model_file import StateSpace
from palpate_server.bodies.state_space import aligned
from palpate_server.realtime.native_image import WORDS, Image, make_view
from palpate_server.realtime.safety import Limits

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

RECORDS = 4096  # ticks that are kept: what publishers have not sent yet, and the recent past
HISTOGRAM_BINS = 10_000  # of a microsecond; the last one also holds what is longer

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
TAKEN = -1  # by the tick that carries it out
CHANGED_CONTACT, CHANGED_AT_TICK = range(2)
# Commands: those that ticks read, and those that wait for the rest of their message.
NEWEST, STAGED = range(2)
# Columns of Commands.integers; Memory.record_inputs has the age and the flags behind the first two.
SEQUENCE, CLIENT_TIME_NS, ARRIVAL_NS, RENDERED_TICK, LEASE = range(5)
AGE_NS, CONTACT_FLAGS = 2, 3
# Columns of Memory.record_times.
START_NS, TICK_DEADLINE_NS, COMPUTE_NS, TICK_FLAGS = range(4)
# Columns of Memory.record_motion: displacement 0:3, force 3:6, then these.
SCALE, ENERGY_J = 6, 7
# Columns of Memory.limits.
MAX_FORCE, MAX_FORCE_RATE, MAX_SPEED, WORKSPACE, MAX_DAMPING = range(5)
# Rows of Memory.histograms.
TIMER_LATENESS, TICK_LATENESS, COMPUTE_TIME, INPUT_AGE = range(4)


class Commands(NamedTuple):
    """The newest command of each contact, handed over under a sequence lock. n = n_contacts.

    versions (1,), of that lock; lease (n,): the number of the present hold, which grows when it ends; integers (2, n, 5),
    NEWEST and STAGED: SEQUENCE (-1: none yet), CLIENT_TIME_NS, ARRIVAL_NS, RENDERED_TICK (the tick whose force the device
    was rendering until then, -1: not told), LEASE (of the hold that the command was checked for: of another one it is not
    carried out); motion (2, n, 6): displacement (m) and velocity (m/s)
    """

    versions: Integers
    lease: Integers
    integers: Integers
    motion: Floats


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
    commands         what clients want; read_integers (n, 5), read_motion (n, 6): a read that may be torn;
                     newest_integers, target, velocity: what the tick last read of it; fresh (n,): 1 when that is new
    position, device, step, applied, device_force, previous_force, rendered_force  (n, 3), m and N, in the holders'
                     frames: where the tip is wanted, where the device is by that, and how far from the tick before,
                     where the tip is, the force, the one before, and the one that the device was rendering
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
    fresh: Integers
    target: Floats
    velocity: Floats
    position: Floats
    device: Floats
    step: Floats
    applied: Floats
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
        diagonal=aligned(system.diagonal),
        cross=aligned(system.cross),
        b_transposed=aligned(system.b.T),
        c=aligned(system.c),
        d=aligned(system.d),
        state=aligned(state),
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
    no_command = np.zeros((2, n, 5), np.int64)
    no_command[..., SEQUENCE] = no_command[..., RENDERED_TICK] = -1
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
        commands=Commands(np.zeros(1, np.int64), np.zeros(n, np.int64), no_command, np.zeros((2, n, 6))),
        read_integers=np.zeros((n, 5), np.int64),
        read_motion=np.zeros((n, 6)),
        newest_integers=no_command[NEWEST].copy(),
        fresh=np.zeros(n, np.int64),
        target=np.zeros((n, 3)),
        velocity=np.zeros((n, 3)),
        position=np.zeros((n, 3)),
        device=np.zeros((n, 3)),
        step=np.zeros((n, 3)),
        applied=np.zeros((n, 3)),
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
view = make_view(_typeof(make_memory(_nothing(1), 1e-3, [Limits(1.0, 1.0, 1.0, 1.0, 1.0)], 1.0)))
