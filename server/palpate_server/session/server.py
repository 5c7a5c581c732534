"""The running server: starts its threads, connects them to a Zenoh session, and stops them."""

from __future__ import annotations

import logging
import os
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import zenoh

from palpate.model_file import SurfaceModel
from palpate_client.wire import Keys, pack
from palpate_server import codec
from palpate_server.coupling import models
from palpate_server.coupling.models import Model
from palpate_server.realtime import safety, scheduler, shared_memory, threads
from palpate_server.realtime.safety import Limits
from palpate_server.recording.black_box import BlackBox
from palpate_server.session.admission import Admission
from palpate_server.session.loading import model_files
from palpate_server.session.publishing import ForcePublisher, StatusPublisher, SurfacePublisher
from palpate_server.session.queries import Queries
from palpate_server.session.requests import Requests
from palpate_server.session.state import SessionState
from palpate_server.session.status import STATUS_PERIOD_S, description
from palpate_server.session.warm_up import warm_up

log = logging.getLogger("palpate_server")

DEFAULT_RECORDINGS_BYTES = 10 * 10**9
DEFAULT_SURFACE_HZ, MAX_SURFACE_HZ = 30.0, 60.0
_ALIVE_TIMEOUT_S = 1.0


@dataclass(frozen=True)
class ServerOptions:
    """How a model is served.

    limits      what no client can exceed
    models      the folder that clients may load from
    recordings  the folder that clients may have recordings made in, or None; it may hold max_recordings_bytes
    black_box   the folder for black box files, or None
    surface_hz  surfaces a second, at most MAX_SURFACE_HZ
    cpu         the processor for the threads that run ticks, or None to leave that to the system
    model_file  name of the model's file in the folder `models`; None if it is not from there
    """

    limits: Limits
    models: Path
    recordings: Path | None = None
    max_recordings_bytes: int = DEFAULT_RECORDINGS_BYTES
    black_box: Path | None = None
    surface_hz: float = DEFAULT_SURFACE_HZ
    cpu: int | None = None
    model_file: str | None = None


class Server:
    """Serves one model in one Zenoh session, from `start` to `stop`.

    Threads: one of Zenoh's receives commands and runs most ticks; the deadline loop (compiled, without the GIL) runs the others,
    and a third thread sends their forces; one answers queries, one sends the surface. The thread that calls `publish_status`
    sends the status. Loading a model and recording have a thread of their own while they last.
    """

    def __init__(self, model: Model, session: zenoh.Session, keys: Keys, options: ServerOptions) -> None:
        state = SessionState(model, options.limits, keys, 1 / options.surface_hz)
        state.model_file = options.model_file
        self.state = state
        self._session = session
        self._cpu = options.cpu
        black_box = None
        if options.black_box is not None:
            black_box = BlackBox(options.black_box, keys.session, state.tools, state.memory)
        self._wake = os.eventfd(0)
        self._admission = Admission(state)
        self._forces = ForcePublisher(state, session, self._wake)
        self._status = StatusPublisher(state, session, black_box)
        self._surface = SurfacePublisher(state, session)
        self._requests = Requests(
            state,
            self._has_token,
            self._status.publish,
            options.models,
            options.recordings,
            options.max_recordings_bytes,
        )
        self._queries = Queries(
            keys,
            self._requests,
            describe=lambda: pack(description(state) | {"model_files": model_files(options.models)}),
            geometry=lambda: _geometry(state.model),
            on_change=self._status.publish,  # so that a status shows every setting
        )
        self._command_thread_prepared = False

    def start(self) -> None:
        state, session, keys = self.state, self._session, self.state.keys
        warm_up(state.model.period_s, len(state.tools))
        self._declared: list[Any] = [
            session.declare_queryable(keys.describe, self._queries.take_describe),
            session.declare_queryable(keys.geometry, self._queries.take_geometry),
            session.declare_queryable(keys.control("*", "*"), self._queries.take_control),
            session.liveliness().declare_subscriber(
                keys.client("*"), self._queries.take_liveliness, history=True
            ),
            session.declare_subscriber(keys.command("*"), self._on_command),
        ]
        self._deadline_thread = threading.Thread(target=self._run_deadlines, name="deadlines", daemon=True)
        self._threads = [
            threading.Thread(target=target, name=name, daemon=True)
            for name, target in (
                ("forces", self._forces.run),
                ("queries", self._queries.run),
                ("surface", self._surface.run),
            )
        ]
        if notice := threads.lock_memory():
            log.warning("%s", notice)
        threads.tune_interpreter()
        memory = state.memory
        memory.shared[shared_memory.DEADLINE_NS] = time.monotonic_ns() + memory.period_ns[0]
        for thread in (self._deadline_thread, *self._threads):
            thread.start()
        # Last: the token says that everything else answers.
        self._declared.append(session.liveliness().declare_token(keys.server))

    def stop(self) -> None:
        """Publish the status `stopping`, let the forces fade, stop the threads, undeclare everything."""
        state = self.state
        state.running = False  # commands are refused now, so the forces fade
        self.publish_status()
        time.sleep((safety.HOLD_NS + safety.DECAY_NS) * 1e-9 + 10 * state.model.period_s)
        self.publish_status()
        state.stopping.set()
        scheduler.stop(state.memory.shared)
        for declared in reversed(self._declared):
            declared.undeclare()
        self._queries.end()
        self._deadline_thread.join()
        self._requests.recordings.close()
        os.eventfd_write(self._wake, 1)
        for thread in self._threads:
            thread.join()
        os.close(self._wake)

    def publish_status(self) -> None:
        self._status.publish()

    def _on_command(self, sample: zenoh.Sample) -> None:
        """Zenoh calls this for every command, on the thread that receives them."""
        arrival_ns = time.monotonic_ns()
        if not self._command_thread_prepared:
            self._command_thread_prepared = True
            self._prepare_thread(threads.COMMAND_PRIORITY)  # the deadline thread logs what is not allowed
        if self._admission.admit(str(sample.key_expr), sample.payload, arrival_ns):
            self._forces.send()

    def _run_deadlines(self) -> None:
        for notice in self._prepare_thread(threads.LOOP_PRIORITY):
            log.warning("%s", notice)
        scheduler.run_at_deadlines(self.state.image, self._wake)

    def _prepare_thread(self, priority: int) -> list[str]:
        """Give the calling thread a real-time priority and the processor of --cpu. Returns what is not allowed."""
        pinned = None if self._cpu is None else threads.pin(self._cpu)
        return [notice for notice in (threads.raise_priority(priority), pinned) if notice]

    def _has_token(self, client: str) -> bool:
        replies = self._session.liveliness().get(self.state.keys.client(client), timeout=_ALIVE_TIMEOUT_S)
        return any(reply.ok is not None for reply in replies)


def serve(
    model: Model,
    session: zenoh.Session,
    keys: Keys,
    options: ServerOptions,
    stop: threading.Event,
    on_ready: Callable[[], None],
) -> None:
    """Serve a model until `stop` is set."""
    server = Server(model, session, keys, options)
    server.start()
    threads.raise_priority(threads.SERVICE_PRIORITY)
    try:
        on_ready()
        while not stop.wait(STATUS_PERIOD_S):
            server.publish_status()
    finally:
        server.stop()


def _geometry(model: Model) -> bytes:
    """The answer to a query for the geometry, with the error map of a surface model that has evidence."""
    error = model.accuracy.error_map if isinstance(model, SurfaceModel) else None
    if error is not None and not np.isfinite(error).all():
        error = None
    return codec.encode_geometry(*models.surface_at_rest(model), error)
