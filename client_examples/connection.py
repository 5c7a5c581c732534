"""A client's side of the wire: connect, learn what there is, take contacts, send commands, hear forces.

Needs `eclipse-zenoh` and `msgpack`. In another language the same few calls of Zenoh do it: `cpp/` is this in C++.
"""

import argparse
import json
import math
import re
import threading
import time
import uuid

import msgpack
import zenoh

SCHEMA_VERSION = 1
QUERY_TIMEOUT_S = 3.0


class ServerGone(Exception):
    """There is no server, or it has gone; the message says which, in plain words."""


class Refused(Exception):
    """The server said no, and the message is its own; or we have to, and asking again would not help."""


class Connection:
    """One client in one session. Use it in a `with` statement: Zenoh must be closed, or the program hangs at exit."""

    def __init__(self, endpoint="tcp/127.0.0.1:7447", session="main", zenoh_config=None, name=None):
        self.prefix = f"palpate/{session}"
        self.place = zenoh_config or endpoint
        # The name is part of every key that we write to. It has to be unlike every other client's, and under access
        # control it is the name in our certificate.
        self.name = name or f"client-{uuid.uuid4().hex[:12]}"
        self.there = threading.Event()
        self.gone = threading.Event()
        self.sequence = 0
        try:
            configuration = _configuration(endpoint, zenoh_config)
        except zenoh.ZError as error:
            if zenoh_config:
                raise Refused(f"{zenoh_config}: {_cause(error)}") from error
            raise Refused(f"{endpoint!r} is no endpoint, such as tcp/127.0.0.1:7447") from error
        try:
            self.zenoh = zenoh.open(configuration)
        except zenoh.ZError as error:
            raise ServerGone(f"nothing answers at {self.place}: {_cause(error)}") from error
        try:
            self._join()
        except BaseException:
            self.zenoh.close()
            raise

    def _join(self):
        # The token is our sign of life: when it goes, because we are killed or cut off, the server takes our contacts
        # back and lets their force fade.
        self._token = self.zenoh.liveliness().declare_token(f"{self.prefix}/client/{self.name}")
        # The server has one too: it tells us when there is a server, and that it is gone faster than any timeout could.
        self._watch = self.zenoh.liveliness().declare_subscriber(
            f"{self.prefix}/server", self._on_server, history=True
        )
        # Forces and commands are worth nothing when late: no batching, and drop instead of wait.
        self._commands = self.zenoh.declare_publisher(
            f"{self.prefix}/command/{self.name}",
            priority=zenoh.Priority.REAL_TIME,
            express=True,
            congestion_control=zenoh.CongestionControl.DROP,
        )
        self.description = self._wait_for_description()
        version = self.description["schema_version"]
        if version != SCHEMA_VERSION:
            raise Refused(f"the server speaks schema version {version}, this client {SCHEMA_VERSION}")

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.zenoh.close()

    def _on_server(self, sample):
        if sample.kind == zenoh.SampleKind.PUT:
            self.there.set()
        else:
            self.gone.set()

    def _wait_for_description(self):
        if not self.there.wait(QUERY_TIMEOUT_S):
            raise ServerGone(f"no server for {self.prefix} at {self.place}")
        # On the way through a router the token may be faster than what makes queries arrive: ask again for a while.
        give_up = time.monotonic() + QUERY_TIMEOUT_S
        while True:
            try:
                return self.query("describe")
            except ServerGone:
                if time.monotonic() > give_up:
                    raise
                time.sleep(0.05)

    def query(self, key, request=None):
        """Ask the server; returns its answer (a dict). Raises Refused with its reason, ServerGone without an answer."""
        payload = None if request is None else msgpack.packb(request)
        for reply in self.zenoh.get(f"{self.prefix}/{key}", payload=payload, timeout=QUERY_TIMEOUT_S):
            if reply.ok is not None:
                return msgpack.unpackb(reply.ok.payload.to_bytes())
            if not str(reply.err.encoding).startswith("application/msgpack"):
                break  # not the server's words but Zenoh's: the time is over
            refusal = msgpack.unpackb(reply.err.payload.to_bytes())
            raise Refused(f"{refusal['message']} ({refusal['reason']})")
        raise ServerGone(f"no server at {self.place} answers {self.prefix}/{key}, or it does not let us ask")

    def acquire(self, contacts, **wishes):
        """Take contacts for ourselves alone; only then are our commands for them heard.

        `wishes` as in docs/wire.md: device, frame, round_trip_s, device_damping_n_s_per_m. The answer has the limits
        that hold for us, and warnings to show to the user.
        """
        return self.query(f"control/{self.name}/acquire", {"contacts": list(contacts), **wishes})

    def release(self):
        return self.query(f"control/{self.name}/release")

    def command(self, displacement_m, **more):
        """The next command: where the tips are, {contact: [x, y, z]}, m from rest, in our frame.

        `more` as in docs/wire.md: velocity_m_per_s, rendered_tick.
        """
        self.sequence += 1
        return {
            "sequence": self.sequence,
            "client_time_ns": time.monotonic_ns(),
            "displacement_m": displacement_m,
            **more,
        }

    def send(self, command):
        self._commands.put(msgpack.packb(command))

    def on_force(self, handle):
        """Call `handle(message, arrival_ns)` for every force message, on a thread of Zenoh's: be quick there."""

        def receive(sample):
            arrival_ns = time.monotonic_ns()
            handle(msgpack.unpackb(sample.payload.to_bytes()), arrival_ns)

        self._forces = self.zenoh.declare_subscriber(f"{self.prefix}/force", receive)

    def on_status(self, handle):
        """Call `handle(message)` for every status, some ten times a second."""

        def receive(sample):
            handle(msgpack.unpackb(sample.payload.to_bytes()))

        self._statuses = self.zenoh.declare_subscriber(f"{self.prefix}/status", receive)


def _cause(error):
    return str(error).partition(" at /")[0]  # what follows is a place in Zenoh's own source


def _configuration(endpoint, zenoh_config):
    if zenoh_config:
        return zenoh.Config.from_file(zenoh_config)
    config = zenoh.Config()
    settings = {
        # Everything goes through the one endpoint, be it the server's or a router's; nothing is listened on.
        "mode": "client",
        "connect/endpoints": [endpoint],
        "connect/timeout_ms": 2000,
        "connect/exit_on_failure": True,
        # We know where the server is; looking around the network would only find others.
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "transport/link/tx/lease": 1000,
    }
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))
    return config


def steps(duration_s, period_s):
    """Give 0, 1, 2, ..., one each period. Deadlines count from the start, not from the last one: errors don't add up.

    They are multiples of the period on our clock: the server's own deadlines, which follow ours, need not move when one
    loop takes over from another.
    """
    start = math.ceil(time.monotonic() / period_s) * period_s
    for i in range(round(duration_s / period_s)):
        wait = start + i * period_s - time.monotonic()
        if wait > 0:
            time.sleep(wait)
        yield i


def plain_name(text):
    """A name of a client or a session from the command line: it becomes a part of keys."""
    if not re.fullmatch("[A-Za-z0-9_-]{1,64}", text):
        raise argparse.ArgumentTypeError(f"{text!r} is not 1 to 64 of A-Z a-z 0-9 _ -")
    return text


def positive(text):
    """A number above 0 from the command line."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not (math.isfinite(value) and value > 0):
        raise argparse.ArgumentTypeError(f"{text!r} is not a number above 0")
    return value
