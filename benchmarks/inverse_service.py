"""A service that speaks the JSON of Haply's Inverse service on loopback, for tests and measurements; the hand is a function.

It answers each command with the next state, and a force holds until the next one comes, from whichever client. What no client may send
is kept in `errors`.
"""

from __future__ import annotations

import json
import math
import threading
import time
from collections.abc import Callable
from types import TracebackType
from typing import Any

from websockets.exceptions import ConnectionClosed
from websockets.sync.server import Server, ServerConnection, serve

DEVICE_ID = "04a1"
Vector = tuple[float, float, float]


class InverseService:
    """Use it in a `with` statement.

    Attributes
    ----------
    url: where it listens.
    hand: position of the cursor, m, at a time since the start, s.
    silent: answers nothing while it is set.
    connected, ready: of the device.
    force_n: what the device renders now.
    states: (time_ns, position) of each state that was sent; forces: (time_ns, force) of each command that came.
    errors: what was wrong about commands.
    """

    def __init__(self, hand: Callable[[float], Vector], port: int = 0) -> None:
        self.hand = hand
        self.silent = False
        self.connected = self.ready = True
        self.force_n: Vector = (0.0, 0.0, 0.0)
        self.states: list[tuple[int, Vector]] = []
        self.forces: list[tuple[int, Vector]] = []
        self.errors: list[str] = []
        self._port = port
        self._start_s = time.monotonic()
        self._clients: set[ServerConnection] = set()

    def __enter__(self) -> InverseService:
        self._server: Server = serve(self._talk, "127.0.0.1", self._port, compression=None)
        self.url = f"ws://127.0.0.1:{self._server.socket.getsockname()[1]}"
        self._thread = threading.Thread(target=self._server.serve_forever)
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.die()

    def die(self) -> None:
        """End as a killed process does: no farewell, and the device renders nothing any more."""
        self._server.shutdown()
        self._thread.join()
        for client in list(self._clients):
            client.close_socket()
        self.force_n = (0.0, 0.0, 0.0)

    def _talk(self, client: ServerConnection) -> None:
        self._clients.add(client)
        try:
            client.send(self._state(full=True))
            for text in client:
                full = self._obey(text)
                if not self.silent:
                    client.send(self._state(full))
        except ConnectionClosed:
            pass
        finally:
            self._clients.discard(client)

    def _obey(self, text: str | bytes) -> bool:
        """Take a command over; whether the full state was asked for."""
        try:
            message = json.loads(text)
            for device in message.get("inverse3", []):
                if device["device_id"] != DEVICE_ID:
                    raise ValueError(f"unknown device {device['device_id']}")
                for name, command in device["commands"].items():
                    values = command["values"]
                    x, y, z = (float(values[axis]) for axis in "xyz")
                    if name != "set_cursor_force" or set(values) != set("xyz"):
                        raise ValueError(f"unknown command {name} with {sorted(values)}")
                    if not all(math.isfinite(f) for f in (x, y, z)):
                        raise ValueError("a force is not finite")
                    self.force_n = x, y, z
                    self.forces.append((time.monotonic_ns(), self.force_n))
            return "force_render_full_state" in message.get("session", {})
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            self.errors.append(f"{error!r}: {text!r}")
            return False

    def _state(self, full: bool) -> str:
        position = self.hand(time.monotonic() - self._start_s)
        self.states.append((time.monotonic_ns(), position))
        device: dict[str, Any] = {
            "device_id": DEVICE_ID,
            "state": {
                "cursor_position": dict(zip("xyz", position, strict=True)),
                "cursor_velocity": dict.fromkeys("xyz", 0.0),
            },
        }
        grip: dict[str, Any] = {
            "device_id": "61576",
            "state": {
                "orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0},
                "buttons": dict.fromkeys("abc", False),
                "battery_level": 0.9,
            },
        }
        if full:
            device["config"] = {"handedness": "right", "port": "COM7"}
            names = ("calibrated", "in_use", "power_supply", "ready", "started")
            device["status"] = dict.fromkeys(names, True) | {"ready": self.ready}
            grip["status"] = dict.fromkeys(("connected", "awake", "ready"), True)
        return json.dumps({"inverse3": [device] if self.connected else [], "wireless_verse_grip": [grip]})
