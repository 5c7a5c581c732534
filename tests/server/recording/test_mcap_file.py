"""The MCAP file: what is written can be read, bit for bit, in a form that Foxglove opens."""

from __future__ import annotations

import io
import json
import subprocess
import sys
from pathlib import Path

import msgpack
import numpy as np
import pytest
from mcap.reader import make_reader

from palpate_server.realtime.records import COMMAND, PORT, PORT_RECORD, SETTINGS, TICK
from palpate_server.recording.json_records import as_objects, from_objects
from palpate_server.recording.mcap_file import Recording


def random_records(record: np.dtype[np.void], n: int) -> np.ndarray:
    random = np.random.default_rng(0)
    records = np.zeros(n, record)
    for name in record.names or ():
        shape = records[name].shape
        integers, numbers = random.integers(-1, 2**62, shape), random.normal(size=shape)
        records[name] = integers if record[name].base.kind == "i" else numbers
    return records


@pytest.mark.parametrize("record", [COMMAND, SETTINGS, PORT, TICK, PORT_RECORD])
def test_records_are_the_same_after_being_written_as_json_and_read(record: np.dtype[np.void]) -> None:
    records = random_records(record, 7)
    again = from_objects(json.loads(json.dumps(as_objects(records))), record)
    assert again.tobytes() == records.tobytes()


def written() -> tuple[io.BytesIO, np.ndarray, np.ndarray]:
    """A recording of three ticks of two tools, and their records."""
    stream = io.BytesIO()
    recording = Recording(stream)
    ticks, ports = random_records(TICK, 3), random_records(PORT_RECORD, 6)
    ticks["start_ns"] = [1, 2, 3]
    recording.add_ticks("palpate/test/tick", 100, ticks.tobytes(), ports.tobytes())
    recording.add("status", "palpate/test/status", 104, {"state": "running", "a": [1.5, float("nan")]})
    recording.finish()
    assert recording.messages == 4
    stream.seek(0)
    return stream, ticks, ports


def test_ticks_are_in_the_file_with_all_their_tools_and_times() -> None:
    stream, ticks, ports = written()
    messages = [
        (channel.topic, message.log_time, json.loads(message.data))
        for _, channel, message in make_reader(stream, validate_crcs=True).iter_messages()
    ]
    assert [(topic, time_ns) for topic, time_ns, _ in messages] == [
        *(("palpate/test/tick", time_ns) for time_ns in (101, 102, 103)),
        ("palpate/test/status", 104),
    ]
    assert [message["tick"] for *_, message in messages[:3]] == ticks["tick"].tolist()
    assert messages[1][2]["tools"][1]["force_n"]["z"] == ports["force_n"][3, 2]
    assert messages[3][2] == {"state": "running", "a": [1.5, None]}


@pytest.mark.parametrize("kind", ["tick", "settings", "status", "describe"])
def test_schemas_are_such_that_foxglove_opens_the_topic(kind: str) -> None:
    """It refuses arrays of arrays, and objects that do not say what is in them."""
    summary = make_reader(written()[0]).get_summary()
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


def test_a_device_that_is_full_ends_the_process_with_its_reason() -> None:
    statuses = [
        msgpack.packb(("message", "status", "k", i, msgpack.packb({"filler": i}))) for i in range(2000)
    ]
    with Path("/dev/full").open("wb") as full:
        done = subprocess.run(
            [sys.executable, "-m", "palpate_server.recording.mcap_file", str(10**9)],
            input=b"".join(statuses),
            stdout=full,
            stderr=subprocess.PIPE,
            timeout=120,
            check=False,
        )
    assert done.returncode == 1
    assert done.stderr.decode().splitlines()[-1] == "No space left on device"
