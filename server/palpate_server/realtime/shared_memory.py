"""The arrays that ticks and other threads share. They are allocated once."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from palpate_server.coupling import cross_fade, running
from palpate_server.coupling.cross_fade import Coupling
from palpate_server.coupling.running import Running
from palpate_server.realtime import native_image
from palpate_server.realtime.native_image import Image
from palpate_server.realtime.records import (
    COMMAND,
    COUNTERS,
    PORT,
    PORT_RECORD,
    REACTION,
    RECORDS,
    SETTINGS,
    TICK,
)
from palpate_server.realtime.safety import Limits

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Records = NDArray[np.void]

HISTOGRAM_BINS = 10_000  # one microsecond each; the last one counts all longer durations

# Elements of Memory.shared, which all sides load and store atomically. CHANGE is a records.Change while it waits.
LOCK, DEADLINE_NS, STOP, HEAD, CHANGE = range(5)
TAKEN = -1  # in CHANGE, by the tick that carries it out
TIMER_LATENESS, TICK_LATENESS, COMPUTE_TIME, INPUT_AGE = range(4)  # rows of Memory.histograms


class Commands(NamedTuple):
    """The newest command of each tool, handed over under a sequence lock.

    versions  (1,), of that lock
    lease     (n,), the number of the present hold, increased when the hold ends; commands of another hold are discarded
    newest    (n,) COMMAND
    incoming  (n,) COMMAND: the commands of one message on their way in
    accepted  (n,), number of commands so far
    """

    versions: Integers
    lease: Integers
    newest: Records
    incoming: Records
    accepted: Integers


class Changes(NamedTuple):
    """The slot for one change between two ticks.

    port (1,), its index; settings (1,) SETTINGS, of that port; image: of the memory to continue with
    """

    port: Integers
    settings: Records
    image: Image


class Saved(NamedTuple):
    """The state between two ticks, saved by every change. A replay begins from it.

    counters (1,) COUNTERS; used (n,) COMMAND; settings (n,) SETTINGS; ports (n,) PORT; state, of the coupling
    """

    counters: Records
    used: Records
    settings: Records
    ports: Records
    state: Floats


class Snapshot(NamedTuple):
    """State and displacement of one tick, for the surface, under a sequence lock.

    versions (1,); every (1,), ticks between two snapshots; tick (1,); state (shown_size,), of the coupling; displacement (n, 3), m
    """

    versions: Integers
    every: Integers
    tick: Integers
    state: Floats
    displacement: Floats


class Ring(NamedTuple):
    """The newest RECORDS ticks, tick t at t % RECORDS: ticks (RECORDS,) TICK, ports (RECORDS, n) PORT_RECORD."""

    ticks: Records
    ports: Records


class Memory(NamedTuple):
    """All that the tick reads and writes. n = n_tools.

    period_ns     (1,)
    shared        (5,), see LOCK to CHANGE
    counters      (1,) COUNTERS, written under the tick lock alone
    histograms    (4, HISTOGRAM_BINS) counts of durations, and longest_ns (4,)
    settings      (n,) SETTINGS
    commands      the newest of each tool
    read, used    (n,) COMMAND: a read that may be torn, and the commands of this tick
    ports         (n,) PORT
    displacement, wanted  (n, 3), m, in the model's frame; (n,), LIFTED, TOUCHING or GRABBING: from the ports to the coupling
    force, reactions, ledger  (n, 3), N; (n,) REACTION; (2,), J, stored and dissipated in the tissue: and back
    """

    period_ns: Integers
    shared: Integers
    counters: Records
    histograms: Integers
    longest_ns: Integers
    settings: Records
    commands: Commands
    read: Records
    used: Records
    ports: Records
    displacement: Floats
    wanted: Integers
    force: Floats
    reactions: Records
    ledger: Floats
    coupling: Coupling
    ring: Ring
    changes: Changes
    saved: Saved
    snapshot: Snapshot


def make_memory(
    model: Running,
    period_s: float,
    limits: Sequence[Limits],
    snapshot_period_s: float,
    homes: Sequence[Sequence[float]] | None = None,
) -> Memory:
    """Memory for a model that runs, with no command yet, whose first deadline is a period from now.

    homes (n_tools, 3), m: where the tips are, at their tools' starts; the origin when left out
    """
    n = len(limits)
    coupling = cross_fade.make(model, n)
    period_ns = round(period_s * 1e9)
    shared = np.zeros(5, np.int64)
    shared[DEADLINE_NS] = time.monotonic_ns() + period_ns
    settings, ports = _settings(limits), np.zeros(n, PORT)
    if homes is not None:
        for positions in (settings["home_m"], ports["position_m"], ports["device_m"], ports["applied_m"]):
            positions[:] = homes
    return Memory(
        period_ns=np.array([period_ns]),
        shared=shared,
        counters=_counters(),
        histograms=np.zeros((4, HISTOGRAM_BINS), np.int64),
        longest_ns=np.zeros(4, np.int64),
        settings=settings,
        commands=Commands(
            np.zeros(1, np.int64),
            np.zeros(n, np.int64),
            _no_commands(n),
            _no_commands(n),
            np.zeros(n, np.int64),
        ),
        read=_no_commands(n),
        used=_no_commands(n),
        ports=ports,
        displacement=np.zeros((n, 3)),
        wanted=np.zeros(n, np.int64),
        force=np.zeros((n, 3)),
        reactions=np.zeros(n, REACTION),
        ledger=np.zeros(2),
        coupling=coupling,
        ring=Ring(np.zeros(RECORDS, TICK), np.zeros((RECORDS, n), PORT_RECORD)),
        changes=Changes(np.zeros(1, np.int64), np.zeros(1, SETTINGS), native_image.empty_image(_IMAGE)),
        saved=_saved(coupling),
        snapshot=_snapshot(coupling, max(1, round(snapshot_period_s / period_s))),
    )


def with_coupling(memory: Memory, coupling: Coupling) -> Memory:
    """The same memory with another coupling."""
    snapshot = _snapshot(coupling, int(memory.snapshot.every[0]))
    return memory._replace(coupling=coupling, saved=_saved(coupling), snapshot=snapshot)


def _settings(limits: Sequence[Limits]) -> Records:
    settings = np.zeros(len(limits), SETTINGS)
    for name, values in zip(Limits._fields, zip(*limits, strict=True), strict=True):
        settings[name] = values
    settings["rotation"] = np.eye(3)
    settings["scale"] = 1.0
    return settings


def _counters() -> Records:
    counters = np.zeros(1, COUNTERS)
    counters["shifted_at"] = -1
    return counters


def _no_commands(n: int) -> Records:
    commands = np.zeros(n, COMMAND)
    commands["sequence"] = commands["rendered_tick"] = -1
    return commands


def _saved(coupling: Coupling) -> Saved:
    n = coupling.n_tools
    return Saved(
        _counters(),
        _no_commands(n),
        np.zeros(n, SETTINGS),
        np.zeros(n, PORT),
        np.zeros(coupling.state_size()),
    )


def _snapshot(coupling: Coupling, every: int) -> Snapshot:
    return Snapshot(
        np.zeros(1, np.int64),
        np.array([every]),
        np.full(1, -1),
        np.zeros(coupling.shown_size()),
        np.zeros((coupling.n_tools, 3)),
    )


_IMAGE = "memory"
native_image.register(_IMAGE, make_memory(running.empty(), 1e-3, [Limits(1.0, 1.0, 1.0, 1.0, 1.0)], 1.0))
