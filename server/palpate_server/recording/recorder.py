"""A recording that the server makes of itself: ticks, settings and status, handed through a pipe to a process that writes.

Nothing of it can hold the loop up. A thread of its own takes the ticks out of the loop's ring, some times a second, and
never waits for the pipe. When the process falls too far behind or ends (a full disk), the recording is over and the server
goes on.
"""

from __future__ import annotations

import contextlib
import logging
import os
import queue
import select
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgpack
import numpy as np

from palpate.files import LONGEST_NAME_BYTES, is_plain_name
from palpate_client.wire import Keys, pack
from palpate_server.errors import Refused
from palpate_server.realtime import scheduler
from palpate_server.realtime.records import RECORDS
from palpate_server.realtime.shared_memory import Memory, Records
from palpate_server.recording.json_records import FULL

log = logging.getLogger("palpate_server")

LEAST_BYTES = 2**20  # room for a recording worth the name
PERIOD_S = 0.05
MAX_UNWRITTEN_BYTES = 16 * 2**20  # bytes: half a minute of a tool
END_S = 8.0  # to write the rest and end the file: on a busy machine its process is last in the queue
_LAST_WORDS_S = 1.0  # of a process that has closed its pipe
_PIPE_BYTES = 65536  # that a pipe takes at once
_TOO_SLOW = "it can't be written as fast as it comes"


def file_in(folder: Path, name: object) -> Path:
    """Where a client's recording goes. Raises Refused when that is no plain, printable name of an MCAP file."""
    if not is_plain_name(name) or not name.isprintable() or not name.endswith(".mcap") or name == ".mcap":
        raise Refused(
            "bad_file",
            f"file is {str(name)[:300]!r}: expected the name of a new file, NAME.mcap, printable, without a folder and "
            f"of at most {LONGEST_NAME_BYTES} bytes",
        )
    return folder / name


def room_in(folder: Path, max_bytes: int) -> int:
    """How many bytes a new recording may have. Raises Refused when that is too few."""
    used = sum(entry.stat(follow_symlinks=False).st_size for entry in os.scandir(folder))
    if max_bytes - used < LEAST_BYTES:
        raise Refused("full", f"{FULL}: {used} of {max_bytes} bytes; remove old recordings")
    return max_bytes - used


class _EndedEarlyError(Exception):
    """The recording is over before it was asked to be; the message says why."""


class Recorder:
    """One recording, from its making to `stop`. Its ticks begin with the first settings that it is given.

    messages       how many are in the file
    missing_ticks  ticks that were overwritten before they were taken
    error          why it has ended before it was asked to, or None
    """

    def __init__(
        self,
        path: Path,
        max_bytes: int,
        keys: Keys,
        description: dict[str, Any],
        memory: Memory,
        save: Callable[[], object],
    ) -> None:
        """A new file of at most `max_bytes`. Raises Refused when the file exists or can't be made.

        save: has the loop save its state and `settings` called with it, or raises Refused; called after missing ticks
        """
        self.file = path.name
        self.messages = 0
        self.missing_ticks = 0
        self.error: str | None = None
        self._keys = keys
        self._memory = memory  # its ring stays the same when the model is exchanged
        self._save = save
        self._next_tick: int | None = None
        self._told: queue.SimpleQueue[tuple[str, int, bytes]] = queue.SimpleQueue()
        self._settings: dict[int, bytes] = {}  # by tick, until that tick is taken
        self._unwritten = bytearray()
        self._clock_offset_ns = time.time_ns() - time.monotonic_ns()
        self._ending = threading.Event()
        self._line = b""  # of the process, not complete yet
        self._last_words = ""
        self._add("describe", pack(description))
        self._process = _start(path, max_bytes)
        assert self._process.stdin is not None
        assert self._process.stderr is not None
        self._pipe = self._process.stdin.fileno()
        self._answers = self._process.stderr.fileno()
        for descriptor in (self._pipe, self._answers):
            os.set_blocking(descriptor, False)
        self._thread = threading.Thread(target=self._run, name="recorder", daemon=True)
        self._thread.start()

    def settings(self, message: dict[str, Any]) -> None:
        """The state after a change, of `snapshot.as_message`; any thread may call this."""
        if self.error is None:
            self._told.put(("settings", message["tick"], pack(message)))

    def status(self, payload: bytes) -> None:
        """Any thread may call this."""
        if self.error is None:
            self._told.put(("status", 0, payload))

    def stop(self) -> None:
        """Write what is left and end the file, in a few seconds at most; `report` is then final."""
        self._ending.set()
        self._thread.join()

    def report(self) -> dict[str, Any]:
        return {
            "file": self.file,
            "messages": self.messages,
            "missing_ticks": self.missing_ticks,
            "error": self.error,
        }

    def _run(self) -> None:
        try:
            while not self._ending.wait(PERIOD_S):
                self.collect()
                self._write(PERIOD_S)
                if len(self._unwritten) > MAX_UNWRITTEN_BYTES:
                    raise _EndedEarlyError(_TOO_SLOW)
            self.collect()
            self._finish()
        except Exception as error:  # whatever it was: the recording is over, and says so
            self.error = str(error)
            log.warning("recording %s has ended: %s", self.file, error)
        finally:
            self._close_pipe()
            self._process.poll()

    def collect(self) -> None:
        """Take what is new out of the ring; its thread does each PERIOD_S. Settings stand before the first tick with them."""
        while not self._told.empty():
            kind, tick, payload = self._told.get_nowait()
            if kind == "settings":
                self._settings[tick] = payload
                if self._next_tick is None:
                    self._next_tick = tick
            else:
                self._add(kind, payload)
        self._take_ticks()

    def _take_ticks(self) -> None:
        if self._next_tick is None:
            return
        ring, shared = self._memory.ring, self._memory.shared
        head = int(scheduler.records_written(shared))
        numbers = np.arange(max(self._next_tick, head - RECORDS), head)
        ticks, ports = ring.ticks[numbers % RECORDS], ring.ports[numbers % RECORDS]
        # The loop went on meanwhile: of the oldest rows some may be another tick's already.
        oldest = max(self._next_tick, int(scheduler.records_written(shared)) - RECORDS + 1)
        if missing := min(oldest, head) - self._next_tick:
            self.missing_ticks += missing
            log.warning("recording %s: %d ticks were not taken in time", self.file, missing)
            self._settings = {tick: kept for tick, kept in self._settings.items() if tick >= oldest}
        first = max(0, min(oldest, head) - int(numbers[0])) if len(numbers) else 0
        self._next_tick = head - self._add_ticks(ticks[first:], ports[first:])
        if missing:
            with contextlib.suppress(Refused):  # the server stops, or no tick comes
                self._save()

    def _add_ticks(self, ticks: Records, ports: Records) -> int:
        """Hand ticks over, settings before their first tick; how many wait for settings that are not here yet."""
        begin = 0
        changed = np.flatnonzero(ticks["change"]).tolist()
        for place in [*changed, len(ticks)]:
            if place > begin:
                part = ("ticks", self._key("tick"), self._clock_offset_ns)
                self._unwritten += msgpack.packb(
                    (*part, ticks[begin:place].tobytes(), ports[begin:place].tobytes())
                )
                begin = place
            if place < len(ticks):
                settings = self._settings.pop(int(ticks["tick"][place]), None)
                if settings is None:
                    return len(ticks) - place
                self._add("settings", settings)
        return 0

    def _add(self, kind: str, payload: bytes) -> None:
        now_ns = time.monotonic_ns() + self._clock_offset_ns
        self._unwritten += msgpack.packb(("message", kind, self._key(kind), now_ns, payload))

    def _key(self, kind: str) -> str:
        return f"{self._keys.prefix}/{kind}"

    def _write(self, seconds: float) -> None:
        """Hand over what the pipe takes in this time."""
        give_up = time.monotonic() + seconds
        while self._unwritten and _takes_more(self._pipe, give_up - time.monotonic()):
            try:
                written = os.write(self._pipe, self._unwritten[:_PIPE_BYTES])
            except BrokenPipeError:
                raise _EndedEarlyError(self._why_it_ended()) from None
            del self._unwritten[:written]
        self._hear()

    def _hear(self) -> None:
        """Read the lines of the process: how many messages are in the file, or what went wrong."""
        with contextlib.suppress(BlockingIOError):
            while text := os.read(self._answers, _PIPE_BYTES):
                *lines, self._line = (self._line + text).split(b"\n")
                for line in lines:
                    if line.isdigit():
                        self.messages = int(line)
                    else:
                        self._last_words = line.decode(errors="replace")

    def _finish(self) -> None:
        give_up = time.monotonic() + END_S
        self._write(END_S)
        if self._unwritten:
            raise _EndedEarlyError(_TOO_SLOW)
        self._close_pipe()
        try:
            code = self._process.wait(max(0.1, give_up - time.monotonic()))
        except subprocess.TimeoutExpired:
            raise _EndedEarlyError("its end is still being written") from None
        self._hear()
        if code != 0:
            raise _EndedEarlyError(self._why_it_ended())

    def _why_it_ended(self) -> str:
        try:
            code = self._process.wait(_LAST_WORDS_S)
        except subprocess.TimeoutExpired:
            return "its process no longer listens"
        self._hear()
        return self._last_words or f"its process ended with code {code}"

    def _close_pipe(self) -> None:
        assert self._process.stdin is not None
        self._process.stdin.close()


def _start(path: Path, max_bytes: int) -> subprocess.Popen[bytes]:
    """The process that writes a new file. Raises Refused."""
    try:
        with path.open("xb") as stream:
            return subprocess.Popen(
                [sys.executable, "-m", "palpate_server.recording.mcap_file", str(max_bytes)],
                stdin=subprocess.PIPE,
                stdout=stream,
                stderr=subprocess.PIPE,
                bufsize=0,
                start_new_session=True,  # Ctrl-C is for the server
            )
    except FileExistsError:
        raise Refused("exists", f"{path.name} exists: expected the name of a new file") from None
    except OSError as error:
        raise Refused("bad_file", f"{path.name} can't be recorded to: {error.strerror}") from error


def _takes_more(pipe: int, seconds: float) -> bool:
    return bool(select.select([], [pipe], [], max(0.0, seconds))[1])
