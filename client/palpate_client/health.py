"""Check that a server answers and that its loop runs. Exit code 0: yes. 1: no, with the reason in one line.

For a container's health check or a monitoring script; it takes no tool and moves nothing.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from typing import Any

import zenoh

from palpate_client.arguments import add_connection_options, connection_for
from palpate_client.connection import Connection
from palpate_client.errors import ClientError

STATUS_WAIT_S = 1.0


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="palpate health", description=(__doc__ or "").splitlines()[0])
    add_connection_options(parser, name=False)
    parser.add_argument("--json", action="store_true", help="print the finding as JSON, whichever it is")
    options = parser.parse_args(arguments)
    zenoh.init_log_from_env_or("off")  # the reason is printed below
    status: dict[str, Any] | None = None
    try:
        with connection_for(options) as connection:
            status, reason = check(connection)
    except ClientError as error:
        reason = str(error)
    if options.json:
        running = {"model": status["model"]["name"], "ticks": status["ticks"]} if status else {}
        print(
            json.dumps({"healthy": reason is None, "reason": reason, "model": None, "ticks": None} | running)
        )
    elif reason is not None:
        print(f"unhealthy: {reason}", file=sys.stderr)
    elif status is not None:
        print(f"healthy: {status['model']['name']}, tick {status['ticks']}")
    return 0 if reason is None else 1


def check(connection: Connection) -> tuple[dict[str, Any] | None, str | None]:
    """The newest status, and what is wrong, None if nothing is."""
    first, _, last = (connection.next_status(STATUS_WAIT_S) for _ in range(3))
    if first is None or last is None:
        return None, f"no status message in {STATUS_WAIT_S} s, expected ten a second"
    if last["ticks"] <= first["ticks"]:
        return last, f"the loop has stopped at tick {last['ticks']}"
    return last, None


if __name__ == "__main__":
    sys.exit(main())
