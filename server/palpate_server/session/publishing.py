"""Publishers: the force of each tick, the status, and the surface while somebody subscribes."""

from __future__ import annotations

import logging
import os
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import zenoh

from palpate_client.wire import ENCODING, pack
from palpate_server import codec
from palpate_server.coupling import models
from palpate_server.realtime import scheduler, threads
from palpate_server.realtime.records import RECORDS
from palpate_server.recording.black_box import BlackBox
from palpate_server.session.state import SessionState
from palpate_server.session.status import status

log = logging.getLogger("palpate_server")

MAX_UNSENT = 100  # forces of older ticks are dropped and counted


class ForcePublisher:
    """Sends the force of each tick, in order; `wake` is an eventfd that the deadline loop writes to after its ticks."""

    def __init__(self, state: SessionState, session: zenoh.Session, wake: int) -> None:
        self._state = state
        self._wake = wake
        self._sending = threading.Lock()
        self._encoder = codec.ForceEncoder(len(state.tools))
        ring = state.memory.ring  # stays the same when the model is exchanged
        self._ticks, self._ports = codec.as_words(ring.ticks), codec.as_words(ring.ports)
        self._sent = 0
        self._publisher = _publisher(session, state.keys.force, zenoh.Priority.REAL_TIME, express=True)

    def send(self) -> None:
        """Publish the ticks that are not sent yet. If another thread is doing that, wake `run` to send the rest."""
        if self._sending.acquire(blocking=False):
            self._send_and_release()
        else:
            os.eventfd_write(self._wake, 1)

    def run(self) -> None:
        """Send the forces of the deadline loop's ticks until the session stops."""
        threads.raise_priority(
            threads.COMMAND_PRIORITY
        )  # without commands, only this thread sends the fading forces
        while not self._state.stopping.is_set():
            os.eventfd_read(self._wake)
            self._sending.acquire()
            with logged("forces could not be sent"):
                self._send_and_release()

    def _send_and_release(self) -> None:
        try:
            head = int(scheduler.records_written(self._state.memory.shared))
            if head - self._sent > MAX_UNSENT:
                self._state.messages.unsent_forces += head - self._sent - MAX_UNSENT
                self._sent = head - MAX_UNSENT
            while self._sent < head:
                row = self._sent % RECORDS
                message = self._encoder.encode(self._ticks[row], self._ports[row])
                self._publisher.put(message)
                self._sent += 1
        finally:
            self._sending.release()


class StatusPublisher:
    """Sends the status, and has the black box examine the newest ticks."""

    def __init__(self, state: SessionState, session: zenoh.Session, black_box: BlackBox | None) -> None:
        self._state = state
        self._black_box = black_box
        self._publishing = threading.Lock()
        self._number = 0
        self._publisher = _publisher(session, state.keys.status, zenoh.Priority.DATA)

    def publish(self) -> None:
        """Send a status now; any thread may call this. An error is logged and not raised."""
        with logged("the status could not be sent"), self._publishing:
            recorder = self._state.recorder
            self._number += 1
            payload = pack(status(self._state, self._number))
            self._publisher.put(payload)
            if recorder is not None:
                recorder.status(payload)
            if self._black_box is not None:
                self._black_box.examine(self._state.lost_clients)


class SurfacePublisher:
    """Sends the displacement of the surface, once each surface_period_s, while somebody subscribes."""

    def __init__(self, state: SessionState, session: zenoh.Session) -> None:
        self._state = state
        self._tips = np.zeros((len(state.tools), 3))
        self._last_tick = -1
        self._publisher = _publisher(session, state.keys.surface, zenoh.Priority.DATA_LOW)

    def run(self) -> None:
        """Until the session stops."""
        threads.raise_priority(threads.SERVICE_PRIORITY)
        state = self._state
        due_s = time.monotonic()
        while not state.stopping.wait(max(0.0, due_s - time.monotonic())):
            due_s = max(due_s + state.surface_period_s, time.monotonic())
            if self._publisher.matching_status:
                with logged("the surface could not be sent"):
                    self._publish()

    def _publish(self) -> None:
        state = self._state
        with state.model_in_use:
            model = state.model
            shown_state = np.zeros(state.memory.coupling.shown_size())
            tick = scheduler.read_snapshot(state.image, shown_state, self._tips)
        if tick <= self._last_tick:
            return
        self._last_tick = tick
        displacement = models.shown_displacement(model, shown_state, self._tips)
        self._publisher.put(codec.encode_surface(tick, time.monotonic_ns(), displacement))


def _publisher(
    session: zenoh.Session, key: str, priority: zenoh.Priority, express: bool = False
) -> zenoh.Publisher:
    drop = zenoh.CongestionControl.DROP
    return session.declare_publisher(
        key, encoding=ENCODING, priority=priority, express=express, congestion_control=drop
    )


@contextmanager
def logged(text: str) -> Iterator[None]:
    """Log an exception and continue, so that it does not end the thread that sends all messages."""
    try:
        yield
    except Exception:
        log.exception(text)
