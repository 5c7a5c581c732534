"""Close the loop with a haptic device: read its position, send it, render the force. Here the device is simulated.

To use a real one, write a class like SimulatedDevice around its driver: `position` and `render` are all there is to it.

Whatever ends it, the device is left without a force. Exit code 0: all well. 1: the contract was broken, the contact was
lost or the server went away; to go on, start it again: whoever holds the device then begins at rest. 2: it could not start.
130: Ctrl-C, SIGTERM, SIGQUIT or SIGHUP.
"""

import argparse
import math
import signal
import sys
import threading
import time

import zenoh
from connection import Connection, Refused, ServerGone, plain_name, positive, steps
from contract import Contract

SETTLE_S = 0.5  # the server's deadlines move to where our commands come, in a quarter of a second
MEASURE_S = 1.0  # of round trips: a thousand
SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGQUIT, signal.SIGHUP)


class SimulatedDevice:
    """A handle of some mass on a line, held by a hand that is a spring to where the person wants to be."""

    def __init__(self, mass_kg, damping_n_s_per_m, hand_n_per_m):
        self.mass_kg = mass_kg
        self.damping_n_s_per_m = damping_n_s_per_m
        self.hand_n_per_m = hand_n_per_m
        self.position_m = 0.0
        self.velocity_m_per_s = 0.0
        self.force_n = 0.0

    def render(self, force_n):
        """The force on the hand from now on; a real driver sends it to the motors."""
        self.force_n = force_n

    def move(self, wanted_m, seconds):
        """Semi-implicit Euler: as simple as it gets, and it does not gain energy by itself."""
        hand = self.hand_n_per_m * (wanted_m - self.position_m)
        acceleration = (hand + self.force_n - self.damping_n_s_per_m * self.velocity_m_per_s) / self.mass_kg
        self.velocity_m_per_s += acceleration * seconds
        self.position_m += self.velocity_m_per_s * seconds


def main():
    options = parse_options()
    for number in SIGNALS:
        # Under nohup a hang-up goes on being ignored.
        if number != signal.SIGHUP or signal.getsignal(number) != signal.SIG_IGN:
            signal.signal(number, interrupt)
    zenoh.try_init_log_from_env()  # silent unless RUST_LOG says otherwise
    try:
        with Connection(options.connect, options.session, options.zenoh_config, options.name) as connection:
            return run(connection, options)
    except (Refused, ServerGone) as error:
        print(f"device bridge: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:  # the server lets the force fade as soon as our token is gone
        return 130


def interrupt(*_):
    for number in SIGNALS:
        signal.signal(number, signal.SIG_IGN)  # a second one must not come in the way of letting go
    raise KeyboardInterrupt


def run(connection, options):
    contact = connection.description["contacts"][0]
    contract = Contract(connection.description, contact["name"])
    inwards = [-n for n in contact["normal"]]
    # Of one message, in one piece, since another thread writes it: the force along the line of motion, its tick, and when
    # it was heard.
    newest = 0.0, None, time.monotonic()
    stopping = threading.Event()

    def on_status(status):
        if status["state"] == "stopping":
            stopping.set()

    def on_force(message, arrival_ns):
        nonlocal newest
        if not contract.on_force(message, arrival_ns):
            return  # what may not be rendered is as good as silence
        # The message holds what the tip does to the tissue; the hand feels the opposite.
        force = message["force_n"][contract.index]
        along = -sum(f * n for f, n in zip(force, inwards, strict=True))
        newest = along, message["tick"], time.monotonic()

    connection.on_force(on_force)
    connection.on_status(on_status)
    device = SimulatedDevice(options.mass_kg, options.damping_n_s_per_m, options.hand_n_per_m)
    contract.agree(connection.acquire([contact["name"]]))
    round_trip_s = measure(connection, contract, contact)
    if round_trip_s is None:
        raise ServerGone("no command was answered")
    # With a device the server watches the energy that goes through our hands, and damps what would build up. With its
    # damping and the round trip the server can tell whether it might vibrate.
    contract.release()
    terms = connection.acquire(
        [contact["name"]],
        device=options.device,
        device_damping_n_s_per_m=options.damping_n_s_per_m,
        round_trip_s=round_trip_s,
    )
    contract.agree(terms)
    for warning in terms["warnings"]:
        print(f"warning: {warning}", file=sys.stderr)
    period = connection.description["period_s"]
    hold_s = connection.description["hold_s"]  # a force is held as long as the server holds a silent input
    deepest = 0.0
    trouble = None
    let_go = True  # a hand that begins in the tissue has to leave it first
    rendered = {}  # nothing is told before the first force is rendered
    try:
        for i in steps(options.duration_s, period):
            # Never keep rendering what the server said long ago.
            force, tick, heard = newest
            silence_s = time.monotonic() - heard
            if stopping.is_set():  # it says so before it goes
                trouble = "the server is stopping"
            elif connection.gone.is_set():
                trouble = "the server is gone, or the link to it: its liveliness token was taken back"
            elif not contract.holding:
                trouble = "the contact is no longer ours"
            elif silence_s > options.silence_s:
                trouble = f"the server is silent: no force for {options.silence_s} s"
            if trouble:
                break
            # A force that comes back in the tissue would jump: once let go, the tip stays out until the hand is out.
            let_go = silence_s > hold_s or (let_go and device.position_m > 0)
            # The tip is outside the tissue until its position is inside it; then it pushes, and nothing pulls it in.
            depth = 0.0 if let_go else max(device.position_m, 0.0)
            # The velocity lets the server carry the motion on when a command is late; the tick tells it which of its
            # forces acted until now, so that it can count the energy exactly although messages take time.
            speed = device.velocity_m_per_s if depth > 0 else 0.0
            command = connection.command(
                {contact["name"]: [depth * n for n in inwards]},
                velocity_m_per_s={contact["name"]: [speed * n for n in inwards]},
                **rendered,
            )
            contract.on_sent(command)  # before it is sent: the answer may come before `send` returns
            connection.send(command)
            device.render(force if depth > 0 else 0.0)
            rendered = {} if tick is None else {"rendered_tick": tick}
            device.move(options.reach_m * (1 - math.cos(2 * math.pi * i * period)) / 2, period)
            deepest = max(deepest, device.position_m)
    finally:
        device.render(0.0)  # or the motors would keep the last force, however this ends
    if trouble:
        contract.release()  # what comes from now on is no answer to us
    else:
        time.sleep(0.05)  # the last answers are still under way
        contract.release()
        try:
            connection.release()
        except ServerGone as error:
            trouble = str(error)

    summary = contract.summary()
    trip = summary["round_trip_s"]["p50"]
    print(f"commands answered  {summary['commands_answered']} of {summary['commands_sent']}")
    print(f"round trip told    {round_trip_s * 1e6:.0f} microseconds, until rendered")
    print(f"round trip p50     {'-' if trip is None else f'{trip * 1e6:.0f}'} microseconds")
    print(
        f"deepest position   {deepest * 1e3:.2f} mm of the {options.reach_m * 1e3:.2f} mm that the hand reached for"
    )
    print(f"largest force      {summary['largest_force_n']:.4g} N")
    for line in summary["contract_broken"]:
        print(f"contract broken: {line}", file=sys.stderr)
    if trouble:
        print(f"device bridge: {trouble}", file=sys.stderr)
    return 1 if trouble or summary["contract_broken"] or not summary["commands_answered"] else 0


def measure(connection, contract, contact):
    """The age that 99 of 100 forces stay below when they are rendered, s; None when no command was answered.

    Measured with commands that keep the tip at rest, rendering nothing: the round trip, and up to a period until the next
    step of ours.
    """
    at_rest = {contact["name"]: [0.0, 0.0, 0.0]}
    period = connection.description["period_s"]
    for seconds in (SETTLE_S, MEASURE_S):
        contract.measure_anew()
        for _ in steps(seconds, period):
            command = connection.command(at_rest)
            contract.on_sent(command)
            connection.send(command)
    time.sleep(0.05)  # the last answers are still under way
    heard = contract.summary()["round_trip_s"]["p99"]
    return None if heard is None else heard + period


def parse_options():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--connect",
        default="tcp/127.0.0.1:7447",
        metavar="ENDPOINT",
        help="where the server listens (%(default)s)",
    )
    parser.add_argument(
        "--session", type=plain_name, default="main", help="the server's --session (%(default)s)"
    )
    parser.add_argument(
        "--zenoh-config", metavar="FILE", help="Zenoh configuration to use instead of --connect"
    )
    parser.add_argument(
        "--name",
        type=plain_name,
        help="this client's; under access control, that in its certificate (default: a random one)",
    )
    parser.add_argument("--device", default="generic", help="profile whose limits are to hold (%(default)s)")
    parser.add_argument("--mass-kg", type=positive, default=0.1, help="of the handle (%(default)s)")
    parser.add_argument("--damping-n-s-per-m", type=positive, default=0.5, help="of the device (%(default)s)")
    parser.add_argument(
        "--hand-n-per-m", type=positive, default=100.0, help="how stiffly the hand holds it (%(default)s)"
    )
    parser.add_argument(
        "--reach-m", type=positive, default=0.01, help="how deep the hand wants to go (%(default)s)"
    )
    parser.add_argument(
        "--silence-s",
        type=positive,
        default=0.1,
        help="without a force for so long, let go: a device must not be left with an old one (%(default)s s)",
    )
    parser.add_argument("--duration-s", type=positive, default=5.0, help="(%(default)s)")
    return parser.parse_args()


if __name__ == "__main__":
    sys.exit(main())
