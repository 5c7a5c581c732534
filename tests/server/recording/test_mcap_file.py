"""The MCAP file: what is written can be read, and no payload of a client ends a recording."""

from __future__ import annotations

import io
import json
from typing import Any

import msgpack
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader

from palpate_server import wire
from palpate_server.recording.mcap_file import Recording, from_json


def recorded(*payloads: bytes) -> list[dict[str, Any]]:
    stream = write("command", *payloads)
    messages = [json.loads(message.data) for _, _, message in make_reader(stream).iter_messages()]
    return messages


def write(kind: str, *payloads: bytes) -> io.BytesIO:
    stream = io.BytesIO()
    recording = Recording(stream)
    for i, payload in enumerate(payloads):
        recording.add(kind, f"palpate/test/{kind}", i, payload)
    recording.finish()
    stream.seek(0)
    summary = make_reader(stream).get_summary()
    assert summary is not None
    assert summary.statistics is not None
    assert recording.messages == summary.statistics.message_count
    stream.seek(0)
    return stream


def test_a_force_is_the_same_after_being_written_and_read() -> None:
    inputs = np.arange(8, dtype=np.int64).reshape(2, 4)
    motion = np.random.default_rng(0).normal(size=(2, 8))
    payload = wire.ForceEncoder(2).encode(3, 4, inputs, motion)
    ((_, _, message),) = make_reader(write("force", payload)).iter_messages()
    assert json.loads(message.data)["force_n"][1]["z"] == motion[1, 5]
    assert from_json("force", message.data) == msgpack.unpackb(payload)


@pytest.mark.parametrize("kind", ["command", "force", "status", "describe"])
def test_schemas_are_such_that_foxglove_opens_the_topic(kind: str) -> None:
    """It refuses arrays of arrays, and objects that do not say what is in them."""
    summary = make_reader(write("command", msgpack.packb({"a": 1}))).get_summary()
    assert summary is not None
    (schema,) = (s for s in summary.schemas.values() if s.name == f"palpate.{kind}")
    waiting = [json.loads(schema.data)]
    assert waiting[0]["type"] == "object"
    while waiting:
        part = waiting.pop()
        if part["type"] == "object":
            waiting += part["properties"].values()
        elif part["type"] == "array":
            assert part["items"]["type"] != "array"
            waiting.append(part["items"])


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
