"""Progress of long work on a terminal or in a log: a line for each stage once it is done, with its time."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager

from palpate import interrupts


class Stages:
    """Call it with a stage's name when the stage begins; `note` adds its result, `warn` prints a warning."""

    def __init__(self) -> None:
        self._is_terminal = sys.stdout.isatty()
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
            print(f"{mark} {elapsed:6.1f} s  {self._name}  {self._note}".rstrip(), flush=True)
            self._name = None

    def _show(self) -> None:
        """The stage that runs, on a line that the next output replaces."""
        if self._is_terminal and self._name is not None:
            self._clear()
            print(f"{self._name} ... {self._note}"[:78], end="", flush=True)

    def _clear(self) -> None:
        if self._is_terminal:
            print("\r\x1b[2K", end="", flush=True)


@contextmanager
def stage_reporter() -> Iterator[Stages]:
    """Stages whose last one is marked as failed if an exception leaves the block."""
    stages = Stages()
    try:
        yield stages
    except BaseException:
        stages.stop(failed=True)
        raise
    stages.stop()
