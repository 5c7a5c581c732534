"""The examples in docs/wire.md: bytes and map of each say the same, and both have the form of the code's messages."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest

from palpate_client import Frame, decode_geometry, decode_surface
from palpate_client.messages import read_description, read_force
from palpate_client.wire import ACTIONS, Flags, Kind, unpack
from palpate_server import codec
from palpate_server.session.devices import PROFILES, stiffness_warnings

PAGE = (Path(__file__).parents[2] / "docs" / "wire.md").read_text()
EXAMPLE = re.compile(r"### Example: (.+?)\n\n```json\n(.*?)```\n\n```hex\n(.*?)```", re.DOTALL)


def _with_bytes(value: Any) -> Any:
    if isinstance(value, str) and value.startswith("hex "):
        return bytes.fromhex(value[4:])
    if isinstance(value, dict):
        return {key: _with_bytes(inner) for key, inner in value.items()}
    return [_with_bytes(inner) for inner in value] if isinstance(value, list) else value


EXAMPLES = {
    title: (_with_bytes(json.loads(text)), bytes.fromhex(data)) for title, text, data in EXAMPLE.findall(PAGE)
}


def test_every_kind_of_message_and_every_action_has_an_example() -> None:
    assert {message["kind"] for message, _ in EXAMPLES.values()} == set(Kind)
    for action in ACTIONS:
        assert [title for title in EXAMPLES if title.startswith("Request") and action in title], action
        assert [title for title in EXAMPLES if title.startswith("Answer") and action in title], action


@pytest.mark.parametrize("title", EXAMPLES)
def test_the_bytes_of_an_example_are_its_map(title: str) -> None:
    message, payload = EXAMPLES[title]
    decoded = msgpack.unpackb(payload)
    assert decoded == message
    assert list(decoded) == list(message)
    assert next(iter(decoded)) == "kind"


def test_the_server_reads_the_example_of_a_command() -> None:
    message, payload = EXAMPLES["Command"]
    command = codec.decode_command(payload)
    assert command.sequence == message["sequence"]
    assert command.position_m == {"tip": tuple(message["position_m"]["tip"])}
    assert command.velocity_m_per_s == {"tip": tuple(message["velocity_m_per_s"]["tip"])}
    assert command.rendered_tick == message["rendered_tick"]


def test_the_examples_of_command_and_force_press_along_the_normal_of_the_frame_that_was_acquired() -> None:
    frame = Frame(**EXAMPLES["Request to acquire"][0]["frame"])
    (tool,) = EXAMPLES["Describe"][0]["tools"]
    home = EXAMPLES["Answer to acquire"][0]["tools"]["tip"]["home_m"]
    assert home == list(frame.point_at_client(tool["start_m"]))
    normal = np.array(frame.direction_at_client(tool["normal"]))
    command, force = EXAMPLES["Command"][0], EXAMPLES["Force"][0]
    inwards = np.array(home) - command["position_m"]["tip"]
    assert inwards @ normal > 0.001
    np.testing.assert_allclose(inwards, (inwards @ normal) * normal, atol=1e-15)
    assert np.array(command["velocity_m_per_s"]["tip"]) @ normal < 0
    (rendered,) = force["force_n"]
    assert np.array(rendered) @ normal > 0.9 * np.linalg.norm(rendered) > 0
    assert (force["sequence"], force["client_time_ns"]) == (
        [command["sequence"]],
        [command["client_time_ns"]],
    )
    assert not force["flags"][0] & Flags.HELD
    assert command["rendered_tick"] < force["tick"]
    np.testing.assert_allclose(force["position_m"][0], command["position_m"]["tip"], atol=1e-4)


def test_the_warnings_of_the_example_of_acquire_are_those_of_its_request() -> None:
    request, described = EXAMPLES["Request to acquire"][0], EXAMPLES["Describe"][0]
    stiffness = np.linalg.norm(described["model"]["instant_stiffness_n_per_m"], 2)
    warnings = stiffness_warnings(
        PROFILES[request["device"]],
        float(stiffness) * request["frame"]["scale"] ** 2,
        described["period_s"],
        request["round_trip_s"],
        request["device_damping_n_s_per_m"],
    )
    assert warnings == EXAMPLES["Answer to acquire"][0]["warnings"] != []


def test_the_server_encodes_geometry_and_surface_as_in_the_examples() -> None:
    geometry, payload = EXAMPLES["Geometry"]
    vertices = np.frombuffer(geometry["vertices_m"], "<f4").reshape(-1, 3).astype(float)
    triangles = np.frombuffer(geometry["triangles"], "<i4").reshape(-1, 3)
    assert codec.encode_geometry(vertices, triangles) == payload
    assert decode_geometry(payload).triangles.tolist() == triangles.ravel().tolist()
    surface, payload = EXAMPLES["Surface"]
    displacement = np.frombuffer(surface["displacement_m"], "<f4")
    assert codec.encode_surface(surface["tick"], surface["server_time_ns"], displacement) == payload
    assert decode_surface(payload).displacement_m.tolist() == displacement.tolist()


def test_the_client_reads_the_examples_of_force_and_describe() -> None:
    message, payload = EXAMPLES["Force"]
    force = read_force(unpack(payload, Kind.FORCE), 0, 5)
    assert (force.sequence, force.force_n, force.arrival_ns) == (
        message["sequence"][0],
        message["force_n"][0],
        5,
    )
    description = read_description(EXAMPLES["Describe"][0])
    assert description.index("tip") == 0
    assert description.tools[0].normal == (0.0, -1.0, 0.0)


def _shape(value: Any, like: Any) -> None:
    """Raises AssertionError where maps have other fields, or values other types; a list's items are like its first."""
    if isinstance(like, dict) and isinstance(value, dict):
        assert list(value) == list(like)
        for key in like:
            _shape(value[key], like[key])
    elif isinstance(like, list):
        assert isinstance(value, list)
        for item in value if like else []:
            _shape(item, like[0])
    else:
        both = {type(value), type(like)}
        assert len(both - {type(None)}) <= 1 or both == {int, float}, (value, like)


def test_a_real_server_answers_in_the_form_of_the_examples(
    serve: Callable[..., Any], connect: Callable[..., Any], wait_for: Callable[..., Any], tmp_path: Path
) -> None:
    served = serve("--recordings", str(tmp_path), "--models", str(tmp_path))
    requests = {
        "acquire": {},
        "limits": {},
        "reset": {},
        "load": {"file": "model1.npz"},
        "record": {},
    }
    with connect(served.endpoint) as client:
        _shape_but_model(client.query("describe")[1], EXAMPLES["Describe"][0])
        for action, change in requests.items():
            (title,) = (t for t in EXAMPLES if t.startswith("Request") and t.endswith(action))
            granted, answer = client.query(f"control/{client.name}/{action}", EXAMPLES[title][0] | change)
            assert granted, answer
            (title,) = (t for t in EXAMPLES if t.startswith("Answer") and t.endswith(action))
            _shape(answer, EXAMPLES[title][0])
        granted, answer = client.query(
            f"control/{client.name}/record", EXAMPLES["Request to end the recording"][0]
        )
        assert granted
        _shape(answer, EXAMPLES["Answer to record"][0])
        granted, answer = client.query(f"control/{client.name}/release", EXAMPLES["Request to release"][0])
        assert granted
        _shape(answer, EXAMPLES["Answer to release"][0])
        granted, answer = client.query(f"control/{client.name}/reset", EXAMPLES["Request to reset"][0])
        assert not granted
        _shape(answer, EXAMPLES["Refusal"][0])
        _shape(client.next_status(), EXAMPLES["Status"][0])
        raw: list[bytes] = []
        subscriber = client.session.declare_subscriber(
            client.key("force"), lambda sample: raw.append(sample.payload.to_bytes())
        )
        wait_for(lambda: raw, "a force")
        subscriber.undeclare()
        _shape(msgpack.unpackb(raw[0]), EXAMPLES["Force"][0])
        assert len(raw[0]) == len(EXAMPLES["Force"][1])


def _shape_but_model(described: dict[str, Any], example: dict[str, Any]) -> None:
    """The example shows some of the devices and of the model's fields only."""
    assert example["devices"].keys() <= described["devices"].keys()
    assert example["model"].keys() <= described["model"].keys()
    some = {
        "devices": {name: described["devices"][name] for name in example["devices"]},
        "model": {name: described["model"][name] for name in example["model"]},
    }
    _shape(described | some, example)


def test_the_program_on_the_page_works_as_it_stands(
    serve: Callable[..., Any], start: Callable[..., Any], tmp_path: Path
) -> None:
    settings, program = (
        re.findall(rf"```{language}\n(.*?)```", PAGE, re.DOTALL)[0] for language in ("json5", "python")
    )
    served = serve("--session", "main")
    config, script = tmp_path / "zenoh.json5", tmp_path / "program.py"
    config.write_text(settings.replace("tcp/127.0.0.1:7447", served.endpoint))
    script.write_text(program)
    code, out, err = start(script, config).finish()
    assert code == 0, err
    assert len(out.splitlines()) == 5
    assert not err
