"""A recording that the server makes of itself: what it hears and computes, handed through a pipe to a process that writes.

Nothing of it can hold the loop up. The thread that receives commands leaves each in a queue; a thread of its own takes
them, and the ticks out of the loop's ring, some times a second, and never waits for the pipe. When the process falls too
far behind or ends (a full disk), the recording is over and the server goes on.
"""

from __future__ import annotations

import logging
import os
import queue
import select
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

import msgpack
import numpy as np

from palpate.files import LONGEST_NAME_BYTES, is_plain_name
from palpate_client import wire
from palpate_server.realtime import scheduler, shared_memory
from palpate_server.session.leases import Refused
from palpate_server.wire import ForceEncoder

log = logging.getLogger("palpate_server")

_PERIOD_S = 0.05
_MAX_UNWRITTEN = 16 * 2**20  # bytes: a minute of a contact
_END_S = 8.0  # to write the rest and end the file: on a busy machine its process is last in the queue
_LAST_WORDS_S = 1.0  # of a process that has closed its pipe
_PIPE_BYTES = 65536  # that a pipe takes at once
_TOO_SLOW = "it can't be written as fast as it comes"


def file_in(folder: Path, name: object) -> Path:
    """Where a client's recording goes. Raises Refused when that is no plain name of an MCAP file."""
    if not is_plain_name(name) or not name.endswith(".mcap"):
        raise Refused(
            "bad_file",
            f"file is {str(name)[:300]!r}: expected the name of a new file, NAME.mcap, without a folder and of at "
            f"most {LONGEST_NAME_BYTES} bytes",
        )
    return folder / name


class _EndedEarlyError(Exception):
    """The recording is over before it was asked to be; the message says why."""


class Recorder:
    """One recording, from its making to `stop`."""

    def __init__(
        self, path: Path, keys: wire.Keys, description: dict[str, Any], memory: shared_memory.Memory
    ) -> None:
        """Raises Refused when the file exists or can't be made, or its process can't be started."""
        self.file = path.name
        self.messages = 0  # handed over
        self.missing_ticks = 0
        self.error: str | None = None
        self._keys = keys
        self._memory = memory  # its ring stays the same when the model is exchanged
        self._encoder = ForceEncoder(len(memory.scale))
        self._next_tick = int(scheduler.records_written(memory.shared))
        self._heard: queue.SimpleQueue[tuple[int, str, str, bytes]] = queue.SimpleQueue()
        self._waiting: list[tuple[int, str, str, bytes]] = []
        self._unwritten = bytearray()
        self._wall_clock_ns = time.time_ns() - time.monotonic_ns()
        self._ending = threading.Event()
        self._hand_over(time.monotonic_ns(), "describe", keys.describe, wire.pack(description))
        try:
            with path.open("xb") as stream:
                self._process = subprocess.Popen(
                    [sys.executable, "-m", "palpate_server.recording.mcap_file"],
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
        assert self._process.stdin is not None
        self._pipe = self._process.stdin.fileno()
        os.set_blocking(self._pipe, False)
        self._thread = threading.Thread(target=self._run, name="recorder", daemon=True)
        self._thread.start()

    def command(self, key: str, payload: bytes) -> None:
        """A command that came now; for the thread that receives them, before the tick that may use it."""
        if self.error is None:
            self._put("command", key, payload)

    def status(self, payload: bytes) -> None:
        if self.error is None:
            self._put("status", self._keys.status, payload)

    def stop(self) -> None:
        """Write what is left and end the file, in a few seconds at most; `report` then is the last word."""
        self._ending.set()
        self._thread.join()

    def report(self) -> dict[str, Any]:
        return {
            "file": self.file,
            "messages": self.messages,
            "missing_ticks": self.missing_ticks,
            "error": self.error,
        }

    def _put(self, kind: str, key: str, payload: bytes) -> None:
        self._heard.put((time.monotonic_ns(), kind, key, payload))

    def _run(self) -> None:
        try:
            while not self._ending.wait(_PERIOD_S):
                self._collect()
                self._write(_PERIOD_S)
                if len(self._unwritten) > _MAX_UNWRITTEN:
                    raise _EndedEarlyError(_TOO_SLOW)
            self._collect(everything=True)
            self._finish()
        except Exception as error:  # whatever it was: the recording is over, and says so
            self.error = str(error)
            log.warning("recording %s has ended: %s", self.file, error)
        finally:
            self._close_pipe()

    def _collect(self, everything: bool = False) -> None:
        """Take what is new, in the order of time: a command stands before the tick that used it."""
        ticks = self._take_ticks()
        last_tick_ns = ticks[-1][0] if ticks else 0
        self._waiting += ticks
        while not self._heard.empty():
            self._waiting.append(self._heard.get_nowait())
        self._waiting.sort(key=lambda message: message[0])
        count = 0  # what is younger than the last tick waits for the ticks that came meanwhile
        for time_ns, kind, key, payload in self._waiting:
            if time_ns > last_tick_ns and not everything:
                break
            self._hand_over(time_ns, kind, key, payload)
            count += 1
        del self._waiting[:count]

    def _hand_over(self, time_ns: int, kind: str, key: str, payload: bytes) -> None:
        self._unwritten += msgpack.packb((kind, key, time_ns + self._wall_clock_ns, payload))
        self.messages += 1

    def _take_ticks(self) -> list[tuple[int, str, str, bytes]]:
        memory = self._memory
        head = int(scheduler.records_written(memory.shared))
        ticks = np.arange(max(self._next_tick, head - shared_memory.RECORDS), head)
        rows = ticks % shared_memory.RECORDS
        starts = memory.record_times[rows, shared_memory.START_NS].tolist()
        inputs, motion = memory.record_inputs[rows], memory.record_motion[rows]
        # The loop went on meanwhile: of the oldest rows some may be another tick's already.
        oldest = int(scheduler.records_written(memory.shared)) - shared_memory.RECORDS + 1
        taken = [
            (start, "force", self._keys.force, self._encoder.encode(tick, start, inputs[k], motion[k]))
            for k, (tick, start) in enumerate(zip(ticks.tolist(), starts, strict=True))
            if tick >= oldest
        ]
        if missing := head - self._next_tick - len(taken):
            self.missing_ticks += missing
            log.warning("recording %s: %d ticks were not taken in time", self.file, missing)
        self._next_tick = head
        return taken

    def _write(self, seconds: float) -> None:
        """Hand over what the pipe takes in this time."""
        give_up = time.monotonic() + seconds
        while self._unwritten and _takes_more(self._pipe, give_up - time.monotonic()):
            try:
                written = os.write(self._pipe, self._unwritten[:_PIPE_BYTES])
            except BrokenPipeError:
                raise _EndedEarlyError(self._last_words()) from None
            del self._unwritten[:written]

    def _finish(self) -> None:
        give_up = time.monotonic() + _END_S
        self._write(_END_S)
        if self._unwritten:
            raise _EndedEarlyError(_TOO_SLOW)
        self._close_pipe()
        try:
            code = self._process.wait(max(0.1, give_up - time.monotonic()))
        except subprocess.TimeoutExpired:
            raise _EndedEarlyError("its end is still being written") from None
        if code != 0:
            raise _EndedEarlyError(self._last_words())

    def _last_words(self) -> str:
        """Why the process that writes has ended."""
        assert self._process.stderr is not None
        try:
            code = self._process.wait(_LAST_WORDS_S)
        except subprocess.TimeoutExpired:
            return "its process no longer listens"
        lines = self._process.stderr.read().decode(errors="replace").splitlines()
        return lines[-1] if lines else f"its process ended with code {code}"

    def _close_pipe(self) -> None:
        assert self._process.stdin is not None
        self._process.stdin.close()


def _takes_more(pipe: int, seconds: float) -> bool:
    return bool(select.select([], [pipe], [], max(0.0, seconds))[1])
