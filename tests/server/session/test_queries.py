"""Queries without Zenoh: every one is answered, whatever its key, and none fills the log."""

from __future__ import annotations

import logging
from types import SimpleNamespace, TracebackType
from typing import Any

import msgpack
import pytest
import zenoh

from palpate.files import printable
from palpate_client.wire import ENCODING, Keys, pack
from palpate_server.session.log_limit import MOST_LINES, OneLine, RateLimit
from palpate_server.session.queries import MAX_WAITING, Queries

REQUEST = pack({"kind": "request", "schema_version": 2})


class Query:
    """As much of a Zenoh query as an answer needs; keeps what it was answered."""

    def __init__(self, key: str, payload: bytes = REQUEST) -> None:
        self.key_expr = key
        self.payload = self
        self.attachment = None
        self._payload = payload
        self.answers: list[dict[str, Any]] = []

    def __len__(self) -> int:
        return len(self._payload)

    def to_bytes(self) -> bytes:
        return self._payload

    def reply(self, key: str, payload: bytes, encoding: str) -> None:
        assert encoding == ENCODING
        assert "*" not in key
        self.answers.append(msgpack.unpackb(payload))

    def reply_err(self, payload: bytes, encoding: str) -> None:
        assert encoding == ENCODING
        self.answers.append(msgpack.unpackb(payload))

    def __enter__(self) -> Query:
        return self

    def __exit__(self, *_: type[BaseException] | BaseException | TracebackType | None) -> None:
        pass


class Requests:
    """Notes what is asked for, in order; `fails` as a mistake of the server's would."""

    def __init__(self) -> None:
        self.order: list[str] = []

    def on_client(self, client: str, alive: bool) -> None:
        self.order.append(f"{client} {alive}")

    def carry_out(self, client: str, action: str, request: dict[str, Any]) -> dict[str, Any]:
        self.order.append(f"{client} {action}")
        if client == "fails":
            raise AttributeError("a mistake")
        return {}


@pytest.fixture
def requests() -> Any:
    return Requests()


@pytest.fixture
def queries(requests: Any) -> Queries:
    keys = Keys("test")
    return Queries(
        keys, requests, lambda: pack({"kind": "describe"}), lambda: pack({"kind": "geometry"}), lambda: None
    )


def ask(queries: Queries, *asked: Any) -> list[dict[str, Any]]:
    """The answers to control queries."""
    for query in asked:
        queries.take_control(query)
    queries.end()
    queries.run()
    return [answer for query in asked for answer in query.answers]


@pytest.mark.parametrize(
    "key",
    [
        "palpate/**",
        "palpate/test/control/**",
        "palpate/test/control/*/*",
        "palpate/*/control/first/release",
        "palpate/test/control/first/*",
        "palpate/test/control/no.body/acquire",
        "palpate/test/control/first/explode",
        "**",
    ],
)
def test_a_query_for_no_declared_action_is_refused(queries: Queries, requests: Any, key: str) -> None:
    (answer,) = ask(queries, Query(key))
    assert (answer["kind"], answer["reason"]) == ("refusal", "unknown_action")
    assert not requests.order


def test_an_answer_has_its_kind(queries: Queries, requests: Any) -> None:
    assert ask(queries, Query("palpate/test/control/first/release")) == [{"kind": "answer"}]
    assert requests.order == ["first release"]


def test_wildcards_that_match_what_is_described_are_answered(queries: Queries) -> None:
    describe: Any = Query("palpate/**")
    geometry: Any = Query("palpate/**")
    queries.take_describe(describe)
    queries.take_geometry(geometry)
    queries.end()
    queries.run()
    assert [query.answers[0]["kind"] for query in (describe, geometry)] == ["describe", "geometry"]


def test_a_mistake_of_the_servers_is_answered_too(queries: Queries, caplog: pytest.LogCaptureFixture) -> None:
    (answer,) = ask(queries, Query("palpate/test/control/fails/reset"))
    assert answer["reason"] == "internal"
    assert "AttributeError" in caplog.text


def test_a_query_that_is_too_large_is_refused_before_it_waits(queries: Queries, requests: Any) -> None:
    (answer,) = ask(queries, Query("palpate/test/control/first/reset", bytes(20_000)))
    assert answer["reason"] == "too_large"
    assert not requests.order


def test_too_many_waiting_queries_are_refused_at_once_and_a_lease_that_ends_is_served_first(
    queries: Queries, requests: Any
) -> None:
    asked: list[Any] = [Query("palpate/test/control/first/reset") for _ in range(MAX_WAITING + 1)]
    for query in asked:
        queries.take_control(query)
    assert [len(query.answers) for query in asked] == [0] * MAX_WAITING + [1]
    assert asked[-1].answers[0]["reason"] == "busy"
    gone: Any = SimpleNamespace(key_expr="palpate/test/client/second", kind=zenoh.SampleKind.DELETE)
    queries.take_liveliness(gone)
    queries.end()
    queries.run()
    assert requests.order == ["second False"] + ["first reset"] * MAX_WAITING
    assert all(query.answers == [{"kind": "answer"}] for query in asked[:-1])


@pytest.fixture
def limited(caplog: pytest.LogCaptureFixture) -> logging.Logger:
    caplog.handler.addFilter(RateLimit())
    return logging.getLogger("palpate_server")


def test_lines_of_one_kind_are_limited_and_others_are_not(
    limited: logging.Logger, caplog: pytest.LogCaptureFixture
) -> None:
    for i in range(1000):
        limited.warning("client %s is gone", i)
    limited.warning("something else")
    assert len(caplog.records) == MOST_LINES + 1


def test_the_next_line_says_how_many_were_left_out(
    limited: logging.Logger, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    now = 100.0
    monkeypatch.setattr("palpate_server.session.log_limit.time.monotonic", lambda: now)
    for _ in range(1000):
        limited.warning("again")
    now = 200.0
    limited.warning("again")
    assert f"({1000 - MOST_LINES} more of this kind" in caplog.records[-1].getMessage()


def test_a_name_reaches_a_terminal_escaped_and_on_one_line() -> None:
    record = logging.LogRecord("x", logging.INFO, "", 0, "model %s", ("a\x1b[31m\nb\u202e\x00c",), None)
    assert OneLine("%(message)s").format(record) == "model a\\x1b[31m\\nb\\u202e\\x00c"
    assert printable("Leber, größe 3") == "Leber, größe 3"
