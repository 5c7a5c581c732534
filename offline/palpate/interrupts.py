"""Ctrl-C: one line and exit code 130, also while libraries are imported.

Some libraries catch every exception around their own imports, KeyboardInterrupt among them, and go on. By default the process
therefore ends inside the signal handler. Work that needs to clean up gets the exception, within `raised`.
"""

import os
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager

EXIT_INTERRUPTED = 130  # 128 + SIGINT, as shells have it
_LINE = b"palpate: interrupted\n"

_raises = False
_was_asked = False


def install() -> None:
    """Install the handler of SIGINT, unless the signal is ignored, as in the background of a script."""
    if signal.getsignal(signal.SIGINT) is not signal.SIG_IGN:
        signal.signal(signal.SIGINT, _on_interrupt)


@contextmanager
def raised() -> Iterator[None]:
    """Within, the first Ctrl-C raises KeyboardInterrupt, so that files and processes are cleaned up."""
    global _raises
    _raises = True
    try:
        yield
        check()
    finally:
        _raises = False


@contextmanager
def ends_at_once() -> Iterator[None]:
    """Within `raised`, around an import: Ctrl-C ends the process inside the signal handler."""
    global _raises
    _raises = False
    try:
        yield
    finally:
        _raises = True


def check() -> None:
    """Raise KeyboardInterrupt if an earlier one was caught by a library. Called between the stages of long work."""
    if _was_asked:
        raise KeyboardInterrupt


def leave(code: int) -> None:
    """Exit with `code`. SIGINT is ignored from here on: the command has ended."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    sys.exit(code)


def end() -> int:
    """Print that the command was interrupted; returns the exit code."""
    sys.stdout.flush()
    os.write(2, _LINE)
    return EXIT_INTERRUPTED


def _on_interrupt(number: int, frame: object) -> None:
    global _was_asked
    if _raises and not _was_asked:
        _was_asked = True
        raise KeyboardInterrupt
    os.write(2, _LINE)
    os._exit(EXIT_INTERRUPTED)
