"""A recording of the running server: sends ticks, settings and status through a pipe to a process that writes the file.

It can't delay the loop. A thread of its own copies the ticks from the loop's ring every PERIOD_S and never blocks on the pipe. If
the process falls too far behind or ends (a full disk), the recording ends and the server continues.
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

LEAST_BYTES = 2**20  # a recording with less room is refused
PERIOD_S = 0.05
MAX_UNWRITTEN_BYTES = 16 * 2**20  # half a minute of one tool
END_S = 25.0  # to write the rest and complete the file; on a busy machine the process gets little time
_EXIT_S = 1.0  # until a process that has closed its pipe must have ended
_PIPE_BYTES = 65536  # capacity of a pipe
_TOO_SLOW = "it can't be written as fast as it comes"


def file_in(folder: Path, name: object) -> Path:
    """The path of a recording. Raises Refused unless `name` is a plain, printable name of an MCAP file."""
    if not is_plain_name(name) or not name.isprintable() or not name.endswith(".mcap") or name == ".mcap":
        raise Refused(
            "bad_file",
            f"file is {str(name)[:300]!r}: expected the name of a new file, NAME.mcap, printable, without a folder and "
            f"of at most {LONGEST_NAME_BYTES} bytes",
        )
    return folder / name


def room_in(folder: Path, max_bytes: int) -> int:
    """How many bytes a new recording may have. Raises Refused if less than LEAST_BYTES are left."""
    used = sum(entry.stat(follow_symlinks=False).st_size for entry in os.scandir(folder))
    if max_bytes - used < LEAST_BYTES:
        raise Refused("full", f"{FULL}: {used} of {max_bytes} bytes; remove old recordings")
    return max_bytes - used


class _EndedEarlyError(Exception):
    """The recording ended before it was asked to; the message says why."""


class Recorder:
    """One recording, until `stop`. Its ticks begin with the first settings that it is given.

    messages       how many are in the file
    missing_ticks  ticks that were overwritten before they were taken
    error          why it ended before it was asked to, or None
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

        save: has the loop save its state and calls `settings` with it, or raises Refused; called after missing ticks
        """
        self.file = path.name
        self.messages = 0
        self.missing_ticks = 0
        self.error: str | None = None
        self._keys = keys
        self._memory = memory  # its ring stays the same when the model is exchanged
        self._save = save
        self._next_tick: int | None = None
        self._queued: queue.SimpleQueue[tuple[str, int, bytes]] = queue.SimpleQueue()
        self._settings: dict[int, bytes] = {}  # by tick, until that tick is taken
        self._unwritten = bytearray()
        self._clock_offset_ns = time.time_ns() - time.monotonic_ns()
        self._ending = threading.Event()
        self._line = b""  # incomplete line from the process
        self._failure = ""
        self._add("describe", pack(description))
        self._process = _start(path, max_bytes)
        assert self._process.stdin is not None
        assert self._process.stderr is not None
        self._pipe = self._process.stdin.fileno()
        self._answers = self._process.stderr.fileno()
        for descriptor in (self._pipe, self._answers):
            os.set_blocking(descriptor, False)
        self._collecting = threading.Lock()
        self._thread = threading.Thread(target=self._run, name="recorder", daemon=True)
        self._thread.start()

    def settings(self, message: dict[str, Any]) -> None:
        """The state after a change, of `snapshot.as_message`; any thread may call this."""
        if self.error is None:
            self._queued.put(("settings", message["tick"], pack(message)))

    def status(self, payload: bytes) -> None:
        """Any thread may call this."""
        if self.error is None:
            self._queued.put(("status", 0, payload))

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
        except Exception as error:  # any error ends the recording and is reported
            self.error = str(error)
            log.warning("recording %s has ended: %s", self.file, error)
        finally:
            self._close_pipe()
            self._process.poll()

    def collect(self) -> None:
        """Copy the new ticks from the ring, each settings message before its first tick.

        The recorder's thread calls this every PERIOD_S; any other thread may, too.
        """
        with self._collecting:
            while not self._queued.empty():
                kind, tick, payload = self._queued.get_nowait()
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
        # The loop has run meanwhile: some of the oldest rows may hold newer ticks already.
        oldest = max(self._next_tick, int(scheduler.records_written(shared)) - RECORDS + 1)
        if missing := min(oldest, head) - self._next_tick:
            self.missing_ticks += missing
            log.warning("recording %s: %d ticks were not taken in time", self.file, missing)
            self._settings = {tick: kept for tick, kept in self._settings.items() if tick >= oldest}
        first = max(0, min(oldest, head) - int(numbers[0])) if len(numbers) else 0
        self._next_tick = head - self._add_ticks(ticks[first:], ports[first:])
        if missing:
            with contextlib.suppress(Refused):  # the server is stopping, or no tick comes
                self._save()

    def _add_ticks(self, ticks: Records, ports: Records) -> int:
        """Add ticks, each settings message before its first tick. Returns how many ticks wait for settings that have not come yet."""
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
        """Write to the pipe what it takes within `seconds`."""
        give_up = time.monotonic() + seconds
        while self._unwritten and _takes_more(self._pipe, give_up - time.monotonic()):
            try:
                written = os.write(self._pipe, self._unwritten[:_PIPE_BYTES])
            except BrokenPipeError:
                raise _EndedEarlyError(self._why_it_ended()) from None
            del self._unwritten[:written]
        self._read_answers()

    def _read_answers(self) -> None:
        """Read the lines that the process wrote: the number of messages in the file, or what went wrong."""
        with contextlib.suppress(BlockingIOError):
            while text := os.read(self._answers, _PIPE_BYTES):
                *lines, self._line = (self._line + text).split(b"\n")
                for line in lines:
                    if line.isdigit():
                        self.messages = int(line)
                    else:
                        self._failure = line.decode(errors="replace")

    def _finish(self) -> None:
        give_up = time.monotonic() + END_S
        self._write(END_S)
        if self._unwritten:
            raise _EndedEarlyError(_TOO_SLOW)
        self._close_pipe()
        try:
            code = self._process.wait(max(0.1, give_up - time.monotonic()))
        except subprocess.TimeoutExpired:
            raise _EndedEarlyError("the file could not be completed in time") from None
        self._read_answers()
        if code != 0:
            raise _EndedEarlyError(self._why_it_ended())

    def _why_it_ended(self) -> str:
        try:
            code = self._process.wait(_EXIT_S)
        except subprocess.TimeoutExpired:
            return "its process has closed the pipe and does not end"
        self._read_answers()
        return self._failure or f"its process ended with code {code}"

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
