"""The server's answers to queries, without a session: what is asked for is carried out, or refused with a reason."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace, TracebackType
from typing import Any

import msgpack
import numpy as np
import pytest

from palpate.model_file import ReducedModel
from palpate_server import wire
from palpate_server.realtime import scheduler, shared_memory
from palpate_server.realtime.safety import Limits
from palpate_server.session import server as server_module
from palpate_server.session import state
from palpate_server.session.leases import Refused
from palpate_server.session.server import Server


class Query:
    """As much of a Zenoh query as an answer needs; keeps what it was answered."""

    def __init__(self, client: str, action: str, request: object) -> None:
        self.key_expr = f"palpate/test/control/{client}/{action}"
        self.payload = self
        self.attachment = None
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


class Sized(bytes):
    """As much of a Zenoh payload as the server looks at."""

    def to_bytes(self) -> bytes:
        return bytes(self)


@pytest.fixture
def server(make_spring_mass_model: Callable[..., ReducedModel], tmp_path: Path) -> Iterator[Server]:
    """Ticks, but is in no session."""
    server_module.warm_up(1e-3, 2)  # a change that is asked for gives up when no tick comes
    session: Any = None
    limits = Limits(10.0, 2000.0, 1.0, 0.1, 0.0)
    server = Server(make_spring_mass_model(2), limits, session, wire.Keys("test"), tmp_path)
    wake = os.eventfd(0)
    thread = threading.Thread(
        target=scheduler.run_at_deadlines, args=(server.service.image, wake), name="deadlines"
    )
    thread.start()
    yield server
    scheduler.stop(server.service.memory.shared)
    thread.join()
    os.close(wake)


def test_a_mistake_of_the_servers_is_answered_too(server: Server, caplog: pytest.LogCaptureFixture) -> None:
    query: Any = Query("first", "acquire", {"contacts": ["tip"]})
    server._answer_action(query)  # without a session it can't find out whether the client is alive
    assert [refusal["reason"] for refusal in query.refusals] == ["internal"]
    assert "AttributeError" in caplog.text


def test_acquiring_gives_all_contacts_or_leaves_all_as_they_were(
    server: Server, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(server.control, "_has_token", lambda client: True)
    server.service.leases.holders["tip1"] = "first"
    before = dict(server.service.leases.holders), dict(server.service.leases.terms)
    monkeypatch.setattr(scheduler, "is_silent", lambda image, contact: contact == 0)
    request = {"contacts": ["tip", "tip1"], "frame": {"scale": 2.0}}
    with pytest.raises(Refused, match="fade") as refusal:
        server.control.carry_out("first", "acquire", request)
    assert refusal.value.reason == "busy"
    assert (server.service.leases.holders, server.service.leases.terms) == before
    monkeypatch.undo()
    monkeypatch.setattr(server.control, "_has_token", lambda client: True)
    assert server.control.carry_out("first", "acquire", request)["contacts"] == ["tip", "tip1"]
    assert server.service.leases.holders == {"tip": "first", "tip1": "first"}


def test_while_forces_fade_for_a_new_hold_no_command_is_heard(
    server: Server, monkeypatch: pytest.MonkeyPatch
) -> None:
    server.service.leases.holders |= {"tip": "first", "tip1": "first"}
    command = wire.Command(1, 1, {"tip1": wire.STILL}, {"tip1": wire.STILL})
    assert server._why_refused(command, "first", [0, 0]) is None
    heard = []

    def listen(image: object, contact: int) -> bool:
        heard.append(server._why_refused(command, "first", [0, 0]))
        return True

    monkeypatch.setattr(scheduler, "is_silent", listen)
    monkeypatch.setattr(server.control, "_has_token", lambda client: True)
    server.control.carry_out("first", "acquire", {"contacts": ["tip", "tip1"]})
    assert heard == ["not_holder", "not_holder"]
    assert server._why_refused(command, "first", [0, 0]) is None


def test_too_many_waiting_queries_are_refused_at_once_and_a_lease_that_ends_is_heard_first(
    server: Server,
) -> None:
    take = server._queue_query(server._answer_action)
    queries: list[Any] = [Query("first", "explode", {}) for _ in range(server_module.MAX_WAITING + 1)]
    for query in queries:
        take(query)
    assert [len(query.refusals) for query in queries] == [0] * server_module.MAX_WAITING + [1]
    assert queries[-1].refusals[0]["reason"] == "busy"
    order: list[str] = []
    server._queue(server_module._LEASES_FIRST, lambda: order.append(str(len(queries[0].refusals))))
    server._queue(server_module._END, lambda: None)
    server._serve_events()
    assert order == ["0"]  # before the first query was answered
    assert {query.refusals[0]["reason"] for query in queries[:-1]} == {"unknown_action"}


def test_without_a_tick_a_change_is_refused_and_not_made_later_either(
    server: Server, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(state, "_CHANGE_TIMEOUT_S", 0.05)
    server.service.leases.holders["tip"] = "first"
    memory = server.service.memory
    scheduler.stop(memory.shared)
    (deadlines,) = (thread for thread in threading.enumerate() if thread.name == "deadlines")
    deadlines.join()
    for action, request in (("limits", {"limits": {"max_force_n": 1.0}}), ("reset", {})):
        with pytest.raises(Refused, match="no tick") as refusal:
            server.control.carry_out("first", action, request)
        assert refusal.value.reason == "busy"
    assert server.service.leases.terms["tip"].limits.max_force_n == 10.0
    memory.scale[:] = 0.5
    scheduler.repeat_tick(server.service.image, time.monotonic_ns())
    assert memory.limits[0, shared_memory.MAX_FORCE] == 10.0
    assert np.all(memory.scale > 0)  # a reset would have made it zero


def test_while_the_server_stops_changes_are_refused_at_once(server: Server) -> None:
    server.service.leases.holders["tip"] = "first"
    server.service.stopping.set()
    started = time.monotonic()
    for _ in range(20):
        with pytest.raises(Refused) as refusal:
            server.control.carry_out("first", "limits", {"limits": {"max_force_n": 1.0}})
        assert refusal.value.reason == "stopping"
    assert (
        time.monotonic() - started < 20 * state._CHANGE_TIMEOUT_S
    )  # which each of them would wait for a tick


def test_a_command_that_was_checked_before_its_contact_changed_hands_is_not_carried_out(
    server: Server, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The receiving thread can lose the processor between the check and the writing."""
    monkeypatch.setattr(server.control, "_has_token", lambda client: True)
    assert server.control.carry_out("first", "acquire", {"contacts": ["tip"]})
    check = server._why_refused

    def check_then_lose_the_contact(command: wire.Command, client: str, lease: list[int]) -> str | None:
        reason = check(command, client, lease)
        server.control.carry_out("first", "release", {})
        server.control.carry_out("second", "acquire", {"contacts": ["tip"]})
        return reason

    applied = server.service.memory.applied

    def sample(client: str, sequence: int, depth_m: float) -> Any:
        message = {"sequence": sequence, "client_time_ns": 1, "displacement_m": {"tip": [0.0, 0.0, depth_m]}}
        return SimpleNamespace(payload=Sized(wire.pack(message)), key_expr=f"palpate/test/command/{client}")

    monkeypatch.setattr(server, "_send_forces", lambda: None)
    monkeypatch.setattr(server, "_prepare_thread", lambda priority: [])
    monkeypatch.setattr(server, "_why_refused", check_then_lose_the_contact)
    server._on_command(sample("first", 1_000_000, 0.02))
    monkeypatch.setattr(server, "_why_refused", check)
    time.sleep(0.05)  # for what must not happen
    np.testing.assert_array_equal(applied, 0)
    assert server.service.messages.accepted == 1
    give_up = time.monotonic() + 60
    while not np.any(applied):
        assert time.monotonic() < give_up
        server._on_command(sample("second", server.service.messages.accepted, 1e-3))
        time.sleep(0.001)
    assert server.service.messages.accepted > 1
    np.testing.assert_array_equal(applied[0], (0.0, 0.0, 1e-3))


def test_while_a_model_is_loaded_nobody_acquires_and_the_other_way_round(
    server: Server, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(server.control, "_has_token", lambda client: True)
    server.service.leases.holders["tip"] = "first"
    answers = []

    def read(name: object) -> ReducedModel:
        with pytest.raises(Refused) as refusal:
            server.control.carry_out("second", "acquire", {"contacts": ["tip1"]})
        answers.append(refusal.value.reason)
        return server.service.model

    monkeypatch.setattr(server.control, "_read_model", read)
    server.control.carry_out("first", "load", {"model": "same.npz"})
    assert answers == ["busy"]
    assert server.control.carry_out("second", "acquire", {"contacts": ["tip1"]})
    with pytest.raises(Refused) as refusal:
        server.control.carry_out("first", "load", {"model": "same.npz"})
    assert refusal.value.reason == "held"


def test_naming_a_contact_twice_is_refused(server: Server) -> None:
    with pytest.raises(wire.MalformedMessage, match="twice"):
        server.control.carry_out("first", "acquire", {"contacts": ["tip"] * 3000})
