"""Entry point of the command line: from its first line on, Ctrl-C ends it with code 130 and one line."""

import os

try:
    from palpate import interrupts

    interrupts.install()
except KeyboardInterrupt:
    os.write(2, b"palpate: interrupted\n")
    os._exit(130)


def main() -> None:
    """Run the command that `sys.argv` names, and exit with its code."""
    from palpate.cli import main as run

    interrupts.leave(run())


if __name__ == "__main__":
    main()
