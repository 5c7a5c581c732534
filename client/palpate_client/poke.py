"""Poke a served model without a device: move one tool, check every force, print a summary.

Exit code 0: all well. 1: the contract was broken, the tool was lost or the server went away. 2: it could not start.
3: the file of --record could not be written. 130: Ctrl-C.
"""

from __future__ import annotations

import argparse
import contextlib
import csv
import io
import json
import math
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import zenoh

from palpate_client.arguments import add_connection_options, connection_for, failed, positive
from palpate_client.connection import Connection, steps
from palpate_client.errors import ClientError, ServerGone, ToolLost
from palpate_client.messages import Description
from palpate_client.tool import Tool
from palpate_client.trajectory import Trajectory, read_trajectory

Row = tuple[float, ...]

STATUS_WAIT_S = 1.0  # statuses come ten times a second


def main(arguments: Sequence[str] | None = None) -> int:
    options = parse_options(arguments)
    zenoh.try_init_log_from_env()  # type: ignore[no-untyped-call]  # silent unless RUST_LOG says otherwise
    try:
        # A file that can't be read is found before anything moves.
        trajectory = None if options.trajectory is None else read_trajectory(options.trajectory)
        with connection_for(options) as connection:
            return run(connection, options, trajectory)
    except (ClientError, OSError, ValueError) as error:
        return failed("palpate client", error, 2)
    except KeyboardInterrupt:  # before anything was moved
        return 130


def run(connection: Connection, options: argparse.Namespace, trajectory: Trajectory | None) -> int:
    if options.record is not None:
        from palpate.files import check_output

        check_output(Path(options.record))  # better to fail now than after the poke
    tool = Tool(connection, options.tool, silence_s=options.silence_s)
    rows: list[Row] = []
    if options.record is not None:
        connection.on_force(lambda message, arrival_ns: rows.append(row_of(message)))
    interrupted = False
    lost: str | None = None
    held = contextlib.ExitStack()
    held.enter_context(tool)  # an error here is a start that failed, an error below a loss
    for warning in tool.warnings:
        print(f"warning: {warning}", file=sys.stderr)
    connection.next_status(STATUS_WAIT_S)
    before = connection.status
    try:
        with held:
            if trajectory is None:
                move(tool, poke(tool, options), options.duration_s, options.rate_hz)
            else:
                move(tool, trajectory.at, trajectory.duration_s, options.rate_hz)
    except KeyboardInterrupt:
        interrupted = True
    except ServerGone as error:
        lost = str(error)
    except ToolLost:
        pass  # the contract says why
    if not lost:
        connection.next_status(STATUS_WAIT_S)
    summary = tool.contract.summary() | {
        "tool": tool.name,
        "server_lost": lost,
        "not_carried_out": not_carried_out(before, connection.status),
    }
    if not summary["commands_answered"] and not lost:
        summary["contract_broken"].append("no command was answered")
    print(json.dumps(summary) if options.json else readable(summary), flush=True)
    for line in summary["contract_broken"]:
        print(f"contract broken: {line}", file=sys.stderr)
    if lost:
        print(f"palpate client: {lost}", file=sys.stderr)
    unwritten = options.record is not None and not wrote(options.record, connection.description, rows)
    if interrupted:
        return 130
    if lost or summary["contract_broken"]:
        return 1
    return 3 if unwritten else 0


def move(
    tool: Tool,
    path: Callable[[float], tuple[Sequence[float], Sequence[float]]],
    duration_s: float,
    rate_hz: float,
) -> None:
    """Send position and velocity of a path over time, s, until the duration is over. Raises ServerGone or ToolLost."""
    for i in steps(duration_s, 1 / rate_hz):
        tool.move(*path(i / rate_hz))


def poke(tool: Tool, options: argparse.Namespace) -> Callable[[float], tuple[list[float], list[float]]]:
    """Position, m, and velocity, m/s, at a time (s) since the start, along the tool's normal; both motions begin at depth 0."""
    w, amplitude_m = 2 * math.pi * options.frequency_hz, options.amplitude_m
    half = amplitude_m / 2

    def at(t: float) -> tuple[list[float], list[float]]:
        if options.motion == "poke":
            depth_m, speed_m_per_s = half * (1 - math.cos(w * t)), half * w * math.sin(w * t)
        else:
            depth_m, speed_m_per_s = amplitude_m * math.sin(w * t), amplitude_m * w * math.cos(w * t)
        return tool.at_depth(depth_m), [-speed_m_per_s * n for n in tool.normal]

    return at


def not_carried_out(before: dict[str, Any] | None, after: dict[str, Any] | None) -> dict[str, int] | None:
    """What the server counted between two statuses, of all its clients' commands; None without both statuses."""
    if before is None or after is None:
        return None
    counts = {
        f"{kind} {reason}": after[kind][reason] - before[kind][reason]
        for kind in ("refused", "malformed")
        for reason in after[kind]
    }
    counts["superseded"] = after["dropped"]["superseded"] - before["dropped"]["superseded"]
    return {name: count for name, count in counts.items() if count}


def row_of(message: dict[str, Any]) -> Row:
    """A force message as a row of numbers.

    Numbers alone: Python's garbage collector looks at every list of a message that is kept, and no command is sent meanwhile.
    """
    per_tool = ("sequence", "flags", "force_scale", "position_m", "force_n")
    row = [message["tick"], message["server_time_ns"]]
    for sequence, flags, scale, position, force in zip(*(message[name] for name in per_tool), strict=True):
        row += [sequence, flags, scale, *position, *force]
    return tuple(row)


def wrote(path: str, description: Description, rows: list[Row]) -> bool:
    """Write every received tick as CSV: position and force of each tool. False, with a message, if it can't be written."""
    from palpate.files import write_atomically

    table = io.StringIO(newline="")
    writer = csv.writer(table)
    vectors = [
        f"{name}_{axis}_{unit}" for name, unit in (("position", "m"), ("force", "n")) for axis in "xyz"
    ]
    columns = ("sequence", "flags", "force_scale", *vectors)
    header = [f"{tool.name}.{column}" for tool in description.tools for column in columns]
    writer.writerow(["tick", "server_time_ns", *header])
    writer.writerows(rows)
    try:
        write_atomically(Path(path), table.getvalue().encode())
    except OSError as error:
        print(f"palpate client: {error}", file=sys.stderr)
        return False
    return True


def readable(summary: dict[str, Any]) -> str:
    def microseconds(seconds: float | None) -> str:
        return "-" if seconds is None else f"{seconds * 1e6:.0f}"

    def listed(counts: dict[str, int]) -> str:
        return ", ".join(f"{name} {count}" for name, count in counts.items()) or "none"

    trip = summary["round_trip_s"]
    not_done = summary["not_carried_out"]
    return "\n".join(
        (
            f"tool               {summary['tool']}",
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


def parse_options(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="palpate client", description=(__doc__ or "").splitlines()[0])
    add_connection_options(parser)
    parser.add_argument("--tool", help="name of the tool to move (default: the model's first)")
    parser.add_argument(
        "--motion",
        choices=("poke", "sine"),
        default="poke",
        help="poke: inwards and back; sine: about the rest position (%(default)s)",
    )
    parser.add_argument(
        "--trajectory",
        type=Path,
        metavar="FILE.csv",
        help="move as this file says, for as long as it says, instead of --motion: columns t_s, x_m, y_m, z_m, the tip in the model's frame",
    )
    for name, default, text in (
        ("--amplitude-m", 0.005, "largest depth, m"),
        ("--frequency-hz", 1.0, "pokes a second"),
        ("--duration-s", 5.0, "how long, s"),
        ("--rate-hz", 1000.0, "commands a second"),
        ("--silence-s", 0.5, "without a force for so long, give up, s"),
    ):
        parser.add_argument(name, type=positive, default=default, help=f"{text} (%(default)s)")
    parser.add_argument("--record", metavar="FILE.csv", help="write every tick: position applied and force")
    parser.add_argument("--json", action="store_true", help="print the summary as JSON")
    return parser.parse_args(arguments)


if __name__ == "__main__":
    sys.exit(main())
