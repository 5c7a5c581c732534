"""Poke a served model without a device: drive one contact, check every force, print what it was like.

Exit code 0: all well. 1: the contract was broken or the server went away. 2: it could not start. 130: Ctrl-C.
"""

import argparse
import csv
import json
import math
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path

import zenoh
from connection import Connection, Refused, ServerGone, positive
from contract import Contract


def main():
    options = parse_options()
    zenoh.try_init_log_from_env()  # silent unless RUST_LOG says otherwise
    try:
        with Connection(options.connect, options.session, options.zenoh_config, options.name) as connection:
            return run(connection, options)
    except (Refused, ServerGone, OSError) as error:
        print(f"palpate client: {error}", file=sys.stderr)
        return 2


def run(connection, options):
    if options.record:
        Path(options.record).touch()  # better to fail now than after the poke
    contact = choose_contact(connection.description, options.contact)
    contract = Contract(connection.description, contact["name"])
    recording = []
    last_force = threading.Event()

    def on_force(message, arrival_ns):
        contract.on_force(message, arrival_ns)
        last_force.set()
        if options.record:
            recording.append(message)

    connection.on_force(on_force)
    contract.agree(connection.acquire([contact["name"]]))
    interrupted = False
    try:
        lost = drive(connection, contract, contact, motion(options), options, last_force)
    except KeyboardInterrupt:
        lost, interrupted = None, True
    if not lost:
        time.sleep(0.05)  # the last answers are still under way
        connection.release()
        contract_holds = not contract.broken
    else:
        contract_holds = False

    summary = contract.summary() | {"contact": contact["name"], "server_lost": lost}
    if not summary["commands_answered"] and not lost:
        summary["contract_broken"].append("no command was answered")
        contract_holds = False
    if options.record:
        write_recording(options.record, connection.description, recording)
    print(json.dumps(summary) if options.json else readable(summary))
    for line in summary["contract_broken"]:
        print(f"contract broken: {line}", file=sys.stderr)
    if lost:
        print(f"palpate client: {lost}", file=sys.stderr)
    if interrupted:
        return 130
    return 0 if contract_holds else 1


def choose_contact(description, name):
    contacts = {contact["name"]: contact for contact in description["contacts"]}
    if name is None:
        return description["contacts"][0]
    if name not in contacts:
        raise Refused(f"no contact is called {name!r}: there are {', '.join(contacts)}")
    return contacts[name]


def motion(options) -> Callable[[float], tuple[float, float]]:
    """Depth (m, inwards) and its speed (m/s) at a time (s) since the start; both motions begin at the rest position."""
    w = 2 * math.pi * options.frequency_hz
    if options.motion == "poke":
        half = options.amplitude_m / 2
        return lambda t: (half * (1 - math.cos(w * t)), half * w * math.sin(w * t))
    return lambda t: (options.amplitude_m * math.sin(w * t), options.amplitude_m * w * math.cos(w * t))


def drive(connection, contract, contact, depth, options, last_force):
    """Send a command each period until the duration is over; what was lost when the server goes away, else None."""
    inwards = [-n for n in contact["normal"]]
    period = 1 / options.rate_hz
    start = time.monotonic()
    heard = start
    for i in range(round(options.duration_s * options.rate_hz)):
        # Deadlines from the start, not from the last one: errors don't add up.
        wait = start + i * period - time.monotonic()
        if wait > 0:
            time.sleep(wait)
        depth_m, speed_m_per_s = depth(i * period)
        # With the velocity the server carries the motion on when a command is late, instead of holding and jumping.
        command = connection.command(
            {contact["name"]: [depth_m * n for n in inwards]},
            velocity_m_per_s={contact["name"]: [speed_m_per_s * n for n in inwards]},
        )
        contract.on_sent(command)  # before it is sent: the answer may come before `send` returns
        connection.send(command)
        if connection.gone.is_set():
            return "the server is gone: its liveliness token was taken back"
        if last_force.is_set():
            last_force.clear()
            heard = time.monotonic()
        elif time.monotonic() - heard > options.silence_s:
            return f"the server is silent: no force for {options.silence_s} s"
    return None


def write_recording(path, description, messages):
    """Every tick heard, as CSV: what was really applied to each contact and the force that was given."""
    names = [contact["name"] for contact in description["contacts"]]
    header = ["tick", "server_time_ns"]
    for name in names:
        header += [f"{name}.sequence", f"{name}.flags", f"{name}.force_scale"]
        header += [f"{name}.displacement_{axis}_m" for axis in "xyz"]
        header += [f"{name}.force_{axis}_n" for axis in "xyz"]
    with Path(path).open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(header)
        for message in messages:
            row = [message["tick"], message["server_time_ns"]]
            for i in range(len(names)):
                row += [message["sequence"][i], message["flags"][i], message["force_scale"][i]]
                row += message["displacement_m"][i] + message["force_n"][i]
            writer.writerow(row)


def readable(summary):
    def microseconds(seconds):
        return "-" if seconds is None else f"{seconds * 1e6:.0f}"

    trip = summary["round_trip_s"]
    flags = ", ".join(f"{name} {count}" for name, count in summary["flags"].items()) or "none"
    return "\n".join(
        (
            f"contact            {summary['contact']}",
            f"commands           {summary['commands_sent']} sent, {summary['commands_answered']} answered, "
            f"{summary['commands_unanswered']} not (a newer one was used instead)",
            f"forces             {summary['forces_received']} received, {summary['forces_lost']} lost",
            f"round trip         p50 {microseconds(trip['p50'])}, p99 {microseconds(trip['p99'])}, "
            f"p99.9 {microseconds(trip['p99_9'])}, longest {microseconds(trip['max'])} microseconds",
            f"largest force      {summary['largest_force_n']:.4g} N",
            f"flags (ticks)      {flags}",
            f"contract           {'BROKEN' if summary['contract_broken'] else 'held'}",
        )
    )


def parse_options():
    parser = argparse.ArgumentParser(prog="palpate client", description=__doc__.splitlines()[0])
    parser.add_argument(
        "--connect",
        default="tcp/127.0.0.1:7447",
        metavar="ENDPOINT",
        help="where the server listens (%(default)s)",
    )
    parser.add_argument("--session", default="main", help="the server's --session (%(default)s)")
    parser.add_argument(
        "--zenoh-config", metavar="FILE", help="Zenoh configuration to use instead of --connect"
    )
    parser.add_argument(
        "--name", help="this client's; under access control, that in its certificate (default: a random one)"
    )
    parser.add_argument("--contact", help="name of the contact to move (default: the model's first)")
    parser.add_argument(
        "--motion",
        choices=("poke", "sine"),
        default="poke",
        help="poke: inwards and back; sine: about the rest position (%(default)s)",
    )
    parser.add_argument(
        "--amplitude-m", type=positive, default=0.005, help="largest displacement (%(default)s m)"
    )
    parser.add_argument("--frequency-hz", type=positive, default=1.0, help="pokes a second (%(default)s)")
    parser.add_argument("--duration-s", type=positive, default=5.0, help="how long (%(default)s s)")
    parser.add_argument("--rate-hz", type=positive, default=1000.0, help="commands a second (%(default)s)")
    parser.add_argument(
        "--silence-s", type=positive, default=0.5, help="without a force for so long, give up (%(default)s s)"
    )
    parser.add_argument(
        "--record", metavar="FILE.csv", help="write every tick: applied displacement and force"
    )
    parser.add_argument("--json", action="store_true", help="print the summary as JSON")
    return parser.parse_args()


if __name__ == "__main__":
    sys.exit(main())
