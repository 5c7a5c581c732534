"""Drive a haptic device: each period render the newest force, read the position, send it.

Whatever ends the bridge, the device is left without a force. Exit code 0: all well. 1: the contract was broken, the device or the
tool was lost, or the server went away; to go on, start it again. 2: it could not start. 130: Ctrl-C, SIGTERM, SIGQUIT or SIGHUP.
"""

from __future__ import annotations

import argparse
import contextlib
import math
import signal
import sys
import time
from collections.abc import Callable, Sequence
from typing import Protocol

import zenoh

from palpate_client.arguments import add_connection_options, connection_for, failed, positive
from palpate_client.connection import steps
from palpate_client.contract import Contract
from palpate_client.errors import ClientError, DeviceLost
from palpate_client.messages import Description, Frame, ToolDescription, Vector
from palpate_client.tool import OneSidedContact, Tool

SIGNALS = [
    getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGQUIT", "SIGHUP") if hasattr(signal, name)
]
NO_FORCE: Vector = (0.0, 0.0, 0.0)


class Device(Protocol):
    """What a bridge needs of a device: everything along the device's own axes, in m, m/s and N.

    Attributes
    ----------
    profile: name of the server's device profile whose limits hold.
    damping_n_s_per_m: the device's own; None if unknown.
    right, outward: unit vectors, at right angles: to the right of the person, and out of the tissue (up, for most devices).
    neutral_m: where the device stands when the tip touches the tissue without pressing.

    A device may have `reads_at_render = True`: `read` then tells where it was when `render` was called last. Its forces are
    rendered as soon as they come, not at the next step, and one force still acts between two positions.
    """

    profile: str
    damping_n_s_per_m: float | None
    right: Vector
    outward: Vector
    neutral_m: Vector

    def render(self, force_n: Vector) -> None:
        """The force on the hand from now on."""

    def read(self) -> tuple[Vector, Vector | None]:
        """Position and, if the device tells it, velocity. Raises DeviceLost."""

    def close(self) -> None:
        """Let the driver go. Called once, after a last force of zero; must not raise."""


def run(open_device: Callable[[], Device], options: argparse.Namespace) -> int:
    """Connect, open the device and drive it until the end; the exit code. `options` are those of `parser`."""
    for number in SIGNALS:
        # nohup ignores a hang-up
        if signal.getsignal(number) != signal.SIG_IGN or number != getattr(signal, "SIGHUP", None):
            signal.signal(number, _interrupt)
    zenoh.try_init_log_from_env()  # type: ignore[no-untyped-call]  # silent unless RUST_LOG says otherwise
    driving = False
    try:
        with connection_for(options) as connection, contextlib.closing(open_device()) as device:
            frame = frame_over(device, connection.description.tools[0])
            tip = {"radius_m": options.radius_m, "friction": options.friction}
            tool = Tool(connection, frame=frame, silence_s=options.silence_s, **tip)
            try:
                with tool:
                    profile = options.device or device.profile
                    round_trip_s = tool.use_device(profile, device.damping_n_s_per_m)
                    for warning in tool.warnings:
                        print(f"warning: {warning}", file=sys.stderr)
                    driving = True
                    _drive(device, tool, connection.description, options.duration_s)
            finally:
                if driving:
                    _print_summary(tool.contract, round_trip_s)
            return 1 if tool.contract.broken or not tool.contract.commands_answered else 0
    except ClientError as error:
        return failed("device bridge", error, 1 if driving else 2)
    except KeyboardInterrupt:  # the server lets the force fade as soon as our token is gone
        return 130


def parser(description: str, duration_s: float = math.inf) -> argparse.ArgumentParser:
    """The options that every bridge has."""
    parser = argparse.ArgumentParser(description=description)
    add_connection_options(parser)
    parser.add_argument("--device", help="profile whose limits are to hold (default: this device's)")
    parser.add_argument(
        "--silence-s", type=positive, default=0.1, help="without a force for so long, let go, s (%(default)s)"
    )
    parser.add_argument(
        "--radius-m", type=positive, help="of the tip, for a surface model (default: the file's)"
    )
    parser.add_argument("--friction", type=float, help="of the tip, the same")
    until = "until Ctrl-C" if math.isinf(duration_s) else "%(default)s"
    parser.add_argument("--duration-s", type=positive, default=duration_s, help=f"how long, s ({until})")
    return parser


def frame_over(device: Device, tool: ToolDescription) -> Frame:
    """The device's axes in the model: `outward` along the outward normal of the tool, `neutral_m` at the tool's start."""
    normal = tool.normal
    farthest = min(range(3), key=lambda axis: abs(normal[axis]))  # the model's axis that is farthest from it
    across = _cross(normal, [float(axis == farthest) for axis in range(3)])
    length = math.hypot(*across)
    right = _cross([c / length for c in across], normal)
    pairs = (
        (right, device.right),
        (normal, device.outward),
        (_cross(right, normal), _cross(device.right, device.outward)),
    )
    rows = [[sum(m[i] * d[j] for m, d in pairs) for j in range(3)] for i in range(3)]
    a, b, c = ((x, y, z) for x, y, z in rows)
    return Frame((a, b, c), client_origin_m=device.neutral_m, model_origin_m=tool.start_m)


def _cross(a: Sequence[float], b: Sequence[float]) -> Vector:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


def _interrupt(*_: object) -> None:
    for number in SIGNALS:
        signal.signal(number, signal.SIG_IGN)  # a second one must not keep us from letting go
    raise KeyboardInterrupt


def _drive(device: Device, tool: Tool, description: Description, duration_s: float) -> None:
    contact = OneSidedContact(tool, description.hold_s)
    reads_at_render = getattr(device, "reads_at_render", False)
    touches = False

    def render() -> None:
        force_n = tool.take_force()  # along the device's axes already, and with its sign
        device.render(force_n if touches else NO_FORCE)

    try:
        if reads_at_render:
            device.render(NO_FORCE)
        start_s = math.inf
        for i in steps(duration_s, description.period_s):
            start_s = min(start_s, time.monotonic())
            if not reads_at_render:
                render()
            position_m, velocity_m_per_s = device.read()
            tip_m, touches = contact.tip(position_m)
            tool.move(tip_m, velocity_m_per_s if touches else NO_FORCE)
            if reads_at_render:
                left_s = start_s + (i + 1) * description.period_s - time.monotonic()
                tool.wait_for_answer(max(left_s, 0.0))  # steps that are late don't wait: they catch up
                render()
    finally:
        with contextlib.suppress(DeviceLost):
            device.render(NO_FORCE)  # or the motors would keep the last force, however this ends


def _print_summary(contract: Contract, round_trip_s: float) -> None:
    trip = contract.round_trip_s(0.5)
    print(f"commands answered  {contract.commands_answered} of {contract.commands_sent}")
    print(f"round trip told    {round_trip_s * 1e6:.0f} microseconds, until rendered")
    print(f"round trip p50     {'-' if trip is None else f'{trip * 1e6:.0f}'} microseconds")
    print(f"largest force      {contract.largest_force_n:.4g} N")
    for line in contract.broken:
        print(f"contract broken: {line}", file=sys.stderr)
