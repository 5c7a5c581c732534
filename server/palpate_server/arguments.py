"""What the programs on the command line have in common: numbers that are checked, and extras that may not be installed."""

from __future__ import annotations

import argparse
import sys
from importlib.util import find_spec


def index(text: str) -> int:
    """An integer, 0 or more. Raises argparse.ArgumentTypeError."""
    try:
        value = int(text)
    except ValueError:
        value = -1
    if value < 0:
        raise argparse.ArgumentTypeError(f"{text!r} is not an integer, 0 or more")
    return value


def port(text: str) -> int:
    """A TCP port, 0 (any that is free) to 65535. Raises argparse.ArgumentTypeError."""
    value = index(text)
    if value > 65535:
        raise argparse.ArgumentTypeError(f"{text!r} is not a port, 0 to 65535")
    return value


def need(package: str, extra: str, program: str) -> None:
    """End the program in one line, with code 2, when the package of an optional extra is not installed."""
    if find_spec(package) is None:
        print(f"{program}: needs the package {package}: install palpate[{extra}]", file=sys.stderr)
        sys.exit(2)
