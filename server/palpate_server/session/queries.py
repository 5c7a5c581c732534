"""Answers queries and follows the clients' liveliness tokens, on one thread: in a Zenoh callback this work would stall the session."""

from __future__ import annotations

import itertools
import logging
import queue
import threading
from collections.abc import Callable

import zenoh

from palpate_client.wire import (
    ACTIONS,
    ENCODING,
    MAX_REQUEST_BYTES,
    SLOW_ACTIONS,
    Keys,
    Kind,
    MalformedMessage,
    check_size,
    is_name,
    last_chunk,
    pack,
)
from palpate_server.errors import Refused
from palpate_server.realtime import threads
from palpate_server.session.fields import read_request
from palpate_server.session.requests import Requests

log = logging.getLogger("palpate_server")

MAX_WAITING = 64  # queries; more are refused at once
_LEASES_FIRST, _QUERIES, _END = range(3)  # the order in which events are served


class Queries:
    """Answers every query for this session's keys: with its answer, or with a refusal.

    describe, geometry  give the payload of these answers
    on_change           called after a request was carried out
    """

    def __init__(
        self,
        keys: Keys,
        requests: Requests,
        describe: Callable[[], bytes],
        geometry: Callable[[], bytes],
        on_change: Callable[[], None],
    ) -> None:
        self._keys = keys
        self._requests = requests
        self._describe = describe
        self._geometry = geometry
        self._on_change = on_change
        self._events: queue.PriorityQueue[tuple[int, int, Callable[[], None]]] = queue.PriorityQueue()
        self._event_numbers = itertools.count()

    # Called by Zenoh's threads

    def take_describe(self, query: zenoh.Query) -> None:
        self._take(query, lambda: query.reply(self._keys.describe, self._describe(), encoding=ENCODING))

    def take_geometry(self, query: zenoh.Query) -> None:
        self._take(query, lambda: query.reply(self._keys.geometry, self._geometry(), encoding=ENCODING))

    def take_control(self, query: zenoh.Query) -> None:
        key = str(query.key_expr)
        self._take(query, lambda: self._carry_out(query, key), apart=last_chunk(key) in SLOW_ACTIONS)

    def take_liveliness(self, sample: zenoh.Sample) -> None:
        client, alive = last_chunk(str(sample.key_expr)), sample.kind == zenoh.SampleKind.PUT
        self._queue(_LEASES_FIRST, lambda: self._requests.on_client(client, alive))

    def _take(self, query: zenoh.Query, answer: Callable[[], None], apart: bool = False) -> None:
        """Queue a query. `apart`: answer it on a thread of its own, because it is slow; it may not change leases."""
        try:
            # Checked before it is queued, so that large queries do not fill the memory.
            parts = (query.payload, query.attachment)
            check_size(sum(len(part) for part in parts if part is not None), MAX_REQUEST_BYTES)
            if self._events.qsize() >= MAX_WAITING:
                raise Refused("busy", f"{MAX_WAITING} queries are waiting")
        except (MalformedMessage, Refused) as error:
            with query:
                _refuse(query, error.reason, str(error))
            return
        if apart:
            answer_apart = threading.Thread(target=_answer, args=(query, answer), daemon=True)
            self._queue(_QUERIES, answer_apart.start)
        else:
            self._queue(_QUERIES, lambda: _answer(query, answer))

    def _queue(self, urgency: int, event: Callable[[], None]) -> None:
        self._events.put((urgency, next(self._event_numbers), event))

    # Called by the queries' own thread

    def run(self) -> None:
        """Handle events one by one, until `end` is called."""
        threads.raise_priority(
            threads.SERVICE_PRIORITY
        )  # the deadline thread logs it when this is not allowed
        urgency = _QUERIES
        while urgency != _END:
            urgency, _, event = self._events.get()
            try:
                event()
            except Exception:  # one event must not end the thread that serves all of them
                log.exception("a query could not be answered")

    def end(self) -> None:
        """Have `run` return after the events that are already queued."""
        self._queue(_END, lambda: None)

    def _client_and_action(self, key: str) -> tuple[str, str]:
        """Of palpate/SESSION/control/CLIENT/ACTION. Raises Refused for any other key, such as one with wildcards."""
        prefix = self._keys.control("", "").rstrip("/")
        client, _, action = key.removeprefix(f"{prefix}/").partition("/")
        if not (key.startswith(f"{prefix}/") and is_name(client) and action in ACTIONS):
            known = self._keys.control("CLIENT", "ACTION")
            raise Refused(
                "unknown_action",
                f"the key is {key[:200]!r}: expected {known}, CLIENT 1 to 64 of A-Z a-z 0-9 _ -, ACTION one of "
                f"{', '.join(ACTIONS)}",
            )
        return client, action

    def _carry_out(self, query: zenoh.Query, key: str) -> None:
        client, action = self._client_and_action(key)
        payload = query.payload
        request = read_request(b"" if payload is None else payload.to_bytes())
        reply = self._requests.carry_out(client, action, request)
        query.reply(query.key_expr, pack({"kind": Kind.ANSWER} | reply), encoding=ENCODING)
        self._on_change()


def _answer(query: zenoh.Query, answer: Callable[[], None]) -> None:
    """Reply to a query in every case, so that the client does not wait for its timeout."""
    with query:
        try:
            answer()
        except (MalformedMessage, Refused) as error:
            _refuse(query, error.reason, str(error))
        except Exception:
            log.exception("a query could not be answered")
            _refuse(query, "internal", "internal error; see the server's log")


def _refuse(query: zenoh.Query, reason: str, message: str) -> None:
    payload = pack({"kind": Kind.REFUSAL, "reason": reason, "message": message})
    query.reply_err(payload, encoding=ENCODING)
