"""Completion of commands, options and file names in a shell: shtab makes the script from the parsers that the commands make."""

from __future__ import annotations

import argparse
import importlib
import sys
from pathlib import Path
from unittest import mock

import shtab

from palpate.cli import COMMANDS, Command


class _Made(BaseException):
    """A command has made its parser and is about to use it; not an Exception, since commands catch those."""

    def __init__(self, parser: argparse.ArgumentParser) -> None:
        self.parser = parser


def main() -> None:
    """Print what a shell needs to complete commands, options and files; docs/commands.md says where to put it."""
    parser = argparse.ArgumentParser(prog="palpate completion", description=main.__doc__)
    parser.add_argument("shell", choices=shtab.SUPPORTED_SHELLS)
    options = parser.parse_args()
    print(shtab.complete(whole_parser(), options.shell))


def whole_parser() -> argparse.ArgumentParser:
    """One parser with all commands; of a command that is not installed, the name alone."""
    whole = argparse.ArgumentParser(prog="palpate")
    whole.add_argument("--version", action="store_true", help="all versions that matter")
    whole.add_argument("--debug", action="store_true", help="show the traceback of an error")
    commands = whole.add_subparsers()
    for name, command in COMMANDS.items():
        made = _parser_of(name, command)
        parser = commands.add_parser(
            name, help=command.summary, parents=[made] if made else [], add_help=made is None
        )
        for action in parser._actions:
            if action.type is Path:
                action.complete = shtab.FILE  # type: ignore[attr-defined]
    return whole


def _parser_of(name: str, command: Command) -> argparse.ArgumentParser | None:
    """The parser that a command makes when it runs. It is run up to there: commands parse before they do anything else."""

    def stop(parser: argparse.ArgumentParser, *_: object) -> None:
        raise _Made(parser)

    try:
        function = getattr(importlib.import_module(command.module), command.function)
        with (
            mock.patch.object(argparse.ArgumentParser, "parse_args", stop),
            mock.patch.object(sys, "argv", [f"palpate {name}"]),
        ):
            function()
    except _Made as made:
        return made.parser
    except (ModuleNotFoundError, SystemExit):  # an extra is missing
        return None
    raise AssertionError(f"{name} does not parse its options")
