"""Progress of long work on a terminal or in a log: a line for each stage once it is done, with its time."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TextIO

from palpate import interrupts


class Stages:
    """Call it with a stage's name when the stage begins; `note` adds its result, `warn` prints a warning."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream
        self._is_terminal = stream.isatty()
        self._name: str | None = None
        self._note = ""
        self._start = 0.0

    def __call__(self, name: str) -> None:
        self.stop()
        interrupts.check()
        self._name, self._note, self._start = name, "", time.monotonic()
        self._show()

    def note(self, text: str) -> None:
        self._note = text
        self._show()

    def warn(self, text: str) -> None:
        self._clear()
        print(f"warning: {text}", file=sys.stderr, flush=True)
        self._show()

    def stop(self, failed: bool = False) -> None:
        if self._name is not None:
            self._clear()
            mark, elapsed = "✗" if failed else "✓", time.monotonic() - self._start
            self._print(f"{mark} {elapsed:6.1f} s  {self._name}  {self._note}".rstrip() + "\n")
            self._name = None

    def _show(self) -> None:
        """The stage that runs, on a line that the next output replaces."""
        if self._is_terminal and self._name is not None:
            self._clear()
            self._print(f"{self._name} ... {self._note}"[:78])

    def _clear(self) -> None:
        if self._is_terminal:
            self._print("\r\x1b[2K")

    def _print(self, text: str) -> None:
        print(text, end="", file=self._stream, flush=True)


@contextmanager
def stage_reporter(to_stderr: bool = False) -> Iterator[Stages]:
    """Stages whose last one is marked as failed if an exception leaves the block; on standard output unless `to_stderr`."""
    stages = Stages(sys.stderr if to_stderr else sys.stdout)
    try:
        yield stages
    except BaseException:
        stages.stop(failed=True)
        raise
    stages.stop()
