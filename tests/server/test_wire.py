"""Messages: what is read, what is refused and under which name, and that the page about them is true."""

from __future__ import annotations

import ast
import json
import math
import re
from collections.abc import Callable, Iterable
from pathlib import Path

import msgpack
import numpy as np
import pytest
import zenoh
from hypothesis import given, settings
from hypothesis import strategies as st

from palpate.model_file import ReducedModel
from palpate_server import wire
from palpate_server.realtime.safety import Flags, Limits
from palpate_server.recording.recorder import Recorder
from palpate_server.session import transport
from palpate_server.session.state import Service

PAGE = Path(__file__).parents[2] / "docs" / "wire.md"
GOOD = {"sequence": 3, "client_time_ns": 5, "displacement_m": {"tip": [0.0, 1e-3, -2]}}

json_like = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**63), 2**64 - 1) | st.floats() | st.text() | st.binary(),
    lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner),
    max_leaves=20,
)


def test_a_command_is_read_as_it_was_meant() -> None:
    command = wire.decode_command(msgpack.packb(GOOD))
    assert command == wire.Command(3, 5, {"tip": (0.0, 1e-3, -2.0)}, {"tip": wire.STILL})
    assert wire.is_finite(command)


def test_unknown_fields_are_ignored_so_that_the_schema_can_grow() -> None:
    assert wire.decode_command(msgpack.packb(GOOD | {"later": [1]})).sequence == 3


@pytest.mark.parametrize(
    ("payload", "reason"),
    [
        (b"", "not_msgpack"),
        (b"\xc1", "not_msgpack"),
        (msgpack.packb(GOOD)[:-3], "not_msgpack"),
        (msgpack.packb(GOOD) + b"\x00", "not_msgpack"),
        (b"\x91" * 4000, "not_msgpack"),
        (msgpack.packb([1, 2]), "not_a_map"),
        (msgpack.packb({1: 2}), "not_msgpack"),
        (bytes(10_000_000), "too_large"),
        (msgpack.packb({k: v for k, v in GOOD.items() if k != "sequence"}), "missing_field"),
        (msgpack.packb(GOOD | {"sequence": True}), "wrong_type"),
        (msgpack.packb(GOOD | {"sequence": -1}), "wrong_type"),
        (msgpack.packb(GOOD | {"sequence": 2**63}), "wrong_type"),
        (msgpack.packb(GOOD | {"client_time_ns": 1.5}), "wrong_type"),
        (msgpack.packb(GOOD | {"displacement_m": [0, 0, 0]}), "wrong_type"),
        (msgpack.packb(GOOD | {"displacement_m": {}}), "wrong_shape"),
        (msgpack.packb(GOOD | {"displacement_m": {"tip": [0, 0]}}), "wrong_shape"),
        (msgpack.packb(GOOD | {"displacement_m": {"tip": [0, 0, 0, 0]}}), "wrong_shape"),
        (msgpack.packb(GOOD | {"displacement_m": {"tip": [0, 0, "0"]}}), "wrong_type"),
        (msgpack.packb(GOOD | {"displacement_m": {"tip": [0, 0, None]}}), "wrong_type"),
        (msgpack.packb(GOOD | {"velocity_m_per_s": {"tip": [0, 0]}}), "wrong_shape"),
        (msgpack.packb(GOOD | {"velocity_m_per_s": {"other": [0, 0, 0]}}), "wrong_shape"),
        (msgpack.packb(GOOD | {"rendered_tick": -1}), "wrong_type"),
    ],
)
def test_a_malformed_command_is_named_by_what_is_wrong(payload: bytes, reason: str) -> None:
    with pytest.raises(wire.MalformedMessage) as caught:
        wire.decode_command(payload)
    assert caught.value.reason == reason
    assert reason in wire.MALFORMED


@settings(max_examples=300, deadline=None)
@given(payload=st.binary(max_size=300))
def test_random_bytes_are_malformed_or_a_command_but_nothing_else(payload: bytes) -> None:
    try:
        wire.decode_command(payload)
    except wire.MalformedMessage as error:
        assert error.reason in wire.MALFORMED


@settings(max_examples=300, deadline=None)
@given(field=st.sampled_from(sorted(GOOD)), value=json_like, name=st.text(max_size=5))
def test_any_value_in_any_field_gives_a_whole_command_or_a_reason(
    field: str, value: object, name: str
) -> None:
    for replacement in (value, {name: value}, {name: [value, 0.0, value]}):
        try:
            command = wire.decode_command(msgpack.packb(GOOD | {field: replacement}))
        except wire.MalformedMessage as error:
            assert error.reason in wire.MALFORMED
        else:
            assert 0 <= command.sequence < 2**63
            for vector in command.displacement_m.values():
                assert [type(number) for number in vector] == [float] * 3


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_numbers_that_are_not_finite_are_recognized(bad: float) -> None:
    for axis in range(3):
        vector = [0.0, 0.0, 0.0]
        vector[axis] = bad
        command = wire.decode_command(msgpack.packb(GOOD | {"displacement_m": {"tip": vector}}))
        assert not wire.is_finite(command)


@pytest.mark.parametrize("field", ["displacement_m", "velocity_m_per_s"])
@pytest.mark.parametrize(("value", "in_range"), [(1e3, True), (1000.1, False), (1.797e308, False)])
def test_numbers_that_no_device_gives_are_recognized(field: str, value: float, in_range: bool) -> None:
    for axis in range(3):
        for sign in (-1.0, 1.0):
            vector = [0.0, 0.0, 0.0]
            vector[axis] = sign * value
            command = wire.decode_command(msgpack.packb(GOOD | {field: {"tip": vector}}))
            assert wire.is_finite(command)
            assert wire.is_in_range(command) == in_range


@pytest.mark.parametrize("name", ["", "a/b", "*", "a b", "@a", "x" * 65, None, 3])
def test_names_that_could_change_a_key_expression_are_refused(name: object) -> None:
    assert not wire.is_name(name)


@settings(deadline=None)
@given(
    n_contacts=st.integers(1, 40),
    tick=st.integers(0, 2**62),
    number=st.floats(allow_nan=False),
    integer=st.integers(-(2**63), 2**63 - 1),
)
def test_forces_carry_every_number_unchanged(n_contacts: int, tick: int, number: float, integer: int) -> None:
    random = np.random.default_rng(tick % 1000)
    inputs = random.integers(-1, 2**40, (n_contacts, 4))
    motion = random.normal(size=(n_contacts, 8))
    inputs[-1, 1], motion[-1, 4] = integer, number
    payload = wire.ForceEncoder(n_contacts).encode(tick, 10, inputs, motion)
    assert msgpack.unpackb(payload) == {
        "tick": tick,
        "server_time_ns": 10,
        "sequence": inputs[:, 0].tolist(),
        "client_time_ns": inputs[:, 1].tolist(),
        "input_age_ns": inputs[:, 2].tolist(),
        "flags": inputs[:, 3].tolist(),
        "displacement_m": motion[:, 0:3].tolist(),
        "force_n": motion[:, 3:6].tolist(),
        "force_scale": motion[:, 6].tolist(),
        "energy_j": motion[:, 7].tolist(),
    }


def test_surface_displacements_are_little_endian_float32() -> None:
    displacement = np.array([1.5, -2.25, 0.0], np.float32)
    message = msgpack.unpackb(wire.encode_surface(1, 2, displacement))
    np.testing.assert_array_equal(np.frombuffer(message["displacement_m"], "<f4"), displacement)


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
    assert set(_meaning("Counters", "malformed")) == set(wire.MALFORMED)
    assert set(_meaning("Counters", "refused")) == set(wire.REFUSED)
    assert set(_meaning("Counters", "dropped")) == set(wire.DROPPED)


def _calls(file: str) -> list[ast.Call]:
    tree = ast.parse((Path(wire.__file__).parent / file).read_text())
    return [node for node in ast.walk(tree) if isinstance(node, ast.Call)]


def _texts(nodes: Iterable[ast.expr]) -> set[str]:
    return {node.value for node in nodes if isinstance(node, ast.Constant) and isinstance(node.value, str)}


def _named(node: ast.expr, name: str) -> bool:
    return isinstance(node, ast.Name) and node.id == name


def test_the_page_lists_exactly_the_reasons_for_which_a_query_is_refused() -> None:
    raised: set[str] = set()
    for file in ("session/requests.py", "session/leases.py", "recording/recorder.py", "session/state.py"):
        raised |= _texts(call.args[0] for call in _calls(file) if _named(call.func, "Refused"))
    raised |= _texts(call.args[1] for call in _calls("server.py") if _named(call.func, "_refuse"))
    assert raised == set(wire.NOT_GRANTED)
    assert set(_fields("Control", 1)) == raised | set(wire.MALFORMED)


def test_the_page_lists_exactly_the_fields_that_control_requests_have() -> None:
    read: set[str] = set()
    for call in _calls("session/requests.py"):
        is_get = isinstance(call.func, ast.Attribute) and _named(call.func.value, "request")
        if is_get or (call.args and _named(call.args[0], "request")):
            read |= _texts(call.args)
    assert read
    written = [name for row in _table("Control") for name in _names(row[1])]
    assert sorted(written) == sorted(read)


@pytest.fixture
def service(make_spring_mass_model: Callable[..., ReducedModel]) -> Service:
    limits = Limits(10.0, 2000.0, 1.0, 0.1, 0.0)
    return Service(make_spring_mass_model(2, 4), limits, wire.Keys("test"), 1 / 30)


def test_the_page_lists_exactly_the_fields_of_a_status(service: Service) -> None:
    status = service.status()
    assert sorted(_fields("Status")) == sorted(status)
    assert set(_meaning("Status", "model")) == status["model"].keys()
    assert set(_meaning("Status", "compute_time_s")) == status["compute_time_s"].keys()
    assert _fields("Status of a contact") == list(status["contacts"]["tip"])


def test_the_page_lists_exactly_the_fields_of_a_recordings_report(tmp_path: Path, service: Service) -> None:
    recorder = Recorder(tmp_path / "a.mcap", service.keys, service.describe(), service.memory)
    recorder.stop()
    assert set(_meaning("Status", "recording")) - {"record"} == recorder.report().keys()


def test_the_page_lists_exactly_the_fields_of_a_description(service: Service) -> None:
    described = service.describe()
    assert _fields("Describe") == list(described)
    assert _meaning("Describe", "contacts") == list(described["contacts"][0])
    assert _meaning("Describe", "limits") == list(described["limits"])
    assert _meaning("Describe", "devices") == list(next(iter(described["devices"].values())))
    assert set(_meaning("Describe", "model")) <= described["model"].keys()


def test_the_page_lists_exactly_the_fields_of_geometry_and_surface() -> None:
    geometry = msgpack.unpackb(wire.encode_geometry(np.zeros((1, 3)), np.zeros((1, 3), np.int32)))
    assert _fields("Geometry") == list(geometry)
    assert _fields("Surface") == list(msgpack.unpackb(wire.encode_surface(0, 0, np.zeros(3, np.float32))))


def test_the_settings_on_the_page_are_a_configuration_for_a_client() -> None:
    (block,) = re.findall(r"```json5\n(.*?)```", PAGE.read_text(), re.DOTALL)
    config = zenoh.Config.from_json5(block)
    expected = {
        "mode": "client",
        "connect/endpoints": [transport.DEFAULT_ENDPOINT],
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "transport/link/tx/lease": transport.LEASE_MS,
    }
    assert {key: json.loads(config.get_json(key)) for key in expected} == expected


def test_the_page_lists_the_keys_of_the_code() -> None:
    keys = wire.Keys("SESSION")
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
    message = msgpack.unpackb(wire.ForceEncoder(1).encode(0, 0, np.zeros((1, 4), np.int64), np.zeros((1, 8))))
    assert [row[0].strip("`") for row in _table("Force")] == list(message)


def test_the_page_lists_exactly_the_fields_of_a_command() -> None:
    fields = [row[0].strip("`") for row in _table("Command")]
    assert fields == list(wire.Command._fields)


def test_the_page_lists_exactly_the_control_actions_of_the_code() -> None:
    assert [row[0].strip("`") for row in _table("Control")] == list(wire.ACTIONS)


def test_the_page_names_the_schema_version_the_encoding_and_the_size_limit() -> None:
    text = PAGE.read_text()
    assert f"schema version {wire.SCHEMA_VERSION}" in text
    assert wire.ENCODING in text
    assert f"{wire.MAX_COMMAND_BYTES} bytes" in text
    assert f"{wire.MAX_REQUEST_BYTES} bytes" in text
    assert f"{transport.MAX_MESSAGE_BYTES} bytes" in text
