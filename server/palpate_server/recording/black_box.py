"""Writes the last two seconds of ticks to a file after a fault."""

from __future__ import annotations

import io
import logging
import threading
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from palpate.files import write_atomically
from palpate_client.wire import Flags
from palpate_server.realtime import scheduler
from palpate_server.realtime.records import RECORDS
from palpate_server.realtime.shared_memory import Integers, Memory

log = logging.getLogger("palpate_server")

KEPT_TICKS = 2000
STORM_TICKS = 1000  # a storm of limits: in STORM_TICKS ticks
STORM_SHARE = 0.5  # this share of the ticks met a limit
MOST_FILES = 100  # in the life of a server
QUIET_S = 10.0  # between two files of one cause

_LIMITED = int(
    Flags.WORKSPACE_CLAMPED
    | Flags.SPEED_LIMITED
    | Flags.SLEW_LIMITED
    | Flags.FORCE_CLAMPED
    | Flags.PASSIVITY_LIMITED
)


class BlackBox:
    """Looks at new ticks each time `examine` is called (some times a second) and writes a file when there is cause.

    Causes: `fault` (a force was not finite), `stale` (a client that holds a tool fell silent, and its force had to fade to
    zero), `lost` (a client that held a tool was killed or cut off), `limits` (half of the last second's ticks met a limit).
    One file of each cause in QUIET_S. A file holds `tools`, their names, and the records of the ring: `ticks` (records.TICK)
    and `ports` (records.PORT_RECORD).
    """

    def __init__(self, folder: Path, session: str, tools: Sequence[str], memory: Memory) -> None:
        self.folder = folder
        self.session = session
        self.tools = list(tools)
        self.memory = memory  # its ring stays the same when the model is exchanged
        self._seen = 0
        self._lost_clients = self._lost_written = 0
        self._files = 0
        self._last_file_s: dict[str, float] = {}

    def examine(self, lost_clients: int = 0) -> threading.Thread | None:
        """Look at the ticks since the last call. Returns the thread that writes a file, if there is cause; lost_clients: how many so far."""
        head = int(scheduler.records_written(self.memory.shared))
        first = max(self._seen, head - RECORDS // 2, 0)
        cause = self._cause(first, head, lost_clients)
        self._seen = head
        now = time.monotonic()
        if cause is None or self._files == MOST_FILES:
            return None
        if now - self._last_file_s.get(cause, -np.inf) < QUIET_S:
            return None
        self._files += 1
        if self._files == MOST_FILES:
            log.warning("black box: %d files, no more are written until the next start", MOST_FILES)
        self._last_file_s[cause] = now
        thread = threading.Thread(target=self._write, args=(cause, head), name="black box", daemon=True)
        thread.start()
        return thread

    def _cause(self, first: int, head: int, lost_clients: int) -> str | None:
        flags = self._column("flags", first, head)
        if np.any(flags & int(Flags.FAULT)):
            return "fault"
        was_lost, self._lost_clients = self._lost_clients > self._lost_written, lost_clients
        if was_lost:  # noticed at the last call, so that these ticks hold the fading of the force
            self._lost_written = self._lost_clients
            return "lost"
        if first == head:
            return None
        before = self._column("flags", first - 1, head - 1) if first else np.full_like(flags, Flags.STALE)
        became_stale = (flags & int(Flags.STALE) > 0) & (before & int(Flags.DECAYING) > 0)
        if np.any(became_stale & (self._column("sequence", first, head) >= 0)):  # not one that was released
            return "stale"
        recent = self._column("flags", max(0, head - STORM_TICKS), head)
        if len(recent) == STORM_TICKS and np.mean(np.any(recent & _LIMITED, axis=1)) >= STORM_SHARE:
            return "limits"
        return None

    def _column(self, name: str, first: int, last: int) -> Integers:
        """(ticks, n_tools)"""
        column: Integers = self.memory.ring.ports[name][np.arange(first, last) % RECORDS]
        return column

    def _write(self, cause: str, head: int) -> None:
        ticks = np.arange(max(0, head - KEPT_TICKS), head)
        rows = ticks % RECORDS
        ring = self.memory.ring
        path = self.folder / f"palpate-{self.session}-tick{head}-{cause}.npz"
        try:
            buffer = io.BytesIO()
            np.savez(buffer, tools=np.array(self.tools), ticks=ring.ticks[rows], ports=ring.ports[rows])
            write_atomically(path, buffer.getvalue())
        except OSError as error:
            log.warning("black box %s could not be written: %s", path, error)
        else:
            log.warning("%s: the last %d ticks are in %s", cause, len(ticks), path)
