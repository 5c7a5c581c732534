"""The state that the server's threads share: model, loop, leases, counters."""

from __future__ import annotations

import threading
import time
from collections import Counter
from collections.abc import Callable, Iterable
from typing import Any

from palpate_client.messages import Frame
from palpate_client.wire import MALFORMED, REFUSED, Keys
from palpate_server.coupling import models
from palpate_server.coupling.models import Model
from palpate_server.errors import Refused
from palpate_server.realtime import scheduler, shared_memory
from palpate_server.realtime.native_image import make_image
from palpate_server.realtime.safety import Limits
from palpate_server.recording import snapshot
from palpate_server.recording.recorder import Recorder
from palpate_server.session.leases import Leases, ToolSettings
from palpate_server.session.tips import tips_for

CHANGE_TIMEOUT_S = 1.0


class MessageCounters:
    """How many commands were accepted, refused and malformed, by reason; written by the receiving thread."""

    def __init__(self) -> None:
        self.accepted = 0
        self.refused: Counter[str] = Counter(dict.fromkeys(REFUSED, 0))
        self.malformed: Counter[str] = Counter(dict.fromkeys(MALFORMED, 0))
        self.unsent_forces = 0


class SessionState:
    """One model in one session.

    model          the one that runs; while another is faded in, still the old one
    model_file     name of its file in the folder of models; None if it is not from there
    limits         what no client can exceed
    tools          their names, in the model's order
    tool_index     index of each name in `tools`
    memory, image  of the loop
    lease_numbers  number of the present hold of each tool, as in the loop's memory
    leases         holders and settings of the tools
    tips           of the tools, as the loop has them: agreed with the present or last holder; none for a patch model
    messages       counters of commands
    running        False once the server stops: commands and requests are then refused
    stopping       set when all threads have to end
    lost_clients   number of clients whose token was deleted while they held a tool
    recorder       the last recording, until a client ends it; or None
    exchanging     lock: a model is not loaded while a tool is acquired, and vice versa
    model_in_use   lock: the model is not exchanged while the surface is computed from it
    """

    def __init__(self, model: Model, limits: Limits, keys: Keys, surface_period_s: float) -> None:
        self.model = model
        self.model_file: str | None = None
        self.limits = limits
        self.keys = keys
        self.surface_period_s = surface_period_s
        tools = models.tools_of(model)
        self.tools = tuple(tool.name for tool in tools)
        self.tool_index = {name: i for i, name in enumerate(self.tools)}
        homes = [tool.start_m for tool in tools]
        self.leases = Leases({tool.name: ToolSettings(limits, Frame(), tool.start_m) for tool in tools})
        self.tips = tips_for(model, self.leases.settings)
        running = models.make_running(model, list(self.tips.values()))
        self.memory = shared_memory.make_memory(
            running, model.period_s, [limits] * len(tools), surface_period_s, homes
        )
        self.lease_numbers = [0] * len(self.tools)
        self.image = make_image(self.memory)
        self.messages = MessageCounters()
        self.running = True
        self.stopping = threading.Event()
        self.lost_clients = 0
        self.recorder: Recorder | None = None
        self.exchanging = threading.Lock()
        self.model_in_use = threading.Lock()
        self._changing = threading.Lock()  # the loop has one slot for changes
        self._following: Model | None = None  # the model that is being faded in

    def check_running(self) -> None:
        """Raises Refused once the server stops."""
        if not self.running:
            raise Refused("stopping", "the server is stopping")

    def check_alone(self, client: str) -> None:
        """Raises Refused unless this client, and no other, holds a tool."""
        for name, holder in self.leases.holders.items():
            if holder not in (None, client):
                raise Refused(
                    "held", f"tool {name!r} is held by client {holder!r}, which the change would affect"
                )
        self.leases.check_holder(client)

    def forget_commands(self, tools: Iterable[str]) -> None:
        """End the hold of these tools in the loop: their forces fade from the next tick on."""
        for name in tools:
            tool = self.tool_index[name]
            scheduler.forget_command(self.memory.commands, tool)
            self.lease_numbers[tool] += 1

    def between_ticks(self, ask: Callable[..., None], *what: Any) -> None:
        """Have the next tick make a change: ask(image, *what) requests it. Raises Refused, without a change, if no tick comes."""
        with self._changing:
            self._change(ask, *what)
            self._record_settings()

    def exchange(self, memory: shared_memory.Memory, model: Model, following: Model | None) -> None:
        """Have the loop continue with another memory, of a model and of the one that is faded in; as `between_ticks`."""
        with self._changing:
            self._change(scheduler.exchange, make_image(memory))
            self.memory, self.model, self._following = memory, model, following
            self._record_settings()

    def _change(self, ask: Callable[..., None], *what: Any) -> None:
        if self.stopping.is_set():
            raise Refused("stopping", "the server is stopping")
        give_up = time.monotonic() + CHANGE_TIMEOUT_S
        ask(self.image, *what)
        while not scheduler.is_changed(self.image):
            if time.monotonic() > give_up and scheduler.withdraw_change(self.image):
                raise Refused("busy", "no tick came that could have made the change")
            time.sleep(self.model.period_s / 4)

    def _record_settings(self) -> None:
        """Pass the saved state to the recorder, before the next change saves another one."""
        if self.recorder is not None:
            self.recorder.settings(snapshot.as_message(self.memory, self.model, self._following))
