"""Poke a served model without a device: drive one contact, check every force, print what it was like.

Exit code 0: all well. 1: the contract was broken, the contact was lost or the server went away. 2: it could not start.
3: the file of --record could not be written. 130: Ctrl-C.
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
from connection import Connection, Refused, ServerGone, plain_name, positive, steps
from contract import Contract

STATUS_WAIT_S = 1.0  # statuses come ten times a second


def main():
    options = parse_options()
    zenoh.try_init_log_from_env()  # silent unless RUST_LOG says otherwise
    try:
        with Connection(options.connect, options.session, options.zenoh_config, options.name) as connection:
            return run(connection, options)
    except (Refused, ServerGone, OSError) as error:
        print(f"palpate client: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:  # before anything was moved
        return 130


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

    statuses = Statuses()
    connection.on_force(on_force)
    connection.on_status(statuses.receive)
    contract.agree(connection.acquire([contact["name"]]))
    before = statuses.next()
    interrupted = False
    try:
        lost = drive(connection, contract, contact, motion(options), options, last_force)
    except KeyboardInterrupt:
        lost, interrupted = None, True
    if not lost:
        time.sleep(0.05)  # the last answers are still under way
        contract.release()
        try:
            connection.release()
        except ServerGone as error:
            lost = str(error)
    after = statuses.newest if lost else statuses.next()

    summary = contract.summary() | {
        "contact": contact["name"],
        "server_lost": lost,
        "not_carried_out": not_carried_out(before, after),
    }
    if not summary["commands_answered"] and not lost:
        summary["contract_broken"].append("no command was answered")
    print(json.dumps(summary) if options.json else readable(summary), flush=True)
    for line in summary["contract_broken"]:
        print(f"contract broken: {line}", file=sys.stderr)
    if lost:
        print(f"palpate client: {lost}", file=sys.stderr)
    unwritten = None
    if options.record:
        try:
            write_recording(options.record, connection.description, recording)
        except OSError as error:
            unwritten = error
            print(f"palpate client: {options.record}: {error.strerror}", file=sys.stderr)
    if interrupted:
        return 130
    if lost or summary["contract_broken"]:
        return 1
    return 3 if unwritten else 0


class Statuses:
    """The server's statuses, of which only the newest counts."""

    def __init__(self):
        self.newest = None
        self._came = threading.Event()

    def receive(self, status):
        self.newest = status
        self._came.set()

    def next(self):
        """One that comes from now on, or the newest when none does."""
        self._came.clear()
        self._came.wait(STATUS_WAIT_S)
        return self.newest


def not_carried_out(before, after):
    """What the server counted between two statuses, of all its clients' commands; None without both statuses."""
    if before is None or after is None:
        return None
    counters = {
        **{f"refused {reason}": "refused" for reason in after["refused"]},
        **{f"malformed {reason}": "malformed" for reason in after["malformed"]},
        "superseded": "dropped",
    }
    counts = {}
    for name, kind in counters.items():
        reason = name.rpartition(" ")[2]
        if count := after[kind][reason] - before[kind][reason]:
            counts[name] = count
    return counts


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
    heard = time.monotonic()
    for i in steps(options.duration_s, period):
        depth_m, speed_m_per_s = depth(i * period)
        # With the velocity the server carries the motion on when a command is late, instead of holding and jumping.
        command = connection.command(
            {contact["name"]: [depth_m * n for n in inwards]},
            velocity_m_per_s={contact["name"]: [speed_m_per_s * n for n in inwards]},
        )
        contract.on_sent(command)  # before it is sent: the answer may come before `send` returns
        connection.send(command)
        if connection.gone.is_set():
            return "the server is gone, or the link to it: its liveliness token was taken back"
        if not contract.holding:
            return None  # nobody would hear us; the contract says why
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

    def listed(counts):
        return ", ".join(f"{name} {count}" for name, count in counts.items()) or "none"

    trip = summary["round_trip_s"]
    not_done = summary["not_carried_out"]
    return "\n".join(
        (
            f"contact            {summary['contact']}",
            f"commands           {summary['commands_sent']} sent, {summary['commands_answered']} answered, "
            f"{summary['commands_unanswered']} not",
            f"not carried out    {'unknown' if not_done is None else listed(not_done)} (by the server's count, of all "
            "clients' commands)",
            f"forces             {summary['forces_received']} received, {summary['forces_lost']} lost",
            f"round trip         p50 {microseconds(trip['p50'])}, p99 {microseconds(trip['p99'])}, "
            f"p99.9 {microseconds(trip['p99_9'])}, longest {microseconds(trip['max'])} microseconds",
            f"largest force      {summary['largest_force_n']:.4g} N",
            f"flags (ticks)      {listed(summary['flags'])}",
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
