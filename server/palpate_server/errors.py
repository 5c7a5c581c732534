"""Errors that more than one room of the server raises."""

from __future__ import annotations


class Refused(Exception):
    """A request that is not granted.

    reason  one of palpate_client.wire.NOT_GRANTED; the message says it in words
    """

    def __init__(self, reason: str, message: str) -> None:
        super().__init__(message)
        self.reason = reason
