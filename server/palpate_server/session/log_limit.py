"""The server's log: no peer can fill it, or send control characters to a terminal through it."""

from __future__ import annotations

import logging
import sys
import threading
import time

from palpate.files import printable

MOST_LINES, PER_SECONDS = 5, 10.0  # of one kind


class RateLimit(logging.Filter):
    """Lets MOST_LINES records of one kind pass in PER_SECONDS; the next one that passes says how many did not.

    Of one kind are records with the same text before its arguments are filled in.
    """

    def __init__(self) -> None:
        super().__init__()
        self._lock = threading.Lock()
        self._kinds: dict[str, tuple[float, int]] = {}  # begin of the interval (s), records in it

    def filter(self, record: logging.LogRecord) -> bool:
        kind, now = str(record.msg), time.monotonic()
        with self._lock:
            begin, count = self._kinds.get(kind, (now, 0))
            missed = 0
            if now - begin >= PER_SECONDS:
                missed = max(0, count - MOST_LINES)
                begin, count = now, 0
            self._kinds[kind] = (begin, count + 1)
        if count >= MOST_LINES:
            return False
        if missed:
            record.msg = f"{record.msg} ({missed} more of this kind were not logged)"
        return True


class OneLine(logging.Formatter):
    """Formats a message on one line, what can't be printed escaped; a traceback follows on lines of its own."""

    def formatMessage(self, record: logging.LogRecord) -> str:
        return printable(super().formatMessage(record))

    def formatException(self, ei: object) -> str:
        return "\n".join(map(printable, super().formatException(ei).splitlines()))  # type: ignore[arg-type]


def set_up() -> None:
    """Log to standard error, limited; also what Zenoh's Python binding says of exceptions in callbacks."""
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(OneLine("%(message)s"))
    handler.addFilter(RateLimit())
    logging.basicConfig(level=logging.INFO, handlers=[handler])
