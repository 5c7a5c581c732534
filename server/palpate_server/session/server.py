"""The running server: connects the loop, the messages and the leases to a Zenoh session, and ends them again."""

from __future__ import annotations

import logging
import os
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import zenoh

from palpate.model_file import ReducedModel
from palpate_client.wire import Keys, pack
from palpate_server import codec
from palpate_server.realtime import safety, scheduler, shared_memory, threads
from palpate_server.realtime.safety import Limits
from palpate_server.recording.black_box import BlackBox
from palpate_server.session.admission import Admission
from palpate_server.session.publishing import ForcePublisher, StatusPublisher, SurfacePublisher
from palpate_server.session.queries import Queries
from palpate_server.session.requests import Requests
from palpate_server.session.state import SessionState
from palpate_server.session.status import STATUS_PERIOD_S, description
from palpate_server.session.warm_up import warm_up

log = logging.getLogger("palpate_server")

USUAL_RECORDINGS_BYTES = 10 * 10**9
USUAL_SURFACE_HZ, FASTEST_SURFACE_HZ = 30.0, 60.0
_ALIVE_TIMEOUT_S = 1.0


@dataclass(frozen=True)
class ServerOptions:
    """How a model is served.

    limits      what no client can exceed
    models      the folder that clients may load from
    recordings  the folder that clients may have recordings made in, or None; it may hold max_recordings_bytes
    black_box   the folder for black box files, or None
    surface_hz  surfaces a second, at most FASTEST_SURFACE_HZ
    cpu         the processor for the threads that run ticks, or None to leave that to the system
    """

    limits: Limits
    models: Path
    recordings: Path | None = None
    max_recordings_bytes: int = USUAL_RECORDINGS_BYTES
    black_box: Path | None = None
    surface_hz: float = USUAL_SURFACE_HZ
    cpu: int | None = None


class Server:
    """Serves one model in one Zenoh session, from `start` to `stop`.

    Threads: Zenoh's own one that receives commands (and runs most ticks), the deadline loop (compiled, never needs
    the GIL), one that sends the forces of its ticks, one for queries and leases, one for the surface; while they are
    asked for, one to load a model and one of a recorder. The thread that calls `publish_status` sends the status.
    """

    def __init__(
        self, model: ReducedModel, session: zenoh.Session, keys: Keys, options: ServerOptions
    ) -> None:
        state = SessionState(model, options.limits, keys, 1 / options.surface_hz)
        self.state = state
        self._session = session
        self._cpu = options.cpu
        black_box = options.black_box and BlackBox(
            options.black_box, keys.session, list(state.tools), state.memory
        )
        self._wake = os.eventfd(0)
        self._admission = Admission(state)
        self._forces = ForcePublisher(state, session, self._wake)
        self._status = StatusPublisher(state, session, black_box or None)
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
            describe=lambda: pack(description(state)),
            geometry=lambda: codec.encode_geometry(
                state.model.surface.vertices, state.model.surface.triangles
            ),
            on_change=self._status.publish,  # so that every setting is told, however soon it changes again
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
        self._threads = [
            threading.Thread(target=target, name=name, daemon=True)
            for name, target in (
                ("deadlines", self._run_deadlines),
                ("forces", self._forces.run),
                ("queries", self._queries.run),
                ("surface", self._surface.run),
            )
        ]
        if notice := threads.lock_memory():
            log.warning("%s", notice)
        threads.calm_interpreter()
        memory = state.memory
        memory.shared[shared_memory.DEADLINE_NS] = time.monotonic_ns() + memory.period_ns[0]
        for thread in self._threads:
            thread.start()
        # Last, as the sign that everything else answers.
        self._declared.append(session.liveliness().declare_token(keys.server))

    def stop(self) -> None:
        """Say so, let the forces fade, stop the loop and take everything back from the session."""
        state = self.state
        state.running = False  # from here on commands are refused, and forces fade as after silence
        self.publish_status()
        time.sleep((safety.HOLD_NS + safety.DECAY_NS) * 1e-9 + 10 * state.model.period_s)
        self.publish_status()
        state.stopping.set()
        scheduler.stop(state.memory.shared)
        for declared in reversed(self._declared):
            declared.undeclare()
        self._queries.end()
        self._threads[0].join()
        self._requests.recordings.close()
        os.eventfd_write(self._wake, 1)
        for thread in self._threads[1:]:
            thread.join()
        os.close(self._wake)

    def publish_status(self) -> None:
        self._status.publish()

    def _on_command(self, sample: zenoh.Sample) -> None:
        """Runs on Zenoh's thread for every command: hand it over, and tick if it is time."""
        arrival_ns = time.monotonic_ns()
        if not self._command_thread_prepared:
            self._command_thread_prepared = True
            self._prepare_thread(threads.COMMAND_PRIORITY)  # what it may not, the loop's thread has said
        if self._admission.admit(str(sample.key_expr), sample.payload, arrival_ns):
            self._forces.send()

    def _run_deadlines(self) -> None:
        for notice in self._prepare_thread(threads.LOOP_PRIORITY):
            log.warning("%s", notice)
        scheduler.run_at_deadlines(self.state.image, self._wake)

    def _prepare_thread(self, priority: int) -> list[str]:
        """For ticks: real-time priority, and the processor that was asked for; what is not allowed."""
        pinned = None if self._cpu is None else threads.pin(self._cpu)
        return [notice for notice in (threads.raise_priority(priority), pinned) if notice]

    def _has_token(self, client: str) -> bool:
        replies = self._session.liveliness().get(self.state.keys.client(client), timeout=_ALIVE_TIMEOUT_S)
        return any(reply.ok is not None for reply in replies)


def serve(
    model: ReducedModel,
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
