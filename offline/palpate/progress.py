"""Progress of a long computation."""

from __future__ import annotations

from typing import Protocol


class Progress(Protocol):
    """Called with the name of each stage as it begins."""

    def __call__(self, stage: str, /) -> None: ...

    def note(self, text: str) -> None:
        """The result of the stage so far, in a few words."""

    def warn(self, text: str) -> None:
        """A sentence the user should read: what is unusual, and what was probably meant."""


class _NoProgress:
    def __call__(self, stage: str) -> None:
        pass

    def note(self, text: str) -> None:
        pass

    def warn(self, text: str) -> None:
        pass


class Warnings(_NoProgress):
    """Keeps the warnings and shows nothing."""

    def __init__(self) -> None:
        self.texts: list[str] = []

    def warn(self, text: str) -> None:
        self.texts.append(text)


NO_PROGRESS: Progress = _NoProgress()
"""Shows nothing."""
