"""What is being served: the model that runs, the memory of its ticks, who holds its contacts; shared by all threads."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterable
from dataclasses import asdict
from typing import Any

from palpate.model_file import ReducedModel
from palpate_server import wire
from palpate_server.realtime import safety, scheduler, shared_memory
from palpate_server.realtime.native_image import make_image
from palpate_server.realtime.safety import Flags, Limits
from palpate_server.recording.recorder import Recorder
from palpate_server.session import status
from palpate_server.session.devices import PROFILES
from palpate_server.session.leases import Leases, Refused

STATUS_PERIOD_S = 0.1
_CHANGE_TIMEOUT_S = 1.0


class Service:
    """One model in one session. `limits` are what no client can exceed.

    state                   "running" or "stopping"; `stopping` is set when all threads are to end
    last_sequence           of each contact, the number of the lease that its newest command came under, and its sequence
    undisturbed_since_tick  the last reset or change of model: until then a recording can be repeated
    lost_clients            clients whose token went while they held a contact
    model_in_use            held while the surface is computed from the model, and while it is exchanged
    """

    def __init__(self, model: ReducedModel, limits: Limits, keys: wire.Keys, surface_period_s: float) -> None:
        self.model = model
        self.limits = limits
        self.keys = keys
        self.surface_period_s = surface_period_s
        self.names = [contact.name for contact in model.contacts]
        self.contact_index = {name: i for i, name in enumerate(self.names)}
        self.leases = Leases(self.names, limits)
        self.messages = status.MessageCounters(len(self.names))
        self.last_sequence = [(0, -1)] * len(self.names)
        self.memory = shared_memory.make_memory(
            model.discrete, model.period_s, [limits] * len(self.names), surface_period_s
        )
        self.image = make_image(self.memory)
        self.state = "running"
        self.stopping = threading.Event()
        self.undisturbed_since_tick = 0
        self.lost_clients = 0
        self._statuses = 0
        self.recorder: Recorder | None = None
        self.model_in_use = threading.Lock()
        self._changing = threading.Lock()  # the loop has one slot for changes

    def forget_commands(self, contacts: Iterable[str]) -> None:
        """Let the forces of contacts fade from the next tick on."""
        for name in contacts:
            scheduler.forget_command(self.memory.commands, self.contact_index[name])

    def between_ticks(self, ask: Callable[..., None], *what: Any) -> int:
        """Have the loop change something; the first tick after it. Raises Refused when no tick comes: nothing is changed."""
        with self._changing:
            if self.stopping.is_set():
                raise Refused("stopping", "the server is stopping")
            give_up = time.monotonic() + _CHANGE_TIMEOUT_S
            ask(self.image, *what)
            while (tick := scheduler.changed_at(self.image)) < 0:
                if time.monotonic() > give_up and scheduler.withdraw_change(self.image):
                    raise Refused("busy", "no tick came that could have made the change")
                time.sleep(self.model.period_s / 4)
            return tick

    def status(self) -> dict[str, Any]:
        """The next status message; one thread at a time may call this."""
        self._statuses += 1
        return status.status(
            self._statuses,
            self.state,
            time.monotonic_ns(),
            self.model,
            self.memory,
            self.messages,
            self.leases,
            self.undisturbed_since_tick,
            self.lost_clients,
            None if self.recorder is None else self.recorder.report(),
        )

    def describe(self) -> dict[str, Any]:
        """The describe reply: what a client must know before it moves anything."""
        summary = self.model.summary()
        summary["accuracy"].pop("hankel_singular_values")
        return {
            "schema_version": wire.SCHEMA_VERSION,
            "session": self.keys.session,
            "period_s": self.model.period_s,
            "contacts": [asdict(contact) for contact in self.model.contacts],
            "limits": self.limits._asdict(),
            "devices": {name: asdict(profile) for name, profile in PROFILES.items()},
            "hold_s": safety.HOLD_NS * 1e-9,
            "decay_s": safety.DECAY_NS * 1e-9,
            "soft_start_s": safety.SOFT_START_NS * 1e-9,
            "status_period_s": STATUS_PERIOD_S,
            "surface_period_s": self.surface_period_s,
            "flags": {flag.name: flag.value for flag in Flags},
            "model": summary,
        }
