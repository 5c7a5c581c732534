"""Sessions that tick, without Zenoh."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

import pytest

from palpate.model_file import ReducedModel, SurfaceModel
from palpate_client.wire import Keys
from palpate_server.coupling.models import Model
from palpate_server.realtime import scheduler
from palpate_server.realtime.safety import Limits
from palpate_server.session.state import SessionState
from palpate_server.session.warm_up import warm_up


@dataclass
class Ticking:
    """A session's state and the loop that runs its ticks; nothing is sent."""

    state: SessionState
    _wake: int = field(default_factory=lambda: os.eventfd(0))

    def start(self) -> None:
        self._thread = threading.Thread(
            target=scheduler.run_at_deadlines, args=(self.state.image, self._wake), name="deadlines"
        )
        self._thread.start()

    def stop(self) -> None:
        scheduler.stop(self.state.memory.shared)
        self._thread.join()

    def close(self) -> None:
        self.stop()
        os.close(self._wake)


@contextmanager
def ticking(model: Model) -> Iterator[Ticking]:
    warm_up(1e-3, 2)  # a change that is asked for gives up when no tick comes
    limits = Limits(10.0, 2000.0, 1.0, 0.1, 0.0)
    session = Ticking(SessionState(model, limits, Keys("test"), 1 / 30))
    session.start()
    try:
        yield session
    finally:
        session.close()


@pytest.fixture
def session(make_spring_mass_model: Callable[..., ReducedModel]) -> Iterator[Ticking]:
    """Two tools of a patch model, `tip` and `tip1`, that nobody holds."""
    with ticking(make_spring_mass_model(2)) as session:
        yield session


@pytest.fixture
def surface_session(make_surface_model: Callable[..., SurfaceModel]) -> Iterator[Ticking]:
    """Two tools of a surface model, `tip` and `tip1`, that nobody holds."""
    with ticking(make_surface_model(2)) as session:
        yield session
