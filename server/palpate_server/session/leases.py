"""Which client holds which tool, and with which settings. A tool has one holder, until it releases the tool or is gone."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from palpate_client.messages import Frame, Vector
from palpate_server.errors import Refused
from palpate_server.realtime.safety import Limits
from palpate_server.session.devices import Device
from palpate_server.session.fields import AS_IT_IS, TipWanted


@dataclass(frozen=True)
class ToolSettings:
    """The settings of a tool for its present or last holder.

    home_m  the client position at which the tip is at the tool's start
    wanted  what the client asked for of its tip
    """

    limits: Limits
    frame: Frame
    home_m: Vector
    device: Device | None = None
    wanted: TipWanted = AS_IT_IS


class Leases:
    """The holder and the settings of every tool. One thread changes them; any may read."""

    def __init__(self, settings: Mapping[str, ToolSettings]) -> None:
        self.holders: dict[str, str | None] = dict.fromkeys(settings)
        self.settings = dict(settings)

    def check(self, client: str, tools: Iterable[str]) -> None:
        """Raises Refused when one of `tools` is unknown or another client's."""
        for name in tools:
            if name not in self.holders:
                known = ", ".join(self.holders)
                raise Refused("unknown_tool", f"no tool is called {name[:100]!r}: there are {known}")
            holder = self.holders[name]
            if holder is not None and holder != client:
                raise Refused("held", f"tool {name!r} is held by client {holder!r}")

    def check_holder(self, client: str) -> None:
        """Raises Refused when a client holds no tool."""
        if client not in self.holders.values():
            raise Refused("not_holder", f"client {client!r} holds no tool")

    def held_by(self, client: str) -> tuple[str, ...]:
        return tuple(name for name, holder in self.holders.items() if holder == client)

    def release(self, client: str) -> tuple[str, ...]:
        """Release every tool of `client`. Returns their names."""
        held = self.held_by(client)
        for name in held:
            self.holders[name] = None
        return held
