"""Close the loop with a haptic device: read its position, send it, render the force. Here the device is simulated.

To use a real one, write a class like SimulatedDevice around its driver. Whatever ends the bridge, the device is left without
a force. Exit code 0: all well. 1: the contract was broken, the tool was lost or the server went away; to go on, start it
again. 2: it could not start. 130: Ctrl-C, SIGTERM, SIGQUIT or SIGHUP.
"""

import argparse
import math
import signal
import sys

import zenoh

from palpate_client import ClientError, Frame, OneSidedContact, Tool, steps
from palpate_client.arguments import add_connection_options, connection_for, positive

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGQUIT, signal.SIGHUP)
NO_FORCE = (0.0, 0.0, 0.0)


class SimulatedDevice:
    """A handle on a line, held by a hand that is a spring to where the person wants to be.

    Its driver speaks as many do: positions in millimeters, velocities in millimeters a second, forces in newtons, along
    axes of its own: x to the right, y up, z out of the tissue, towards the person.
    """

    neutral_mm = (0.0, 0.0, 0.0)  # where it stands when the tip touches the tissue without pressing

    def __init__(self, mass_kg, damping_n_s_per_m, hand_n_per_m):
        self.mass_kg, self.damping_n_s_per_m, self.hand_n_per_m = mass_kg, damping_n_s_per_m, hand_n_per_m
        self.z_mm = 0.0
        self.speed_mm_per_s = 0.0
        self.force_n = 0.0

    def position_mm(self):
        return 0.0, 0.0, self.z_mm

    def velocity_mm_per_s(self):
        return 0.0, 0.0, self.speed_mm_per_s

    def render(self, force_n):
        """The force on the hand from now on; a real driver sends it to the motors, which keep it."""
        self.force_n = force_n[2]

    def move(self, wanted_mm, seconds):
        """Semi-implicit Euler: it does not gain energy by itself. A real device is moved by the hand."""
        hand_n = self.hand_n_per_m * 1e-3 * (wanted_mm - self.z_mm)
        damping_n = self.damping_n_s_per_m * 1e-3 * self.speed_mm_per_s
        self.speed_mm_per_s += 1e3 * (hand_n + self.force_n - damping_n) / self.mass_kg * seconds
        self.z_mm += self.speed_mm_per_s * seconds


def frame_for(device, described):
    """The device's axes in the model: its z along the outward normal of the tool, its neutral position at the tool's start.

    The columns of the rotation are the device's x, y and z axes along the model's. A real bridge writes its own here.
    """
    z = described.normal
    least = min(range(3), key=lambda axis: abs(z[axis]))  # the axis of the model that is farthest from z
    y = cross(z, [float(axis == least) for axis in range(3)])
    y = [c / math.hypot(*y) for c in y]
    x = cross(y, z)
    return Frame(
        rotation=tuple(zip(x, y, z, strict=True)),
        client_origin_m=tuple(1e-3 * c for c in device.neutral_mm),
        model_origin_m=described.start_m,
    )


def cross(a, b):
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


def main():
    options = parse_options()
    for number in SIGNALS:
        if signal.getsignal(number) != signal.SIG_IGN or number != signal.SIGHUP:  # nohup ignores a hang-up
            signal.signal(number, interrupt)
    zenoh.try_init_log_from_env()  # silent unless RUST_LOG says otherwise
    driving = False
    try:
        with connection_for(options) as connection:
            device = SimulatedDevice(options.mass_kg, options.damping_n_s_per_m, options.hand_n_per_m)
            frame = frame_for(device, connection.description.tools[0])
            tool = Tool(connection, frame=frame, silence_s=options.silence_s)
            try:
                with tool:
                    round_trip_s = tool.use_device(options.device, options.damping_n_s_per_m)
                    for warning in tool.warnings:
                        print(f"warning: {warning}", file=sys.stderr)
                    driving = True
                    drive(device, tool, connection.description, options)
            finally:
                if driving:
                    print_summary(tool.contract, round_trip_s)
            return 1 if tool.contract.broken or not tool.contract.commands_answered else 0
    except ClientError as error:
        print(f"device bridge: {error}", file=sys.stderr)
        return 1 if driving else 2
    except KeyboardInterrupt:  # the server lets the force fade as soon as our token is gone
        return 130


def interrupt(*_):
    for number in SIGNALS:
        signal.signal(number, signal.SIG_IGN)  # a second one must not keep us from letting go
    raise KeyboardInterrupt


def drive(device, tool, description, options):
    contact = OneSidedContact(tool, description.hold_s)
    try:
        for i in steps(options.duration_s, description.period_s):
            position_m = [1e-3 * c for c in device.position_mm()]
            velocity_m_per_s = [1e-3 * c for c in device.velocity_mm_per_s()]
            tip_m, touches = contact.tip(position_m)
            tool.move(tip_m, velocity_m_per_s if touches else NO_FORCE)
            force_n = tool.take_force()  # along the device's axes already, and with its sign
            device.render(force_n if touches else NO_FORCE)
            reach_mm = 1e3 * options.reach_m * (1 - math.cos(2 * math.pi * i * description.period_s)) / 2
            device.move(-reach_mm, description.period_s)
    finally:
        device.render(NO_FORCE)  # or the motors would keep the last force, however this ends


def print_summary(contract, round_trip_s):
    trip = contract.round_trip_s(0.5)
    print(f"commands answered  {contract.commands_answered} of {contract.commands_sent}")
    print(f"round trip told    {round_trip_s * 1e6:.0f} microseconds, until rendered")
    print(f"round trip p50     {'-' if trip is None else f'{trip * 1e6:.0f}'} microseconds")
    print(f"largest force      {contract.largest_force_n:.4g} N")
    for line in contract.broken:
        print(f"contract broken: {line}", file=sys.stderr)


def parse_options():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    add_connection_options(parser)
    parser.add_argument("--device", default="generic", help="profile whose limits are to hold (%(default)s)")
    for name, default, text in (
        ("--mass-kg", 0.1, "of the handle"),
        ("--damping-n-s-per-m", 0.5, "of the device"),
        ("--hand-n-per-m", 100.0, "how stiffly the hand holds it"),
        ("--reach-m", 0.01, "how deep the hand wants to go"),
        ("--silence-s", 0.1, "without a force for so long, let go, s"),
        ("--duration-s", 5.0, "how long, s"),
    ):
        parser.add_argument(name, type=positive, default=default, help=f"{text} (%(default)s)")
    return parser.parse_args()


if __name__ == "__main__":
    sys.exit(main())
