"""The server's answers to queries, without a session: what is asked for is carried out, or refused with a reason."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import Any

import msgpack
import pytest

from palpate.model import ReducedModel
from palpate_server import server as server_module
from palpate_server import wire
from palpate_server.leases import Refused
from palpate_server.safety import Limits
from palpate_server.server import Server


class Query:
    """As much of a Zenoh query as an answer needs; keeps what it was answered."""

    def __init__(self, client: str, action: str, request: object) -> None:
        self.key_expr = f"palpate/test/control/{client}/{action}"
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
    query: Any = Query("first", "acquire", {"contacts": ["tip"]})
    server._answer_action(query)  # without a session it can't find out whether the client is alive
    assert [refusal["reason"] for refusal in query.refusals] == ["internal"]
    assert "AttributeError" in caplog.text


def test_acquiring_gives_all_contacts_or_leaves_all_as_they_were(
    server: Server, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(server, "_check_alive", lambda client: None)
    server.leases.holders["tip1"] = "first"
    before = dict(server.leases.holders), dict(server.leases.terms)
    server.memory.scale[1] = 1.0  # and no loop runs that could let it fade
    request = {"contacts": ["tip", "tip1"], "frame": {"scale": 2.0}}
    with pytest.raises(Refused, match="fade") as refusal:
        server._carry_out("first", "acquire", request)
    assert refusal.value.reason == "busy"
    assert (server.leases.holders, server.leases.terms) == before
    server.memory.scale[1] = 0.0
    assert server._carry_out("first", "acquire", request)["contacts"] == ["tip", "tip1"]
    assert server.leases.holders == {"tip": "first", "tip1": "first"}


def test_while_forces_fade_for_a_new_hold_no_command_is_heard(
    server: Server, monkeypatch: pytest.MonkeyPatch
) -> None:
    server.leases.holders |= {"tip": "first", "tip1": "first"}
    command = wire.Command(1, 1, {"tip1": wire.STILL}, {"tip1": wire.STILL})
    assert server._why_refused(command, "first") is None
    heard = []

    def listen(image: object, contact: int) -> bool:
        heard.append(server._why_refused(command, "first"))
        return True

    monkeypatch.setattr(server_module.loop, "is_silent", listen)
    monkeypatch.setattr(server, "_check_alive", lambda client: None)
    server._carry_out("first", "acquire", {"contacts": ["tip", "tip1"]})
    assert heard == ["not_holder", "not_holder"]
    assert server._why_refused(command, "first") is None
