"""Is a server there, and does its loop run? Exit code 0: yes. 1: no, with the reason in one line.

What a container's health check or a monitoring script calls; it takes no contact and moves nothing.
"""

import argparse
import sys
import threading

import msgpack
import zenoh
from connection import Connection, Refused, ServerGone, plain_name

PATIENCE_S = 2.0  # status comes ten times a second


def main():
    options = parse_options()
    zenoh.init_log_from_env_or("off")  # what matters is said below
    try:
        with Connection(options.connect, options.session, options.zenoh_config) as connection:
            return look(connection)
    except (Refused, ServerGone) as error:
        print(f"not well: {error}", file=sys.stderr)
        return 1


def look(connection):
    heard = []
    enough = threading.Event()

    def on_status(sample):
        heard.append(msgpack.unpackb(sample.payload.to_bytes()))
        if len(heard) == 3:
            enough.set()

    _status = connection.zenoh.declare_subscriber(f"{connection.prefix}/status", on_status)
    if not enough.wait(PATIENCE_S):
        print(f"not well: {len(heard)} status messages in {PATIENCE_S} s, expected 20", file=sys.stderr)
        return 1
    if heard[2]["ticks"] <= heard[0]["ticks"]:
        print(f"not well: the loop stands still at tick {heard[2]['ticks']}", file=sys.stderr)
        return 1
    print(f"well: {connection.description['model']['name']}, tick {heard[2]['ticks']}")
    return 0


def parse_options():
    parser = argparse.ArgumentParser(prog="palpate health", description=__doc__.splitlines()[0])
    parser.add_argument("--connect", default="tcp/127.0.0.1:7447", metavar="ENDPOINT", help="(%(default)s)")
    parser.add_argument(
        "--session", type=plain_name, default="main", help="the server's --session (%(default)s)"
    )
    parser.add_argument(
        "--zenoh-config", metavar="FILE", help="Zenoh configuration to use instead of --connect"
    )
    return parser.parse_args()


if __name__ == "__main__":
    sys.exit(main())
