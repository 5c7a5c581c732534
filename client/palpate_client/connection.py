"""A client's connection to one server: opens and closes it, watches the server's token, sends requests, receives messages."""

from __future__ import annotations

import itertools
import json
import math
import re
import threading
import time
import uuid
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import zenoh

from palpate_client import wire
from palpate_client.errors import ConfigurationError, Incompatible, Refused, ServerGone
from palpate_client.messages import (
    Description,
    Force,
    Geometry,
    Surface,
    check_force,
    check_status,
    decode_geometry,
    read_description,
    read_force,
    read_surface,
)

QUERY_TIMEOUT_S = 3.0
LONG_QUERY_TIMEOUT_S = 30.0  # for wire.SLOW_ACTIONS
RETRY_PAUSE_S = 0.05

Subscription = Any  # zenoh.Subscriber: `undeclare()` ends it


class Connection:
    """One client in one session; use it in a `with` statement.

    Parameters
    ----------
    endpoint: where the server, or a router, listens, such as "tcp/127.0.0.1:7447".
    session: the server's `--session`.
    zenoh_config: a Zenoh configuration file to use instead of `endpoint`.
    name: the client's name, 1 to 64 of A-Z a-z 0-9 _ -; under access control the one in its certificate. Unlike every other
        client's; without it a random one is taken.

    Entering raises ConfigurationError, ServerGone or Incompatible. Zenoh is closed on the way out, whatever happened: an
    open Zenoh session keeps Python from exiting.
    """

    def __init__(
        self,
        endpoint: str = wire.DEFAULT_ENDPOINT,
        session: str = wire.DEFAULT_SESSION,
        *,
        zenoh_config: str | Path | None = None,
        name: str | None = None,
    ) -> None:
        self.keys = wire.Keys(session)
        self.name = f"client-{uuid.uuid4().hex[:12]}" if name is None else name
        if not wire.is_name(self.name):
            raise ConfigurationError(f"name is {name!r}: expected 1 to 64 of A-Z a-z 0-9 _ -")
        self.place = endpoint if zenoh_config is None else str(zenoh_config)
        self.ignored = 0  # messages that could not be read or were of another kind than their key
        self._endpoint, self._zenoh_config = endpoint, zenoh_config
        self._there = threading.Event()
        self._gone = threading.Event()
        self._stopping = threading.Event()
        self._status_came = threading.Event()
        self.status: dict[str, Any] | None = None  # the newest
        self.tool_in_use: str | None = (
            None  # a release is of all tools of a client, so a connection has one at a time
        )
        self._kept: list[object] = []  # references: Zenoh undeclares what is garbage-collected
        self._sequence = 0
        self._zenoh: zenoh.Session | None = None
        self._description: Description | None = None

    def __enter__(self) -> Connection:
        if self._zenoh is not None:
            raise RuntimeError("the connection is open already: use it in one `with` statement at a time")
        self._zenoh = open_session(self._endpoint, self._zenoh_config)
        try:
            self._join()
        except BaseException:
            self.close()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        if self._zenoh is not None:
            self._zenoh.close()  # type: ignore[no-untyped-call]
            self._zenoh = None

    @property
    def zenoh(self) -> zenoh.Session:
        """The open Zenoh session. Raises RuntimeError outside of the `with` statement."""
        if self._zenoh is None:
            raise RuntimeError("the connection is not open: use it in a `with` statement")
        return self._zenoh

    @property
    def description(self) -> Description:
        """The server's newest answer to `describe`."""
        if self._description is None:
            raise RuntimeError("the connection is not open: use it in a `with` statement")
        return self._description

    # The server's presence

    def check(self) -> None:
        """Raises ServerGone if the server or the link to it is gone, or if the server says that it is stopping."""
        if self._stopping.is_set():
            raise ServerGone("the server is stopping")
        if self._gone.is_set():
            raise ServerGone("the server is gone, or the link to it: its liveliness token was deleted")

    def reconnect(self, timeout_s: float) -> None:
        """Wait until a server is there (again) and agree with it anew; tools have to be acquired again.

        Raises ServerGone when none comes in time, and Incompatible when it serves another model than before.
        """
        before = self.description.config_sha256
        self._agree(timeout_s)
        if self.description.config_sha256 != before:
            raise Incompatible("the server that came back serves another model")

    # Requests

    def ask(
        self, key: str, fields: Mapping[str, Any] | None = None, *, timeout_s: float = QUERY_TIMEOUT_S
    ) -> bytes:
        """The payload of the server's answer to a query; `fields` are those of a control request.

        Raises Refused, Incompatible, or ServerGone without an answer.
        """
        request = None
        if fields is not None:
            head = {"kind": wire.Kind.REQUEST, "schema_version": wire.SCHEMA_VERSION}
            request = wire.pack({**head, **fields})
        try:
            replies = self.zenoh.get(key, payload=request, timeout=timeout_s)
        except zenoh.ZError as error:
            raise ServerGone(f"{key} can't be asked for: {_words(error)}") from error
        for reply in replies:
            if reply.ok is not None:
                return reply.ok.payload.to_bytes()
            assert reply.err is not None
            if not str(reply.err.encoding).startswith("application/msgpack"):
                break  # not the server's words but Zenoh's: no answer came in time
            refusal = wire.unpack_map(reply.err.payload.to_bytes(), wire.MAX_MESSAGE_BYTES)
            if refusal.get("reason") == "wrong_version":
                raise Incompatible(str(refusal.get("message")))
            raise Refused(str(refusal.get("reason")), str(refusal.get("message")))
        raise ServerGone(f"no server at {self.place} answers {key}, or it does not let us ask")

    def control(self, action: str, **fields: Any) -> dict[str, Any]:
        """Ask for one of wire.ACTIONS; `fields` and answer as in docs/wire.md. Raises what `ask` raises."""
        timeout_s = LONG_QUERY_TIMEOUT_S if action in wire.SLOW_ACTIONS else QUERY_TIMEOUT_S
        payload = self.ask(self.keys.control(self.name, action), fields, timeout_s=timeout_s)
        try:
            return wire.unpack(payload, wire.Kind.ANSWER)
        except wire.MalformedMessage as error:
            raise Incompatible(f"the server's answer can't be read: {error}") from error

    def describe(self) -> Description:
        """Ask for the description again, since another model may have been loaded, and keep it. Raises what `ask` raises."""
        message = wire.unpack_map(self.ask(self.keys.describe), wire.MAX_MESSAGE_BYTES)
        version = message.get("schema_version")
        if version != wire.SCHEMA_VERSION:
            raise Incompatible(
                f"the server speaks schema version {version}, this client {wire.SCHEMA_VERSION}: "
                "install the same version of palpate on both sides"
            )
        try:
            self._description = read_description(message)
        except (KeyError, TypeError) as error:
            raise Incompatible(f"the server's description can't be read: {error!r}") from error
        return self._description

    def geometry(self) -> Geometry:
        """The surface at rest of the model that runs. Raises what `ask` raises."""
        try:
            return decode_geometry(self.ask(self.keys.geometry))
        except wire.MalformedMessage as error:
            raise Incompatible(f"the server's geometry can't be read: {error}") from error

    # Messages

    def send(
        self,
        position_m: Mapping[str, list[float]],
        velocity_m_per_s: Mapping[str, list[float]] | None = None,
        rendered_tick: int | None = None,
        attach: Mapping[str, bool] | None = None,
        on_sending: Callable[[int, int], None] | None = None,
    ) -> int:
        """Send a command: position, m, and velocity, m/s, of tools by name, in the frame that was acquired; its sequence.

        attach: of each tool by name, whether it holds the tissue under it.
        on_sending(sequence, client_time_ns) is called right before it is sent.
        """
        self._sequence += 1
        sequence, now_ns = self._sequence, time.monotonic_ns()
        command = {
            "kind": wire.Kind.COMMAND,
            "sequence": sequence,
            "client_time_ns": now_ns,
            "position_m": position_m,
            "velocity_m_per_s": velocity_m_per_s,
            "rendered_tick": rendered_tick,
            "attach": attach,
        }
        if on_sending is not None:
            on_sending(sequence, now_ns)
        self._commands.put(wire.pack(command))
        return sequence

    def on_message(
        self, key: str, kind: wire.Kind, receive: Callable[[dict[str, Any], int], None]
    ) -> Subscription:
        """Call receive(message, arrival_ns) for every message of a kind, on a thread of Zenoh's: return quickly.

        Messages of another kind, and those that can't be read, are ignored and counted. Ends with the connection, or with
        `undeclare()` of what is returned.
        """

        def on_sample(sample: Any) -> None:
            arrival_ns = time.monotonic_ns()
            try:
                receive(wire.unpack(sample.payload.to_bytes(), kind), arrival_ns)
            except wire.MalformedMessage:
                self.ignored += 1

        subscriber = self.zenoh.declare_subscriber(key, on_sample)
        self._kept.append(subscriber)
        return subscriber

    def on_force(self, receive: Callable[[dict[str, Any], int], None]) -> Subscription:
        """Call receive(message, arrival_ns) for the force message of every tick."""

        def read(message: dict[str, Any], arrival_ns: int) -> None:
            check_force(message, len(self.description.tools))
            receive(message, arrival_ns)

        return self.on_message(self.keys.force, wire.Kind.FORCE, read)

    def on_tool_force(self, tool: str, receive: Callable[[Force], None]) -> Subscription:
        """Call receive(force) with one tool's force of every tick. Raises ValueError if there is no such tool."""
        index = self.description.index(tool)
        return self.on_force(lambda message, at: receive(read_force(message, index, at)))

    def on_status(self, receive: Callable[[dict[str, Any]], None]) -> Subscription:
        """Call receive(message) for every status, some ten a second."""

        def read(message: dict[str, Any], arrival_ns: int) -> None:
            check_status(message)
            receive(message)

        return self.on_message(self.keys.status, wire.Kind.STATUS, read)

    def next_status(self, timeout_s: float) -> dict[str, Any] | None:
        """The next status that comes, or None when none comes in time. For one thread at a time."""
        self._status_came.clear()
        return self.status if self._status_came.wait(timeout_s) else None

    def on_surface(self, receive: Callable[[Surface], None]) -> Subscription:
        """Call receive(surface) for every surface, some thirty a second; the server computes it only while somebody asks."""
        return self.on_message(
            self.keys.surface, wire.Kind.SURFACE, lambda message, at: receive(read_surface(message))
        )

    def _join(self) -> None:
        # When our token is deleted, because we are killed or cut off, the server frees our tools and lets their forces fade.
        liveliness = self.zenoh.liveliness()
        self._kept.append(liveliness.declare_token(self.keys.client(self.name)))
        # The server's token says that it is there, and its deletion comes sooner than any timeout.
        self._kept.append(liveliness.declare_subscriber(self.keys.server, self._on_server, history=True))
        self.on_status(self._on_status)
        # A late command is useless: do not batch, and drop instead of waiting.
        self._commands = self.zenoh.declare_publisher(
            self.keys.command(self.name),
            priority=zenoh.Priority.REAL_TIME,
            express=True,
            congestion_control=zenoh.CongestionControl.DROP,
        )
        self._agree(QUERY_TIMEOUT_S)

    def _on_server(self, sample: Any) -> None:
        if sample.kind == zenoh.SampleKind.PUT:
            self._there.set()
        else:
            self._there.clear()
            self._gone.set()

    def _on_status(self, status: dict[str, Any]) -> None:
        self.status = status
        self._status_came.set()
        if status.get("state") == "stopping":
            self._stopping.set()

    def _agree(self, timeout_s: float) -> None:
        """Wait for a server, ask it for its description, and keep that."""
        if not self._there.wait(timeout_s):
            raise ServerGone(f"no server for {self.keys.prefix} at {self.place} within {timeout_s:g} s")
        self._stopping.clear()
        self._gone.clear()
        give_up_s = time.monotonic() + QUERY_TIMEOUT_S
        while True:  # through a router the token may arrive before queries do
            try:
                self.describe()
                return
            except ServerGone:
                if time.monotonic() > give_up_s:
                    raise
                time.sleep(RETRY_PAUSE_S)


def open_session(endpoint: str, zenoh_config: str | Path | None = None) -> zenoh.Session:
    """A Zenoh session with a client's settings, or with exactly those of a file. The caller closes it.

    Raises ConfigurationError, or ServerGone when nothing answers there.
    """
    try:
        config = _configuration(endpoint, zenoh_config)
    except zenoh.ZError as error:
        if zenoh_config is not None:
            raise ConfigurationError(f"{zenoh_config}: {_words(error)}") from error
        raise ConfigurationError(f"{endpoint!r} is no endpoint, such as {wire.DEFAULT_ENDPOINT}") from error
    try:
        return zenoh.open(config)
    except zenoh.ZError as error:
        place = endpoint if zenoh_config is None else zenoh_config
        hint = "does `palpate serve` run there?"
        raise ServerGone(f"nothing answers at {place}: {_words(error)}; {hint}") from error


def _configuration(endpoint: str, zenoh_config: str | Path | None) -> zenoh.Config:
    if zenoh_config is not None:
        return zenoh.Config.from_file(zenoh_config)
    config = zenoh.Config()
    for key, value in {
        # Everything goes through the one endpoint, the server's or a router's; nothing is listened on.
        "mode": "client",
        "listen/endpoints": [],
        "connect/endpoints": [endpoint],
        "connect/timeout_ms": 2000,
        "connect/exit_on_failure": True,
        # Reconnect soon after a loss of the link.
        "connect/retry": {"period_init_ms": 100, "period_max_ms": 500, "period_increase_factor": 2},
        "transport/unicast/open_timeout": 2000,
        # The endpoint is known, so scouting is not needed.
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "transport/link/tx/lease": wire.LEASE_MS,
        "transport/link/tx/keep_alive": wire.KEEP_ALIVES,
    }.items():
        config.insert_json5(key, json.dumps(value))
    return config


def _words(error: zenoh.ZError) -> str:
    """Zenoh's message without the source locations."""
    return re.split(r" at /", str(error), maxsplit=1)[0]


def steps(duration_s: float, period_s: float) -> Iterator[int]:
    """Give 0, 1, 2, ..., one each period, for a duration that may be infinite. Deadlines count from the start, so that errors don't add up.

    They are multiples of the period on this machine's clock: the server's deadlines, which follow the commands, need not
    move when one loop takes over from another.
    """
    start = -(-time.monotonic() // period_s) * period_s
    for i in itertools.count() if math.isinf(duration_s) else range(round(duration_s / period_s)):
        wait = start + i * period_s - time.monotonic()
        if wait > 0:
            time.sleep(wait)
        yield i
