"""The server's answers to queries, without a session: what is asked for is carried out, or refused with a reason."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import Any

import msgpack
import pytest

from palpate.model import ReducedModel
from palpate_server import wire
from palpate_server.safety import Limits
from palpate_server.server import Server


class Query:
    """As much of a Zenoh query as an answer needs; keeps what it was answered."""

    def __init__(self, action: str, request: object) -> None:
        self.key_expr = f"palpate/test/control/{action}"
        self.payload = self
        self._request = msgpack.packb(request)
        self.refusals: list[dict[str, Any]] = []

    def __len__(self) -> int:
        return len(self._request)

    def to_bytes(self) -> bytes:
        return self._request

    def reply_err(self, payload: bytes, encoding: str) -> None:
        assert encoding == wire.ENCODING
        self.refusals.append(msgpack.unpackb(payload))

    def __enter__(self) -> Query:
        return self

    def __exit__(self, *_: type[BaseException] | BaseException | TracebackType | None) -> None:
        pass


@pytest.fixture
def server(make_spring_mass_model: Callable[..., ReducedModel], tmp_path: Path) -> Server:
    session: Any = None  # nothing here reaches the network
    limits = Limits(10.0, 2000.0, 1.0, 0.1, 0.0)
    return Server(make_spring_mass_model(2), limits, session, wire.Keys("test"), tmp_path)


def test_a_mistake_of_the_servers_is_answered_too(server: Server, caplog: pytest.LogCaptureFixture) -> None:
    query: Any = Query("acquire", {"client": "first", "contacts": ["tip"]})
    server._answer_action(query)  # without a session it can't find out whether the client is alive
    assert [refusal["reason"] for refusal in query.refusals] == ["internal"]
    assert "AttributeError" in caplog.text
