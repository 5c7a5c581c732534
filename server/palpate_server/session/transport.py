"""Opens the server's Zenoh session: loopback and no scouting, unless a configuration file says otherwise."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import zenoh

from palpate_client.wire import DEFAULT_ENDPOINT, KEEP_ALIVES, LEASE_MS, MAX_MESSAGE_BYTES
from palpate_server.realtime import threads

SETTINGS: Mapping[str, Any] = {
    "mode": "peer",
    "scouting/multicast/enabled": False,
    "scouting/gossip/enabled": False,
    "transport/link/tx/lease": LEASE_MS,
    "transport/link/tx/keep_alive": KEEP_ALIVES,
    # Of a message that comes in fragments. Clients need less than a thousandth of it: a message that is too large by mistake
    # still arrives, and is counted. Zenoh drops larger ones and keeps the link; its own bound is 1 GiB a client and priority.
    "transport/link/rx/max_message_size": MAX_MESSAGE_BYTES,
    # A client's shared memory would become part of ours, as much of it as the client likes, beyond that bound.
    "transport/shared_memory/enabled": False,
    # Forces are sent unbatched: room for 16 of them while the sender's thread is held up, then drop at once.
    "transport/link/tx/queue/size/real_time": 16,
    "transport/link/tx/queue/congestion_control/drop/wait_before_drop": 0,
    # Connections that say nothing: up to 400 of them for 2 s each keep no client out.
    "transport/unicast/accept_pending": 400,
    "transport/unicast/accept_timeout": 2000,
}


class TransportError(Exception):
    """The session can't be opened. The message names the endpoint or file, and the cause."""


def open_session(listen: str | None, config_file: Path | None) -> zenoh.Session:
    """A server's session: listens on an endpoint, or has exactly the configuration in a file.

    Zenoh's own threads get a low real-time priority where that is allowed: they inherit it from the thread that opens the
    first session of a process. Threads that call back into Python inherit from the thread that declares, so Python's
    threads get the priority that they ask for.

    Raises TransportError when the file can't be read, or the endpoint is malformed or in use.
    """
    endpoint = listen or DEFAULT_ENDPOINT
    prepare = partial(threads.raise_priority, threads.ZENOH_PRIORITY, inherited=True)
    with ThreadPoolExecutor(1, "open", prepare) as opener:
        return opener.submit(_open, endpoint, config_file).result()


def _open(endpoint: str, config_file: Path | None) -> zenoh.Session:
    try:
        if config_file is None:
            config = zenoh.Config()
            for key, value in {**SETTINGS, "listen/endpoints": [endpoint]}.items():
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
    """Zenoh's message on one line, without places in its source and without the picture of a syntax error."""
    text = str(error)
    syntax = re.search(r"--> (\d+):(\d+).*= (expected .*)", text, re.DOTALL)
    if syntax:
        line, column, expected = syntax.groups()
        return f"line {line}, column {column}: {' '.join(expected.split())}"
    text = text.removeprefix('Json5Err(Message { msg: "').split(" at /", 1)[0].replace('\\"', '"')
    if text.count("[") > text.count("]"):  # the closing one was cut off with the place
        text = "".join(text.rsplit("[", 1))
    return " ".join(text.split()).rstrip(".") or "refused"
