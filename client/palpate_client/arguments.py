"""Command line options that all programs with a connection have."""

from __future__ import annotations

import argparse
import math
import os
import sys
from collections.abc import Callable

from palpate_client import wire
from palpate_client.connection import Connection

SMALLEST, LARGEST = 1e-9, 1e9


def add_connection_options(parser: argparse.ArgumentParser, *, name: bool = True) -> None:
    parser.add_argument(
        "--connect",
        default=wire.DEFAULT_ENDPOINT,
        metavar="ENDPOINT",
        help="where the server listens (%(default)s)",
    )
    parser.add_argument(
        "--session",
        type=plain_name,
        default=wire.DEFAULT_SESSION,
        help="the server's --session (%(default)s)",
    )
    parser.add_argument(
        "--zenoh-config", metavar="FILE", help="Zenoh configuration to use instead of --connect"
    )
    if name:
        parser.add_argument(
            "--name",
            type=plain_name,
            help="this client's; under access control, that in its certificate (default: a random one)",
        )


def connection_for(options: argparse.Namespace) -> Connection:
    """The connection that these options ask for, to be entered."""
    name = getattr(options, "name", None)
    return Connection(options.connect, options.session, zenoh_config=options.zenoh_config, name=name)


def failed(program: str, error: Exception, code: int) -> int:
    """Say in one line why a program ends, and give its exit code; with `palpate --debug` the error is raised instead."""
    if os.environ.get("PALPATE_DEBUG"):
        raise error
    from palpate.files import printable

    print(printable(f"{program}: {error}"), file=sys.stderr)
    return code


def plain_name(text: str) -> str:
    """A name that becomes a part of keys. Raises argparse.ArgumentTypeError."""
    if not wire.is_name(text):
        raise argparse.ArgumentTypeError(f"{text!r} is not 1 to 64 of A-Z a-z 0-9 _ -")
    return text


def positive(text: str) -> float:
    """A number from SMALLEST to LARGEST: nothing that is computed from it overflows. Raises argparse.ArgumentTypeError."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not SMALLEST <= value <= LARGEST:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number from {SMALLEST:g} to {LARGEST:g}")
    return value


def positive_up_to(largest: float) -> Callable[[str], float]:
    """The type of an option whose value is positive and at most `largest`."""

    def number(text: str) -> float:
        value = positive(text)
        if value > largest:
            raise argparse.ArgumentTypeError(f"{text!r} is above {largest:g}")
        return value

    return number
