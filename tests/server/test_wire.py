"""Messages: what is read, what is refused and under which name, and that the page about them is true."""

from __future__ import annotations

import ast
import json
import re
import subprocess
import sys
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest
import zenoh
from hypothesis import given, settings
from hypothesis import strategies as st

from palpate.model_file import ReducedModel
from palpate_client.wire import (
    ACTIONS,
    DEFAULT_ENDPOINT,
    DROPPED,
    ENCODING,
    FORCE_FIELDS,
    KEEP_ALIVES,
    LEASE_MS,
    MALFORMED,
    MAX_COMMAND_BYTES,
    MAX_MESSAGE_BYTES,
    MAX_REQUEST_BYTES,
    NOT_GRANTED,
    PER_TICK,
    REFUSED,
    SCHEMA_VERSION,
    Flags,
    Keys,
    Kind,
    MalformedMessage,
    is_name,
    pack,
    unpack,
)
from palpate_server import codec
from palpate_server.errors import Refused
from palpate_server.realtime.records import PORT_RECORD, TICK
from palpate_server.realtime.safety import Limits
from palpate_server.recording.recorder import Recorder
from palpate_server.session.fields import read_request
from palpate_server.session.state import SessionState
from palpate_server.session.status import description, status

PAGE = Path(__file__).parents[2] / "docs" / "wire.md"
SERVER = Path(codec.__file__).parent
GOOD: dict[str, Any] = {
    "kind": "command",
    "sequence": 3,
    "client_time_ns": 5,
    "position_m": {"tip": [0.0, 1e-3, -2]},
}
MOVING: dict[str, Any] = GOOD | {
    "velocity_m_per_s": {"tip": [1.0, 2, 3]},
    "rendered_tick": 7,
    "attach": {"tip": True},
}

json_like = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**63), 2**64 - 1) | st.floats() | st.text() | st.binary(),
    lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner),
    max_leaves=20,
)


def without(message: dict[str, Any], field: str) -> dict[str, Any]:
    return {name: value for name, value in message.items() if name != field}


def with_unknown_field(value: bytes) -> bytes:
    """A good command with one more field, whose value is given as it is encoded."""
    return bytes([0x80 + len(GOOD) + 1]) + msgpack.packb(GOOD)[1:] + msgpack.packb("later") + value


def test_the_facts_of_the_wire_need_neither_numpy_nor_numba() -> None:
    script = "import sys, palpate_client.wire; sys.exit(bool({'numpy', 'numba'} & set(sys.modules)))"
    subprocess.run([sys.executable, "-c", script], check=True, timeout=60)


def test_a_command_is_read_as_it_was_meant() -> None:
    assert codec.decode_command(pack(GOOD)) == codec.Command(
        3, 5, {"tip": (0.0, 1e-3, -2.0)}, {"tip": codec.STILL}
    )
    assert codec.decode_command(pack(MOVING)) == codec.Command(
        3, 5, {"tip": (0.0, 1e-3, -2.0)}, {"tip": (1.0, 2.0, 3.0)}, 7, {"tip": True}
    )


@pytest.mark.parametrize("field", ["velocity_m_per_s", "rendered_tick", "attach"])
def test_nil_in_an_optional_field_is_the_field_left_out(field: str) -> None:
    left_out, nil = pack(without(MOVING, field)), pack(MOVING | {field: None})
    assert codec.decode_command(nil) == codec.decode_command(left_out)


def test_a_velocity_map_may_be_empty_or_name_some_of_the_tools() -> None:
    two = GOOD | {"position_m": {"a": [0, 0, 0], "b": [0, 0, 0]}}
    assert codec.decode_command(pack(GOOD | {"velocity_m_per_s": {}})) == codec.decode_command(pack(GOOD))
    velocity = codec.decode_command(pack(two | {"velocity_m_per_s": {"b": [0, 0, 1]}})).velocity_m_per_s
    assert velocity == {"a": codec.STILL, "b": (0.0, 0.0, 1.0)}


@pytest.mark.parametrize(
    "value", [b"\xc0", b"\x91\x01", msgpack.packb(msgpack.ExtType(5, b"x")), b"\xcf" + b"\xff" * 8]
)
def test_unknown_fields_are_ignored_so_that_the_schema_can_grow(value: bytes) -> None:
    assert codec.decode_command(with_unknown_field(value)) == codec.decode_command(pack(GOOD))


def test_of_a_field_that_stands_twice_the_last_one_counts() -> None:
    sequence = msgpack.packb("sequence")
    twice = bytes([0x80 + len(GOOD) + 1]) + sequence + b"\x01" + msgpack.packb(GOOD)[1:]
    assert codec.decode_command(twice).sequence == GOOD["sequence"]


def test_the_order_of_fields_does_not_matter() -> None:
    backwards = dict(reversed(GOOD.items()))
    assert codec.decode_command(pack(backwards)) == codec.decode_command(pack(GOOD))


@pytest.mark.parametrize(
    ("payload", "reason"),
    [
        (b"", "not_msgpack"),  # also that of a DELETE
        (b"\xc1", "not_msgpack"),
        (pack(GOOD)[:-3], "not_msgpack"),
        (pack(GOOD) + b"\x00", "not_msgpack"),
        (with_unknown_field(b"\xa2\xff\xfe"), "not_msgpack"),  # text that is not UTF-8
        (b"\x91" * 4000, "not_msgpack"),
        (msgpack.packb({1: 2}), "not_msgpack"),
        (msgpack.packb([1, 2]), "not_a_map"),
        (bytes(10_000_000), "too_large"),
        (pack(without(GOOD, "kind")), "wrong_kind"),
        (pack(GOOD | {"kind": "force"}), "wrong_kind"),
        (pack(GOOD | {"attach": {"tip": 1}}), "wrong_type"),
        (pack(GOOD | {"attach": ["tip"]}), "wrong_type"),
        (pack(GOOD | {"attach": {"tap": True}}), "wrong_shape"),
        (pack(GOOD | {"kind": ["command"]}), "wrong_kind"),
        (pack(without(GOOD, "sequence")), "missing_field"),
        (pack(without(GOOD, "position_m")), "missing_field"),
        (pack(GOOD | {"sequence": True}), "wrong_type"),
        (pack(GOOD | {"sequence": None}), "wrong_type"),
        (pack(GOOD | {"sequence": -1}), "wrong_type"),
        (pack(GOOD | {"sequence": 2**63}), "wrong_type"),
        (pack(GOOD | {"client_time_ns": 1.5}), "wrong_type"),
        (pack(GOOD | {"client_time_ns": 2**64 - 1}), "wrong_type"),
        (pack(GOOD | {"position_m": [0, 0, 0]}), "wrong_type"),
        (pack(GOOD | {"position_m": None}), "wrong_type"),
        (pack(GOOD | {"position_m": {}}), "wrong_shape"),
        (pack(GOOD | {"position_m": {"tip": [0, 0]}}), "wrong_shape"),
        (pack(GOOD | {"position_m": {"tip": [0, 0, 0, 0]}}), "wrong_shape"),
        (pack(GOOD | {"position_m": {"tip": [0, 0, "0"]}}), "wrong_type"),
        (pack(GOOD | {"position_m": {"tip": [0, 0, None]}}), "wrong_type"),
        (pack(GOOD | {"position_m": {"tip": [0, 0, True]}}), "wrong_type"),
        (pack(GOOD | {"velocity_m_per_s": {"tip": [0, 0]}}), "wrong_shape"),
        (pack(GOOD | {"velocity_m_per_s": {"other": [0, 0, 0]}}), "wrong_shape"),
        (pack(GOOD | {"rendered_tick": -1}), "wrong_type"),
        (pack(GOOD | {"rendered_tick": 2**63}), "wrong_type"),
    ],
)
def test_a_malformed_command_is_named_by_what_is_wrong(payload: bytes, reason: str) -> None:
    with pytest.raises(MalformedMessage) as caught:
        codec.decode_command(payload)
    assert caught.value.reason == reason
    assert reason in MALFORMED


def test_the_largest_integers_are_read() -> None:
    largest = GOOD | {"sequence": 2**63 - 1, "client_time_ns": 2**63 - 1, "rendered_tick": 2**63 - 1}
    command = codec.decode_command(pack(largest))
    assert (command.sequence, command.client_time_ns, command.rendered_tick) == (2**63 - 1,) * 3
    assert codec.decode_command(pack(GOOD | {"position_m": {"tip": [2**64 - 1, 0, 0]}})).position_m == {
        "tip": (2.0**64, 0.0, 0.0)
    }


@settings(max_examples=300, deadline=None)
@given(payload=st.binary(max_size=300))
def test_random_bytes_are_malformed_or_a_command_but_nothing_else(payload: bytes) -> None:
    try:
        codec.decode_command(payload)
    except MalformedMessage as error:
        assert error.reason in MALFORMED


@settings(max_examples=300, deadline=None)
@given(field=st.sampled_from(sorted(MOVING)), value=json_like, name=st.text(max_size=5))
def test_any_value_in_any_field_gives_a_whole_command_or_a_reason(
    field: str, value: object, name: str
) -> None:
    for replacement in (value, {name: value}, {name: [value, 0.0, value]}):
        try:
            command = codec.decode_command(msgpack.packb(MOVING | {field: replacement}))
        except MalformedMessage as error:
            assert error.reason in MALFORMED
        else:
            assert 0 <= command.sequence < 2**63
            assert command.velocity_m_per_s.keys() == command.position_m.keys()
            for vector in command.position_m.values():
                assert [type(number) for number in vector] == [float] * 3


@pytest.mark.parametrize(
    ("request_", "reason"),
    [
        (b"", "wrong_version"),
        (pack({}), "wrong_version"),
        (pack({"contacts": ["tip"]}), "wrong_version"),  # of schema version 1
        (pack({"kind": "request", "schema_version": 1}), "wrong_version"),
        (pack({"kind": "request", "schema_version": None}), "wrong_version"),
        (pack({"kind": "request", "schema_version": 2.0}), "wrong_version"),
        (pack({"kind": "request", "schema_version": 3}), "wrong_version"),
        (pack({"schema_version": 2}), "wrong_kind"),
        (pack({"kind": "command", "schema_version": 2}), "wrong_kind"),
        (msgpack.packb([2]), "not_a_map"),
        (b"\xc1", "not_msgpack"),
    ],
)
def test_a_request_of_another_version_or_kind_is_refused(request_: bytes, reason: str) -> None:
    with pytest.raises((Refused, MalformedMessage)) as caught:
        read_request(request_)
    assert caught.value.reason == reason  # type: ignore[attr-defined]


def test_a_client_of_version_1_is_told_what_to_do() -> None:
    with pytest.raises(Refused, match="upgrade") as caught:
        read_request(b"")
    assert all(word in str(caught.value) for word in ("tools", "position_m", "force_n"))


def test_a_message_of_another_kind_is_not_taken_for_one() -> None:
    encoder = codec.ForceEncoder(1)
    force = encoder.encode(*no_ticks(1))
    assert unpack(force, Kind.FORCE)["tick"] == 0
    with pytest.raises(MalformedMessage) as caught:
        unpack(force, Kind.STATUS)
    assert caught.value.reason == "wrong_kind"


@pytest.mark.parametrize("name", ["", "a/b", "*", "a b", "@a", "x" * 65, "a\n", "ä", None, 3])
def test_names_that_could_change_a_key_expression_are_refused(name: object) -> None:
    assert not is_name(name)


def no_ticks(n: int) -> Any:
    return codec.as_words(np.zeros(1, TICK))[0], codec.as_words(np.zeros(n, PORT_RECORD))


@settings(deadline=None)
@given(
    n_tools=st.integers(1, 40),
    tick=st.integers(0, 2**62),
    number=st.floats(allow_nan=False),
    integer=st.integers(-(2**63), 2**63 - 1),
)
def test_forces_carry_every_number_unchanged(n_tools: int, tick: int, number: float, integer: int) -> None:
    random = np.random.default_rng(tick % 1000)
    ports = np.zeros(n_tools, PORT_RECORD)
    of_tools = {name: kind for name, (numbers, kind) in FORCE_FIELDS.items() if numbers != PER_TICK}
    for name, kind in of_tools.items():
        shape = ports[name].shape
        ports[name] = random.integers(-1, 2**40, shape) if kind is int else random.normal(size=shape)
    ports["client_time_ns"][-1], ports["force_n"][-1, 1] = integer, number
    ticks = np.zeros(1, TICK)
    ticks["tick"], ticks["start_ns"], ticks["tissue_stored_j"], ticks["tissue_dissipated_j"] = (
        tick,
        10,
        0.5,
        number,
    )
    payload = codec.ForceEncoder(n_tools).encode(codec.as_words(ticks)[0], codec.as_words(ports))
    of_tick = {"tick": tick, "server_time_ns": 10, "tissue_stored_j": 0.5, "tissue_dissipated_j": number}
    expected = {name: ports[name].tolist() for name in of_tools} | of_tick
    assert msgpack.unpackb(payload) == {"kind": "force"} | expected


def test_surface_displacements_are_little_endian_float32() -> None:
    displacement = np.array([1.5, -2.25, 0.0], np.float32)
    message = unpack(codec.encode_surface(1, 2, displacement), Kind.SURFACE)
    np.testing.assert_array_equal(np.frombuffer(message["displacement_m"], "<f4"), displacement)


# The page


def _table(heading: str, number: int = 0) -> list[list[str]]:
    """Rows of a table below a heading of the page, the first one unless told otherwise, without its two header lines."""
    below = re.split(rf"^#+ {heading}$", PAGE.read_text(), flags=re.MULTILINE)[1].split("\n#")[0]
    table = re.findall(r"(?:^\|.*\n?)+", below, re.MULTILINE)[number]
    cells = [line.strip("|").split("|") for line in table.splitlines()]
    return [[cell.strip() for cell in row] for row in cells[2:]]


def _names(text: str) -> list[str]:
    """What is set as code."""
    return re.findall(r"`(\w+)`", text)


def _fields(heading: str, number: int = 0) -> list[str]:
    """All names in the first column of a table."""
    return [name for row in _table(heading, number) for name in _names(row[0])]


def _meaning(heading: str, field: str) -> list[str]:
    """The names in what a table says of a field."""
    (row,) = (row for row in _table(heading) if field in _names(row[0]))
    return _names(row[1])


def test_the_page_lists_exactly_the_flags_of_the_code() -> None:
    written = {row[1].strip("`"): int(row[0]) for row in _table("Flags")}
    assert written == {flag.name: flag.value for flag in Flags}


def test_the_page_lists_exactly_the_reasons_of_the_code() -> None:
    assert _fields("Counters") == ["refused", "malformed", "dropped"]
    assert set(_meaning("Counters", "malformed")) == set(MALFORMED)
    assert set(_meaning("Counters", "refused")) == set(REFUSED)
    assert set(_meaning("Counters", "dropped")) == set(DROPPED)


def _calls(file: str) -> list[ast.Call]:
    tree = ast.parse((SERVER / file).read_text())
    return [node for node in ast.walk(tree) if isinstance(node, ast.Call)]


def _texts(nodes: Iterable[ast.expr]) -> set[str]:
    return {node.value for node in nodes if isinstance(node, ast.Constant) and isinstance(node.value, str)}


def _named(node: ast.expr, name: str) -> bool:
    return isinstance(node, ast.Name) and node.id == name


def _session_files() -> list[str]:
    return [f"session/{path.name}" for path in (SERVER / "session").glob("*.py")] + ["recording/recorder.py"]


def test_the_page_lists_exactly_the_reasons_for_which_a_query_is_refused() -> None:
    calls = [call for file in _session_files() for call in _calls(file)]
    raised = _texts(call.args[0] for call in calls if _named(call.func, "Refused"))
    raised |= _texts(call.args[1] for call in calls if _named(call.func, "_refuse"))
    assert raised == set(NOT_GRANTED)
    assert sorted(_fields("Control", 1)) == sorted(raised | set(MALFORMED))
    assert all(len(_names(row[0])) == 1 for row in _table("Control", 1))


def test_the_page_lists_exactly_the_fields_that_control_requests_have() -> None:
    read: set[str] = set()
    for call in (call for file in ("session/fields.py", "session/requests.py") for call in _calls(file)):
        is_get = isinstance(call.func, ast.Attribute) and _named(call.func.value, "request")
        if is_get or (call.args and _named(call.args[0], "request")):
            read |= _texts(call.args)
    assert read > {"tools", "limits", "file"}
    written = {name for row in _table("Control") for name in _names(row[1])}
    assert written == read - {"schema_version"}  # which every request has


@pytest.fixture
def state(make_spring_mass_model: Callable[..., ReducedModel]) -> SessionState:
    limits = Limits(10.0, 2000.0, 1.0, 0.1, 0.0)
    return SessionState(make_spring_mass_model(2, 4), limits, Keys("test"), 1 / 30)


def test_the_page_lists_exactly_the_fields_of_a_status(state: SessionState) -> None:
    message = status(state, 1)
    assert sorted(_fields("Status")) == sorted(message)
    assert set(_meaning("Status", "model")) == message["model"].keys()
    assert set(_meaning("Status", "compute_time_s")) == message["compute_time_s"].keys()
    assert _fields("Status of a tool") == list(message["tools"]["tip"])


def test_the_page_lists_exactly_the_fields_of_a_recordings_report(
    tmp_path: Path, state: SessionState
) -> None:
    recorder = Recorder(
        tmp_path / "a.mcap", 10**6, state.keys, description(state), state.memory, lambda: None
    )
    recorder.stop()
    assert set(_meaning("Status", "recording")) - {"record"} == recorder.report().keys()


def test_the_page_lists_exactly_the_fields_of_a_description(state: SessionState) -> None:
    described = description(state)
    assert _fields("Describe") == [*described, "model_files"]  # which the server adds
    assert _meaning("Describe", "tools") == list(described["tools"][0])
    assert _meaning("Describe", "limits") == list(described["limits"])
    assert _meaning("Describe", "devices") == list(next(iter(described["devices"].values())))
    assert set(_meaning("Describe", "model")) <= described["model"].keys()


def test_the_page_lists_exactly_the_fields_of_geometry_and_surface() -> None:
    surface = (np.zeros((1, 3)), np.zeros((1, 3), np.int32))
    geometry = msgpack.unpackb(codec.encode_geometry(*surface, np.zeros(1, np.float32)))
    assert geometry.keys() - msgpack.unpackb(codec.encode_geometry(*surface)).keys() == {"error_in_band"}
    assert _fields("Geometry") == list(geometry)
    assert _fields("Surface") == list(msgpack.unpackb(codec.encode_surface(0, 0, np.zeros(3, np.float32))))


def test_the_settings_on_the_page_are_a_configuration_for_a_client() -> None:
    (block,) = re.findall(r"```json5\n(.*?)```", PAGE.read_text(), re.DOTALL)
    config = zenoh.Config.from_json5(block)
    expected = {
        "mode": "client",
        "connect/endpoints": [DEFAULT_ENDPOINT],
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "transport/link/tx/lease": LEASE_MS,
        "transport/link/tx/keep_alive": KEEP_ALIVES,
    }
    assert {key: json.loads(config.get_json(key)) for key in expected} == expected


def test_the_page_lists_the_keys_of_the_code() -> None:
    keys = Keys("SESSION")
    expected = {
        keys.server,
        keys.client("CLIENT"),
        keys.command("CLIENT"),
        keys.force,
        keys.status,
        keys.surface,
        keys.describe,
        keys.geometry,
        keys.control("CLIENT", "ACTION"),
    }
    assert {row[0].strip("`") for row in _table("Keys")} == expected


def test_the_page_lists_exactly_the_fields_of_a_force() -> None:
    message = msgpack.unpackb(codec.ForceEncoder(1).encode(*no_ticks(1)))
    assert [row[0].strip("`") for row in _table("Force")] == list(message)


def test_the_page_lists_exactly_the_fields_of_a_command() -> None:
    fields = [row[0].strip("`") for row in _table("Command")]
    assert fields == ["kind", *codec.Command._fields]


def test_the_page_lists_exactly_the_control_actions_of_the_code() -> None:
    assert [row[0].strip("`") for row in _table("Control")] == list(ACTIONS)


def test_the_page_names_the_schema_version_the_encoding_and_the_size_limit() -> None:
    text = PAGE.read_text()
    assert f"schema version {SCHEMA_VERSION}" in text
    assert ENCODING in text
    assert f"{MAX_COMMAND_BYTES} bytes" in text
    assert f"{MAX_REQUEST_BYTES} bytes" in text
    assert f"{MAX_MESSAGE_BYTES} bytes" in text
