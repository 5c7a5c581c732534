"""A tool of a connection: acquire it, move it, take its force, release it."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Sequence
from typing import Any

from palpate_client.connection import Connection, Subscription, steps
from palpate_client.contract import Contract
from palpate_client.errors import ServerGone, ToolLost
from palpate_client.messages import Description, Force, Frame, Vector

NO_FORCE: Vector = (0.0, 0.0, 0.0)
SETTLE_S = 0.5  # until the server's deadlines follow our commands; a quarter of a second is enough
MEASURE_S = 1.0  # how long the round trip is measured
LAST_ANSWERS_S = 0.05  # wait for the answers to the last commands
FIRST_FORCE_S = 3.0  # longest wait for the first force


class Tool:
    """One tool of a connection; use it in a `with` statement, one at a time for each connection.

    Entering acquires the tool, leaving releases it.

    Parameters
    ----------
    name: the tool's name; without it, the model's first.
    frame: how the client's axes and unit relate to the model's.
    silence_s: `move` gives up when no force has come for this long.
    radius_m, friction: of the sphere, for a surface model; without them, the model file's. See "Tips" in docs/wire.md.
    stiffness_n_per_m: of the spring between device and sphere, for a surface model; without it, the most that the device renders.

    Attributes
    ----------
    home_m: (3,) where the tip touches the undeformed tissue without pressing, m, in the client's frame.
    normal: (3,) outward normal there, of length 1, in the client's frame.
    limits: the agreed limits by name; see "Limits" in docs/wire.md.
    warnings: the server's warnings, to be shown to the user.
    touches_anywhere: whether the model is one whose surface can be touched everywhere, from outside.
    contract: checks every force, and counts.

    `home_m`, `normal` and `touches_anywhere` are of the model that runs when the tool is acquired: while it is held, no other
    client can load another.
    """

    def __init__(
        self,
        connection: Connection,
        name: str | None = None,
        *,
        frame: Frame | None = None,
        silence_s: float = 1.0,
        radius_m: float | None = None,
        friction: float | None = None,
        stiffness_n_per_m: float | None = None,
    ) -> None:
        tools = connection.description.tools
        self.name = tools[0].name if name is None else name
        self.frame = frame or Frame()
        self.home_m: Vector = tools[connection.description.index(self.name)].start_m
        self._read_description(connection.description)
        self.limits: dict[str, float] = {}
        self.warnings: list[str] = []
        self.contract = Contract(connection.description)
        self.newest: Force | None = None  # the newest force that keeps the contract
        self._connection = connection
        self._silence_s = silence_s
        self._tip = {"radius_m": radius_m, "friction": friction, "stiffness_n_per_m": stiffness_n_per_m}
        self._since_s = time.monotonic()
        self._rendered_tick: int | None = None
        self._attached = False
        self._forces: Subscription = None
        self._sent = 0  # sequence of the newest command
        self._answered = threading.Event()  # that a force has come which knows of it

    def __enter__(self) -> Tool:
        """Raises Refused, ServerGone or Incompatible, and RuntimeError inside of another `with` statement of the connection's tools."""
        if self._connection.tool_in_use is not None:
            raise RuntimeError(
                f"the connection uses the tool {self._connection.tool_in_use!r}: leave its `with` statement first, "
                "or use a connection for each tool"
            )
        self._connection.tool_in_use = self.name
        try:
            self._acquire()
            self._forces = self._connection.on_tool_force(self.name, self._on_force)
        except BaseException:
            self._connection.tool_in_use = None
            raise
        return self

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        if error is None:
            time.sleep(LAST_ANSWERS_S)
        lost = not self.contract.holding
        self.contract.released()
        self._connection.tool_in_use = None
        try:
            self._forces.undeclare()
            self._connection.check()
            if not lost:
                self._connection.control("release")
        except Exception:
            if error is None:  # otherwise the first error is more useful
                raise

    def move(self, position_m: Sequence[float], velocity_m_per_s: Sequence[float] | None = None) -> None:
        """Send the tip's position, m, and its velocity, m/s, in our frame: once each period.

        With a velocity, the server continues the motion for up to 5 ms when a command is late. Raises ServerGone or ToolLost: a device
        renders zero from then on. Raises ValueError for what is not three finite numbers: nothing is sent.
        """
        self._connection.check()
        if not self.contract.holding:
            reason = (
                self.contract.broken[-1] if self.contract.broken else "it is held in its `with` statement"
            )
            raise ToolLost(f"the tool {self.name!r} is not ours: {reason}")
        if self.silent_s > max(self._silence_s, 0.0 if self.newest else FIRST_FORCE_S):
            raise ServerGone(f"the server is silent: no force for {self.silent_s:.3g} s")
        velocity = None
        if velocity_m_per_s is not None:
            velocity = {self.name: _vector("velocity_m_per_s", velocity_m_per_s)}
        position = {self.name: _vector("position_m", position_m)}
        attach = {self.name: True} if self._attached else None
        self._connection.send(position, velocity, self._rendered_tick, attach, self._on_sending)

    def wait_for_answer(self, timeout_s: float) -> bool:
        """Wait until a force has come that knows of the last `move`; False when none comes in time. For one thread at a time."""
        return self._answered.wait(timeout_s)

    def attach(self) -> None:
        """Hold the tissue under the tip from the next `move` on, as soon as it touches: it can be pulled then.

        A patch model ignores this; its tips are attached always.
        """
        self._attached = True

    def let_go(self) -> None:
        """Let the tissue go from the next `move` on."""
        self._attached = False

    def take_force(self) -> Vector:
        """The force to render now, N, in our frame: the newest one while it is fresh, otherwise zero.

        It is zero before the first force, when no force that keeps the contract has come for `hold_s`, and when the tool or the
        server is lost. The next command tells the server which force was rendered.
        """
        force = self.newest
        fresh = force is not None and self.silent_s <= self._connection.description.hold_s
        if force is None or not fresh or not self.contract.holding:
            self._rendered_tick = None
            return NO_FORCE
        self._rendered_tick = force.tick
        x, y, z = force.force_n
        return x, y, z

    @property
    def silent_s(self) -> float:
        """Time since the newest force that keeps the contract, s; before the first, since the tool was acquired."""
        return time.monotonic() - self._since_s

    def at_depth(self, depth_m: float) -> list[float]:
        """The point this far inside the undeformed surface, straight below `home_m`; m, in our frame and our unit."""
        return [h - depth_m * n for h, n in zip(self.home_m, self.normal, strict=True)]

    def use_device(self, profile: str, damping_n_s_per_m: float | None) -> float:
        """Tell the server which device renders and its own damping, if known, so that its limits hold and passivity control is on.

        Keeps the tip at `home_m` for 1.5 s to measure how old a force is when it is rendered: the 99th percentile of the
        round trip, and up to a period until the next step. Returns that time, s. Then acquires the tool again; `warnings`
        are the server's about this device. Raises what `move` raises, and Refused.
        """
        period_s = self._connection.description.period_s
        for duration_s in (SETTLE_S, MEASURE_S):
            self.contract.measure_anew()
            for _ in steps(duration_s, period_s):
                self.move(self.home_m)
        time.sleep(LAST_ANSWERS_S)
        round_trip_s = self.contract.round_trip_s(0.99)
        if round_trip_s is None:
            raise ServerGone("no command was answered")
        round_trip_s += period_s
        self.contract.released()
        self._acquire(device=profile, device_damping_n_s_per_m=damping_n_s_per_m, round_trip_s=round_trip_s)
        return round_trip_s

    def _acquire(self, **device: Any) -> None:
        answer = self._connection.control(
            "acquire", tools=[self.name], frame=self.frame.message(), **self._tip, **device
        )
        self._read_description(self._connection.describe())
        agreed = answer["tools"][self.name]
        self.limits = agreed["limits"]
        x, y, z = agreed["home_m"]
        self.home_m = x, y, z
        self.warnings = answer["warnings"]
        self.newest = None
        self._attached = False
        self._since_s = time.monotonic()
        self._rendered_tick = None
        self.contract.acquired(self.limits["max_force_n"])

    def _read_description(self, description: Description) -> None:
        described = description.tools[description.index(self.name)]
        self.normal = self.frame.direction_at_client(described.normal)
        self.touches_anywhere = description.message["model"].get("kind") == "surface"

    def _on_sending(self, sequence: int, client_time_ns: int) -> None:
        self._answered.clear()
        self._sent = sequence
        self.contract.on_sending(sequence, client_time_ns)

    def _on_force(self, force: Force) -> None:
        if self.contract.on_force(force):  # a force that breaks the contract is as good as none
            self._since_s = force.arrival_ns * 1e-9
            self.newest = force
            if force.sequence >= self._sent:
                self._answered.set()


def _vector(name: str, value: Sequence[float]) -> list[float]:
    try:
        x, y, z = map(float, value)  # numpy's numbers too
        if math.isfinite(x) and math.isfinite(y) and math.isfinite(z):
            return [x, y, z]
    except (TypeError, ValueError, OverflowError):
        pass
    raise ValueError(f"{name} is {value!r}: expected three finite numbers")


class OneSidedContact:
    """Makes a contact with tissue one-sided: a device is pushed out of it, and never pulled in.

    The body of a patch model follows the tip in every direction, also outwards; that of a surface model does not, and gets the
    hand's position as it is. For a patch model, while the hand is outside of the tissue,
    the tip is left at `home_m` and nothing is rendered. It enters where the hand enters. After a silence the tip stays out
    until the hand has left the tissue, so that no force comes back with a jump.
    """

    def __init__(self, tool: Tool, hold_s: float) -> None:
        self._tool = tool
        self._hold_s = hold_s
        self._let_go = True  # a hand that begins in the tissue has to leave it first
        self._entered: Sequence[float] = tool.home_m  # where the hand went in, on the undeformed surface

    def tip(self, position_m: Sequence[float]) -> tuple[list[float], bool]:
        """The tip's position for the hand's position, m, in our frame; and whether the tip touches the tissue."""
        if self._tool.touches_anywhere:
            return list(position_m), True
        home, normal = self._tool.home_m, self._tool.normal
        depth = sum((h - p) * n for h, p, n in zip(home, position_m, normal, strict=True))
        silent = self._tool.silent_s > self._hold_s
        self._let_go = silent or (self._let_go and depth > 0)
        if self._let_go or depth <= 0:
            self._entered = [p + depth * n for p, n in zip(position_m, normal, strict=True)]
            return list(home), False
        return [h + p - e for h, p, e in zip(home, position_m, self._entered, strict=True)], True
