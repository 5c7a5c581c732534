"""Check that a server answers and that its loop runs. Exit code 0: yes. 1: no, with the reason in one line.

For a container's health check or a monitoring script; it takes no tool and moves nothing.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence

import zenoh

from palpate_client.arguments import add_connection_options, connection_for
from palpate_client.connection import Connection
from palpate_client.errors import ClientError

STATUS_WAIT_S = 1.0


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="palpate health", description=(__doc__ or "").splitlines()[0])
    add_connection_options(parser, name=False)
    options = parser.parse_args(arguments)
    zenoh.init_log_from_env_or("off")  # the reason is printed below
    try:
        with connection_for(options) as connection:
            return check(connection)
    except ClientError as error:
        print(f"unhealthy: {error}", file=sys.stderr)
        return 1


def check(connection: Connection) -> int:
    first, _, last = (connection.next_status(STATUS_WAIT_S) for _ in range(3))
    if first is None or last is None:
        print(f"unhealthy: no status message in {STATUS_WAIT_S} s, expected ten a second", file=sys.stderr)
        return 1
    ticks = last["ticks"]
    if ticks <= first["ticks"]:
        print(f"unhealthy: the loop has stopped at tick {ticks}", file=sys.stderr)
        return 1
    print(f"healthy: {last['model']['name']}, tick {ticks}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
