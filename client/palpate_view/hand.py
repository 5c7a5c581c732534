"""The mouse as a device: takes a tool while something is dragged, moves it, and lets it go.

A thread of its own sends commands. They carry the velocity, with which the server carries a motion on for 5 ms; so a command
each 4 ms moves the tool in every tick. The page's callbacks only say where the tool is to go.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from palpate_client import ClientError, Connection, Tool
from palpate_view.motion import Floats, Gesture, Motion, at_home, follow

COMMAND_PERIOD_S = 0.004
LONGEST_SILENCE_S = 2.0  # of the page: also a browser that draws in software on a busy machine answers sooner


@dataclass(frozen=True)
class Grip:
    """What is asked of `acquire`: a tool, of which page, and for a surface model its radius, m, and friction."""

    page: int
    tool: str
    radius_m: float | None = None
    friction: float | None = None


class _LetGo(Exception):
    """Leaves a tool's `with` statement at once; without an exception it waits for the answers to the last commands."""


class Hand:
    """Holds a tool of a connection from `take` to `let_go`. Call `take`, `aim`, `sign` and `let_go` from any thread.

    tell(text, page) is called with what the user of a page has to know, such as that another client holds the tool. A warning of the
    server is told once.
    """

    def __init__(self, connection: Connection, tell: Callable[[str, int], None]) -> None:
        self._connection = connection
        self._tell = tell
        self._lock = threading.Condition()
        self._grip: Grip | None = None
        self._gesture: Gesture | None = None
        self._sign_s = 0.0
        self._warned: set[str] = set()
        self._ended = False
        # Of the newest command, in the model's frame; None while no tool is held.
        self.position_m: Floats | None = None
        self.normal: Floats | None = None
        self._thread = threading.Thread(target=self._run, name="hand", daemon=True)
        self._thread.start()

    @property
    def grip(self) -> Grip | None:
        return self._grip

    @property
    def ended(self) -> bool:
        return self._ended

    def take(self, grip: Grip, gesture: Gesture) -> bool:
        """Hold a tool. False if another page has it, or after `end`."""
        with self._lock:
            if self._ended or (self._grip is not None and self._grip.page != grip.page):
                return False
            self._grip, self._gesture, self._sign_s = grip, gesture, time.monotonic()
            self._lock.notify()
            return True

    def aim(self, page: int, change: Callable[[Gesture], Gesture]) -> None:
        """Change where the tool is to go; nothing if this page does not hold it."""
        with self._lock:
            if self._grip is not None and self._grip.page == page and self._gesture is not None:
                self._gesture = change(self._gesture)
                self._sign_s = time.monotonic()

    def sign(self, page: int) -> None:
        """A sign of life of a page."""
        with self._lock:
            if self._grip is not None and self._grip.page == page:
                self._sign_s = time.monotonic()

    def let_go(self, page: int) -> None:
        """Let the tool go if this page holds it."""
        with self._lock:
            if self._grip is not None and self._grip.page == page:
                self._grip = None
                self._lock.notify()

    def end(self) -> None:
        """Let the tool go, and end the thread."""
        with self._lock:
            self._grip, self._ended = None, True
            self._lock.notify()
        self._thread.join()

    def _run(self) -> None:
        while True:
            with self._lock:
                self._lock.wait_for(lambda: self._ended or self._grip is not None)
                grip = self._grip
            if grip is None:
                return
            try:
                self._hold(grip)
            except _LetGo:
                pass
            except (ClientError, ValueError, RuntimeError) as error:
                self._tell(str(error), grip.page)
            self.position_m = self.normal = None
            with self._lock:
                if self._grip is grip:
                    self._grip = None

    def _hold(self, grip: Grip) -> None:
        """Move the tool until it is let go. Raises _LetGo then, and what `Tool` raises."""
        with Tool(self._connection, grip.tool, radius_m=grip.radius_m, friction=grip.friction) as tool:
            for warning in tool.warnings:
                if warning not in self._warned:
                    self._warned.add(warning)
                    self._tell(warning, grip.page)
            home = np.asarray(tool.home_m)
            self.aim(grip.page, lambda gesture: at_home(gesture, home))
            begun = self._gesture
            if begun is None or begun.start_m is None:
                raise _LetGo
            away_m, farthest_m = (
                float(np.linalg.norm(begun.start_m - home)),
                tool.limits["workspace_radius_m"],
            )
            if away_m > farthest_m:
                self._tell(
                    f"This is {1e3 * away_m:.0f} mm from where the tool starts: the server's workspace ends at "
                    f"{1e3 * farthest_m:.0f} mm (`palpate serve --workspace-m`).",
                    grip.page,
                )
                raise _LetGo
            self._move(grip, tool, Motion(begun.start_m, np.zeros(3)))
            raise _LetGo

    def _move(self, grip: Grip, tool: Tool, motion: Motion) -> None:
        """Send commands until the tool is let go or the page is silent."""
        due_s = last_s = time.monotonic()
        arrived = False
        while self._grip is grip and (gesture := self._gesture) is not None:
            now_s = time.monotonic()
            if now_s - self._sign_s > LONGEST_SILENCE_S:
                self._tell("The page was silent, so the tool was let go.", grip.page)
                return
            # A tool that is far away jumps here, and touches nothing until its force has faded in.
            arrived = arrived or (tool.newest is not None and tool.newest.force_scale >= 1.0)
            if arrived:
                motion = follow(motion, gesture.target_m, now_s - last_s)
            last_s = now_s
            if gesture.attach:
                tool.attach()
            tool.move(motion.position_m.tolist(), motion.velocity_m_per_s.tolist())
            self.position_m, self.normal = motion.position_m, gesture.normal
            due_s = max(due_s + COMMAND_PERIOD_S, now_s)
            with self._lock:
                self._lock.wait_for(
                    lambda: self._grip is not grip, timeout=max(0.0, due_s - time.monotonic())
                )
