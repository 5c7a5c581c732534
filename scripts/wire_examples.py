"""Writes the examples of docs/wire.md anew, from one session with a real server.

    python scripts/wire_examples.py

A client whose z axis points out of the tissue presses a sample model's tool 3 mm in. Of `describe`, one device and some of
the model's fields are kept; everything else stands as it was sent.
"""

from __future__ import annotations

import json
import re
import sys
import tempfile
import textwrap
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgpack
import zenoh

from palpate.model_file import Contact, save_model
from palpate_client import Connection, Refused, steps
from palpate_client.local_server import free_endpoint, running
from palpate_client.wire import SCHEMA_VERSION, Kind, pack
from palpate_server.diagnostics.sample_model import spring_mass_model

PAGE = Path(__file__).parents[1] / "docs" / "wire.md"
MARK = "<!-- examples -->\n"
FRAME = {
    "rotation": [[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]],
    "scale": 2.0,
    "client_origin_m": [0.0, 0.01, 0.0],
    "model_origin_m": [-0.02, -0.08, 0.03],
}
TIP = Contact("tip", (-0.02, -0.08, 0.03), (0.0, -1.0, 0.0), 0.005, 37)
DEPTH_M, PRESSED_S = 0.0015, 0.5  # at the client: with its scale, 3 mm in the model
MODEL_FIELDS = (
    *("kind", "name", "order", "config_sha256", "stiffness_factor"),
    *("static_stiffness_n_per_m", "instant_stiffness_n_per_m"),
)


def main() -> None:
    model = replace(spring_mass_model(n_modes=2), name="sample", contacts=(TIP,), config_sha256="5e" * 32)
    endpoint = free_endpoint()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "sample.npz"
        save_model(model, path)
        command = ["-m", "palpate_server", str(path), "--listen", endpoint, "--recordings", folder]
        with (
            running([sys.executable, *command], "serving"),
            Connection(endpoint, name="operator") as connection,
        ):
            examples = session(connection)
    head, _, _ = PAGE.read_text().partition(MARK)
    PAGE.write_text(head + MARK + "".join(shown(title, payload) for title, payload in examples.items()))


def session(connection: Connection) -> dict[str, bytes]:
    """The payloads of one message of each kind, by title."""
    examples: dict[str, bytes] = {}
    requests: dict[str, bytes] = {}

    def ask(action: str, title: str, **fields: Any) -> dict[str, Any]:
        requests[title] = pack({"kind": Kind.REQUEST, "schema_version": SCHEMA_VERSION, **fields})
        answer = connection.ask(connection.keys.control(connection.name, action), fields, timeout_s=30.0)
        requests.setdefault(f"Answer to {action}", answer)
        return dict(msgpack.unpackb(answer))

    described = msgpack.unpackb(connection.ask(connection.keys.describe))
    described["devices"] = {"generic": described["devices"]["generic"]}
    described["model"] = {name: described["model"][name] for name in MODEL_FIELDS}
    acquired = ask(
        "acquire",
        "Request to acquire",
        tools=["tip"],
        frame=FRAME,
        device="generic",
        round_trip_s=0.0015,
        device_damping_n_s_per_m=0.5,
    )
    examples |= pressed(connection, acquired["tools"]["tip"]["home_m"])
    status = next_payload(connection, connection.keys.status)
    surface = next_payload(connection, connection.keys.surface)
    ask("limits", "Request for limits", limits={"max_force_n": 2.0})
    ask("reset", "Request to reset")
    ask("load", "Request to load", file="sample.npz")
    ask("record", "Request to record", file="poke.mcap")
    ask("record", "Request to end the recording", file=None)
    ask("release", "Request to release")
    try:
        connection.control("reset")
    except Refused as refused:
        refusal = {"kind": Kind.REFUSAL, "reason": refused.reason, "message": refused.words}
    return {
        **examples,
        **requests,
        "Refusal": pack(refusal),
        "Status": status,
        "Describe": pack(described),
        "Geometry": connection.ask(connection.keys.geometry),
        "Surface": surface,
    }


def pressed(connection: Connection, home_m: list[float]) -> dict[str, bytes]:
    """Press the tip in along the client's z axis; a command on the way, and the force of the tick that used it first."""
    commands: dict[int, bytes] = {}
    forces: list[bytes] = []
    publisher = connection.zenoh.declare_publisher(
        connection.keys.command(connection.name), priority=zenoh.Priority.REAL_TIME, express=True
    )
    subscriber = connection.zenoh.declare_subscriber(
        connection.keys.force, lambda sample: forces.append(sample.payload.to_bytes())
    )
    x, y, z = home_m
    speed = DEPTH_M / PRESSED_S
    for i in steps(PRESSED_S, 1e-3):
        command = {
            "kind": Kind.COMMAND,
            "sequence": i + 1,
            "client_time_ns": time.monotonic_ns(),
            "position_m": {"tip": [x, y, round(z - speed * i * 1e-3, 9)]},
            "velocity_m_per_s": {"tip": [0.0, 0.0, -speed]},
            "rendered_tick": msgpack.unpackb(forces[-1])["tick"] if forces else None,
        }
        commands[i + 1] = pack(command)
        publisher.put(commands[i + 1])
    subscriber.undeclare()  # type: ignore[no-untyped-call]
    answers = {
        message["sequence"][0]: force for force in reversed(forces) if (message := msgpack.unpackb(force))
    }
    sequence = max(set(commands) & set(answers))
    return {"Command": commands[sequence], "Force": answers[sequence]}


def next_payload(connection: Connection, key: str) -> bytes:
    payloads: list[bytes] = []
    subscriber = connection.zenoh.declare_subscriber(
        key, lambda sample: payloads.append(sample.payload.to_bytes())
    )
    wait_for(lambda: payloads)
    subscriber.undeclare()  # type: ignore[no-untyped-call]
    return payloads[0]


def wait_for(condition: Callable[[], object]) -> None:
    give_up = time.monotonic() + 10.0
    while not condition():
        if time.monotonic() > give_up:
            raise TimeoutError("no message came in 10 s")
        time.sleep(0.01)


def shown(title: str, payload: bytes) -> str:
    """An example as it stands on the page: its map, then its bytes."""
    text = json.dumps(printable(msgpack.unpackb(payload)))
    together = re.sub(r'"[^"]*"', lambda string: string.group().replace(" ", "\0"), text)
    lines = textwrap.fill(together, 118, break_long_words=False, break_on_hyphens=False).replace("\0", " ")
    return f"\n### Example: {title}\n\n```json\n{lines}\n```\n\n```hex\n{textwrap.fill(payload.hex(' '), 119)}\n```\n"


def printable(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: printable(inner) for key, inner in value.items()}
    if isinstance(value, list):
        return [printable(inner) for inner in value]
    return f"hex {value.hex()}" if isinstance(value, bytes) else value


if __name__ == "__main__":
    main()
