"""What a recorder notices about what it hears."""

from __future__ import annotations

import contextlib
import io
import itertools
import threading
import time

import msgpack

from palpate_client import wire
from palpate_client.connection import open_session
from palpate_client.local_server import free_endpoint
from palpate_server.realtime.safety import Flags
from palpate_server.recording.mcap_file import Recording
from palpate_server.recording.record import Hearing, record
from palpate_server.session import transport


def force(sequence: int, flags: int = 0) -> bytes:
    return msgpack.packb({"kind": "force", "sequence": [-1, sequence], "flags": [int(Flags.STALE), flags]})


def notices(*messages: tuple[str, bytes]) -> int:
    hearing = Hearing()
    return sum(hearing.misses_commands(kind, payload) for kind, payload in messages)


def test_forces_that_answer_commands_nobody_hears_are_noticed_once() -> None:
    assert notices(*[("force", force(i)) for i in range(5000)]) == 1


def test_forces_are_as_expected_while_commands_are_heard_or_nobody_sends_any() -> None:
    heard = [message for i in range(5000) for message in (("command", b""), ("force", force(i)))]
    assert notices(*heard) == 0
    assert notices(*[("force", force(-1, Flags.STALE))] * 5000) == 0
    assert notices(*[("force", force(7, Flags.HELD | Flags.STALE))] * 5000) == 0
    assert notices(*[("force", b"no force")] * 5000) == 0


def test_a_recording_without_the_commands_that_were_answered_is_told_of_while_it_runs() -> None:
    keys, endpoint = wire.Keys("test"), free_endpoint()
    told = threading.Event()
    give_up = time.monotonic() + 20
    with (
        transport.open_session(endpoint, None) as server,
        contextlib.closing(open_session(endpoint)) as client,
    ):
        stop = threading.Event()

        def send() -> None:
            for i in itertools.count():
                server.put(keys.force, force(i))
                if stop.wait(1e-3):
                    break

        sender = threading.Thread(target=send)
        sender.start()
        record(
            client,
            keys,
            Recording(io.BytesIO()),
            msgpack.packb({}),
            lambda: told.is_set() or time.monotonic() > give_up,
            told.set,
        )
        stop.set()
        sender.join()
    assert told.is_set()
