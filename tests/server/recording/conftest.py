"""A loop without a clock or a network, driven by hand, and a recorder of it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from palpate.model_file import ReducedModel
from palpate_client.wire import Keys, pack
from palpate_server.coupling import cross_fade, models
from palpate_server.coupling.models import Model
from palpate_server.coupling.settle import Touch
from palpate_server.realtime import scheduler, shared_memory
from palpate_server.realtime.native_image import make_image
from palpate_server.realtime.safety import Limits
from palpate_server.recording import recorder, snapshot
from palpate_server.recording.recorder import Recorder

LIMITS = Limits(10.0, 2000.0, 1.0, 0.1, 5.0)


class Loop:
    """Ticks of a model with passivity control; each change of settings is told to the recorder, as a session does."""

    def __init__(self, model: Model) -> None:
        self.model, self.following = model, None
        limits = [LIMITS] * len(models.tools_of(model))
        self.memory = shared_memory.make_memory(models.make_running(model), model.period_s, limits, 1.0)
        self.image = make_image(self.memory)
        self.random = np.random.default_rng(1)
        self.sequence = 0
        self.recorder: Recorder | None = None

    @property
    def tick(self) -> int:
        return int(self.memory.counters["ticks"][0])

    def run(
        self, ticks: int, *, commanded: bool = True, told: int = 3, by_m: float = 1e-3, attach: bool = False
    ) -> None:
        """Some ticks, each with a new command for all tools, which tells the force of `told` ticks before, or without."""
        for _ in range(ticks):
            now = (self.tick + 1) * 1_000_000
            if commanded:
                self.sequence += 1
                for tool, command in enumerate(self.memory.commands.incoming):
                    command["tool"], command["lease"] = tool, self.memory.commands.lease[tool]
                    command["sequence"], command["arrival_ns"] = self.sequence, now - 300_000
                    command["client_time_ns"], command["rendered_tick"] = now, max(-1, self.tick - told)
                    home = self.memory.settings["home_m"][tool]
                    command["position_m"] = home + self.random.normal(size=3) * by_m
                    command["velocity_m_per_s"] = (0.01, 0.0, 0.0)
                    command["attach"] = attach
                assert scheduler.hand_over(self.image, len(self.memory.ports)) == 0
            scheduler.repeat_tick(self.image, now, now, False)

    def change(self, ask: Callable[..., None], *what: Any) -> None:
        """Have the next tick change something."""
        ask(self.image, *what)
        scheduler.take_up_change(self.image)
        self.tell()

    def tell(self) -> None:
        if self.recorder is not None:
            self.recorder.settings(snapshot.as_message(self.memory, self.model, self.following))

    def load(self, model: Model) -> None:
        """Fade over to another model within 100 ticks."""
        touch = Touch(self.memory.wanted.copy(), self.memory.reactions.copy())
        displacement = self.memory.displacement.copy()
        following = models.make_settled(model, models.tips_of_file(model), displacement, touch)
        coupling = cross_fade.to_another(self.memory.coupling, following, 0.01)
        self._exchange(coupling, self.model, model)
        self.run(100)
        self._exchange(cross_fade.after(coupling), model, None)

    def _exchange(self, coupling: Any, model: ReducedModel, following: Any) -> None:
        self.memory = shared_memory.with_coupling(self.memory, coupling)
        self.model, self.following = model, following
        self.change(scheduler.exchange, make_image(self.memory))

    def record(self, path: Path, max_bytes: int = 10**9) -> Recorder:
        self.recorder = Recorder(
            path,
            max_bytes,
            Keys("test"),
            {"session": "test", "period_s": 1e-3},
            self.memory,
            lambda: self.change(scheduler.save),
        )
        self.change(scheduler.save)
        return self.recorder

    def status(self) -> None:
        assert self.recorder is not None
        self.recorder.status(pack({"kind": "status", "state": "running", "ticks": self.tick}))


@pytest.fixture
def make_loop(make_spring_mass_model: Callable[..., ReducedModel]) -> Callable[..., Loop]:
    return lambda n_tools=1: Loop(make_spring_mass_model(n_tools))


@pytest.fixture
def loop(make_loop: Callable[..., Loop]) -> Loop:
    return make_loop()


@pytest.fixture
def patiently(monkeypatch: pytest.MonkeyPatch) -> None:
    """At the end of a recording the process that writes may still be starting, on a busy machine."""
    monkeypatch.setattr(recorder, "END_S", 120.0)
