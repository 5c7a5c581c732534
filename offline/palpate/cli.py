"""The command line: which commands there are, and how each ends. It imports the standard library only."""

from __future__ import annotations

import difflib
import importlib
import os
import signal
import sys
from typing import NamedTuple

from palpate import interrupts
from palpate.files import printable


class Command(NamedTuple):
    """module.function() runs it, with its arguments in sys.argv; `extra` is what to install where a package is missing."""

    group: str
    summary: str
    extra: str
    module: str
    function: str = "main"


_BUILD, _SERVE, _TOUCH, _WATCH = "Build a model", "Run it", "Touch it", "Look at a session"

COMMANDS = {
    "demo": Command(_BUILD, "build the liver, serve it, poke it, and draw what was felt", "all", "palpate.commands", "demo"),
    "build": Command(_BUILD, "build a scene into a model file, and say how accurate it is", "build", "palpate.commands", "build"),
    "fit": Command(_BUILD, "fit the material of a scene to measured records of a tissue", "build", "palpate.commands", "fit"),
    "tissues": Command(_BUILD, "list the tissues that a scene can name, with their sources", "build", "palpate.commands", "tissues"),
    "bank": Command(_BUILD, "build several scenes, what they share once; on many machines by Dask", "build", "palpate.commands", "bank"),
    "inspect": Command(_BUILD, "say what a model file holds and how accurate it is", "server", "palpate.commands", "inspect"),
    "surface": Command(_BUILD, "take the surface of a label of an image, smooth and closed, in m", "images", "palpate.commands", "surface"),
    "repair": Command(_BUILD, "mend a surface file until it bounds one body, and say what was changed", "build", "palpate.commands", "repair"),
    "serve": Command(_SERVE, "run a model file at 1 kHz over Zenoh", "server", "palpate_server.__main__"),
    "check-host": Command(_SERVE, "measure whether this machine holds 1 kHz, and what to change", "server", "palpate_server.diagnostics.check_host"),
    "health": Command(_SERVE, "say whether a server is there and its loop runs", "", "palpate_client.health"),
    "client": Command(_TOUCH, "poke a running server and check every answer", "", "palpate_client.poke"),
    "view": Command(_TOUCH, "see a running server in the browser, and touch it with the mouse", "view", "palpate_view.program"),
    "record": Command(_WATCH, "have a running server record its session to an MCAP file", "", "palpate_server.recording.record"),
    "replay": Command(_WATCH, "repeat a recording offline and compare bit for bit", "recorder", "palpate_server.recording.replay"),
    "completion": Command("This command line", "print what a shell needs to complete commands and options", "completion", "palpate.completion"),
    "reproduce": Command("The paper", "regenerate the figures of BaniHani & De 2009", "experiments", "palpate.commands", "reproduce"),
}  # fmt: skip


def main() -> int:
    """Run the command that sys.argv names. A mistake of the user ends in one line and code 2, Ctrl-C in code 130."""
    arguments = sys.argv[1:]
    for position, text in enumerate(arguments, 1):
        if not text.isprintable():  # it would reach the terminal in some message
            return _fail(
                f"argument {position}, '{printable(text)}', has characters that can't be shown: expected plain text"
            )
    if "--debug" in arguments:
        arguments.remove("--debug")
        os.environ["PALPATE_DEBUG"] = "1"  # also for the programs that a command starts
    try:
        return _command(arguments)
    except BrokenPipeError:  # the reader of our output, such as `head`, has ended
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # Python flushes it once more at exit
        return 128 + signal.SIGPIPE


def _command(arguments: list[str]) -> int:
    name = arguments[0] if arguments else "--help"
    if name in ("--help", "-h"):
        print(_help(), flush=True)
        return 0
    if "--version" in arguments and set(arguments) <= {"--version", "--json"}:
        from palpate.versions import versions_text

        print(versions_text(as_json="--json" in arguments), flush=True)
        return 0
    if name not in COMMANDS:
        near = difflib.get_close_matches(name, COMMANDS, 1)
        hint = f"; did you mean '{near[0]}'?" if near else ""
        return _fail(f"there is no command '{name}': expected one of {', '.join(COMMANDS)}{hint}")
    sys.argv = [f"palpate {name}", *arguments[1:]]
    return _run(name, COMMANDS[name])


def _run(name: str, command: Command) -> int:
    try:
        function = getattr(importlib.import_module(command.module), command.function)
        with interrupts.raised():
            code = int(function() or 0)
            sys.stdout.flush()
            return code
    except KeyboardInterrupt:
        return interrupts.end()
    except ModuleNotFoundError as error:
        package = (error.name or "").partition(".")[0]
        if package.startswith("palpate"):
            raise
        extra = f"palpate[{command.extra}]" if command.extra else "palpate"
        return _fail(f"{name} needs the package {package}, which is not installed: pip install '{extra}'")
    except BrokenPipeError:
        raise
    except (ValueError, OSError, MemoryError) as error:
        if os.environ.get("PALPATE_DEBUG"):
            raise
        return _fail(str(error) or "out of memory")


def _fail(message: str) -> int:
    for line in message.split("\n"):  # a scene is told all its mistakes, a line each
        print(f"error: {printable(line)}", file=sys.stderr)
    return 2


def _help() -> str:
    lines = [
        "usage: palpate COMMAND ...",
        "",
        "Feel soft tissue: build a reduced viscoelastic model, serve it at 1 kHz, touch it.",
    ]
    for group in dict.fromkeys(command.group for command in COMMANDS.values()):
        lines += ["", f"{group}:"]
        lines += [f"  {name:<12}{c.summary}" for name, c in COMMANDS.items() if c.group == group]
    lines += [
        "",
        "`palpate COMMAND --help` shows the options of a command, `palpate --version` all versions that matter;",
        "`--debug`, with any command, the traceback of an error. Exit codes: docs/commands.md.",
    ]
    return "\n".join(lines)
