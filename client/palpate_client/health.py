"""Is a server there, and does its loop run? Exit code 0: yes. 1: no, with the reason in one line.

For a container's health check or a monitoring script; it takes no tool and moves nothing.
"""

from __future__ import annotations

import argparse
import sys
import threading
from collections.abc import Sequence
from typing import Any

import zenoh

from palpate_client.arguments import add_connection_options, connection_for
from palpate_client.connection import Connection
from palpate_client.errors import ClientError

PATIENCE_S = 2.0  # a status comes ten times a second


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="palpate health", description=(__doc__ or "").splitlines()[0])
    add_connection_options(parser, name=False)
    options = parser.parse_args(arguments)
    zenoh.init_log_from_env_or("off")  # what matters is said below
    try:
        with connection_for(options) as connection:
            return look(connection)
    except ClientError as error:
        print(f"not well: {error}", file=sys.stderr)
        return 1


def look(connection: Connection) -> int:
    statuses: list[dict[str, Any]] = []
    enough = threading.Event()

    def on_status(status: dict[str, Any]) -> None:
        statuses.append(status)
        if len(statuses) == 3:
            enough.set()

    connection.on_status(on_status)
    if not enough.wait(PATIENCE_S):
        print(f"not well: {len(statuses)} status messages in {PATIENCE_S} s, expected 20", file=sys.stderr)
        return 1
    ticks = statuses[2]["ticks"]
    if ticks <= statuses[0]["ticks"]:
        print(f"not well: the loop stands still at tick {ticks}", file=sys.stderr)
        return 1
    print(f"well: {statuses[2]['model']['name']}, tick {ticks}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
