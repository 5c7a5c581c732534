"""The MCAP file: what is written can be read, and no payload of a client ends a recording."""

from __future__ import annotations

import io
import json
from typing import Any

import msgpack
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader

from palpate_server.recording import Recording


def recorded(*payloads: bytes) -> list[dict[str, Any]]:
    stream = io.BytesIO()
    recording = Recording(stream)
    for i, payload in enumerate(payloads):
        recording.add("command", "palpate/test/command/c", i, payload)
    recording.finish()
    stream.seek(0)
    messages = [json.loads(message.data) for _, _, message in make_reader(stream).iter_messages()]
    assert recording.messages == len(messages)
    return messages


def test_numbers_that_are_not_finite_become_null_and_bytes_hexadecimal() -> None:
    message = {"a": [1.5, float("nan"), float("-inf")], "b": b"\x01\xff", "c": {"d": True}}
    assert recorded(msgpack.packb(message)) == [{"a": [1.5, None, None], "b": "01ff", "c": {"d": True}}]


@pytest.mark.parametrize(
    "payload",
    [
        b"",
        b"\xc1",
        msgpack.packb([1]),
        msgpack.packb({1: 2}),
        msgpack.packb({"a": msgpack.ExtType(5, b"x")}),
        msgpack.packb({"a": msgpack.Timestamp(1)}),
        b"\x81\xa1a" + b"\x91" * 1000 + b"\xc0",
        b"\x81\xa1a" + b"\x91" * 4000,
    ],
)
def test_a_payload_that_json_cannot_hold_is_left_out_and_the_next_one_is_written(payload: bytes) -> None:
    assert recorded(payload, msgpack.packb({"a": 1})) == [{"a": 1}]


@settings(deadline=None)
@given(st.binary(max_size=200))
def test_no_bytes_at_all_end_a_recording(payload: bytes) -> None:
    assert recorded(payload, msgpack.packb({"a": 1}))[-1] == {"a": 1}
