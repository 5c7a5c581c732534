"""Zenoh sessions as this server wants them: loopback, no scouting, unless a configuration file says otherwise."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import zenoh

DEFAULT_ENDPOINT = "tcp/127.0.0.1:7447"
LEASE_MS = 1000  # after which a peer that does not answer counts as gone
# The largest message that a server puts together from fragments. Its clients have nothing to say that takes a thousandth
# of it: it is so large that what they send by mistake arrives, and is counted. What is larger still Zenoh drops before it
# is collected, and keeps the link; of itself it would collect up to 1 GiB for each client and priority.
MAX_MESSAGE_BYTES = 2**24

_QUIET: dict[str, Any] = {
    "mode": "peer",
    "scouting/multicast/enabled": False,
    "scouting/gossip/enabled": False,
    "transport/link/tx/lease": LEASE_MS,
}


class TransportError(Exception):
    """The session can't be opened; the message says what was asked for and why it failed."""


def open_session(listen: str | None, config_file: Path | None) -> zenoh.Session:
    """A session that listens on an endpoint, or one with exactly the configuration in a file.

    Raises TransportError when the file can't be read, or the endpoint is malformed or in use.
    """
    endpoint = listen or DEFAULT_ENDPOINT
    settings = {
        "listen/endpoints": [endpoint],
        "transport/link/rx/max_message_size": MAX_MESSAGE_BYTES,
        # A client's shared memory would become part of ours, past that bound: as much of it as the client likes.
        "transport/shared_memory/enabled": False,
        # Forces are sent unbatched: room for 16 of them while the sender's thread is held up, then drop at once.
        "transport/link/tx/queue/size/real_time": 16,
        "transport/link/tx/queue/congestion_control/drop/wait_before_drop": 0,
    }
    return _open(settings, endpoint, config_file)


def connect_session(endpoint: str, config_file: Path | None) -> zenoh.Session:
    """A session that connects to an endpoint, or one with exactly the configuration in a file. Raises TransportError."""
    settings = {
        "mode": "client",
        "listen/endpoints": [],
        "connect/endpoints": [endpoint],
        "connect/timeout_ms": 2000,
        "connect/exit_on_failure": True,
    }
    return _open(settings, endpoint, config_file)


def _open(settings: dict[str, Any], endpoint: str, config_file: Path | None) -> zenoh.Session:
    try:
        if config_file is None:
            config = zenoh.Config()
            for key, value in (_QUIET | settings).items():
                config.insert_json5(key, json.dumps(value))
        elif config_file.is_file():
            config = zenoh.Config.from_file(config_file)
        else:
            raise TransportError(f"zenoh configuration {config_file}: no such file")
        return zenoh.open(config)
    except zenoh.ZError as error:
        origin = f"zenoh configuration {config_file}" if config_file else f"endpoint {endpoint}"
        raise TransportError(f"{origin}: {_first_cause(error)}") from error


def _first_cause(error: zenoh.ZError) -> str:
    """Zenoh's own words on one line: without the places in its source, or the drawing around a syntax error."""
    text = str(error)
    syntax = re.search(r"--> (\d+):(\d+).*= (expected .*)", text, re.DOTALL)
    if syntax:
        line, column, expected = syntax.groups()
        return f"line {line}, column {column}: {' '.join(expected.split())}"
    text = text.removeprefix('Json5Err(Message { msg: "').split(" at /", 1)[0].replace('\\"', '"')
    if text.count("[") > text.count("]"):  # its end stood behind the place
        text = "".join(text.rsplit("[", 1))
    return " ".join(text.split()).rstrip(".") or "refused"
