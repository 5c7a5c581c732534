"""What comes from a session while somebody looks: the newest force, surface and status, and the history of one tool."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate_client import Connection, Force, Surface
from palpate_client.messages import read_force
from palpate_view.history import History


class Watch:
    """Subscribes to force and surface between `begin` and `end`; Zenoh's threads write, the page reads.

    force     the newest of the tool that is watched
    surface   the newest displacement, (n_vertices, 3), m; None before the first
    """

    def __init__(self, connection: Connection, tool: str) -> None:
        self._connection = connection
        self.tool = tool
        self._index = connection.description.index(tool)
        self.history = History(connection.description.period_s)
        self.force: Force | None = None
        self.surface: NDArray[np.float32] | None = None
        self._subscriptions: list[Any] = []

    def begin(self) -> None:
        if not self._subscriptions:
            self.history.forget()
            self._subscriptions = [
                self._connection.on_force(self._on_force),
                self._connection.on_surface(self._on_surface),
            ]

    def end(self) -> None:
        for subscription in self._subscriptions:
            subscription.undeclare()
        self._subscriptions = []

    def watch_tool(self, tool: str) -> None:
        """Watch another tool of the session from now on."""
        self.tool, self._index, self.force = tool, self._connection.description.index(tool), None
        self.history.forget()

    @property
    def tool_status(self) -> dict[str, Any] | None:
        """The tool's part of the newest status; None before the first status."""
        status = self._connection.status
        return None if status is None else status["tools"][self.tool]

    def _on_force(self, message: dict[str, Any], arrival_ns: int) -> None:
        force = read_force(message, self._index, arrival_ns)
        self.history.add(force, message["tissue_stored_j"], message["tissue_dissipated_j"])
        self.force = force

    def _on_surface(self, surface: Surface) -> None:
        self.surface = np.frombuffer(surface.displacement_m, np.float32).reshape(-1, 3)
