"""The running server: wires the tick loop, the messages and the leases to a Zenoh session, and stops them again."""

from __future__ import annotations

import itertools
import logging
import os
import queue
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import zenoh

from palpate.model_file import ReducedModel, StateSpace
from palpate_server import wire
from palpate_server.realtime import safety, scheduler, shared_memory, threads
from palpate_server.realtime.native_image import make_image
from palpate_server.realtime.safety import Limits
from palpate_server.recording.black_box import BlackBox
from palpate_server.session.leases import Refused
from palpate_server.session.requests import Control
from palpate_server.session.state import STATUS_PERIOD_S, Service

log = logging.getLogger("palpate_server")

USUAL_SURFACE_HZ, FASTEST_SURFACE_HZ = 30.0, 60.0
MAX_UNSENT = 100  # ticks whose forces are still worth sending; what is older is dropped and counted
MAX_WAITING = 64  # queries; more are refused at once
_LEASES_FIRST, _QUERIES, _END = range(3)  # the order in which events are served
_ALIVE_TIMEOUT_S = 1.0


class Server:
    """Serves one model in one Zenoh session, from `start` to `stop`.

    Threads: Zenoh's own one that receives commands (and runs most ticks), the deadline loop (compiled, never needs
    the GIL), one that sends the forces of its ticks, one for queries and leases, one for the surface; while they are
    asked for, one to load a model and one of a recorder. The thread that calls `publish_status` sends the status.

    models, recordings: folders that clients may load from, and have recordings made in (or None). cpu: to keep the
    threads that run ticks on, or None to leave that to the system.
    """

    def __init__(
        self,
        model: ReducedModel,
        limits: Limits,
        session: zenoh.Session,
        keys: wire.Keys,
        models: Path,
        black_box: Path | None = None,
        surface_hz: float = USUAL_SURFACE_HZ,
        cpu: int | None = None,
        recordings: Path | None = None,
    ) -> None:
        self.service = Service(model, limits, keys, 1 / surface_hz)
        self.control = Control(self.service, self._has_token, self.publish_status, models, recordings)
        self._session = session
        self._cpu = cpu
        self._publishing = threading.Lock()  # a status
        self._black_box = (
            BlackBox(black_box, keys.session, self.service.names, self.service.memory)
            if black_box is not None
            else None
        )
        self._command_thread_prepared = False
        self._events: queue.PriorityQueue[tuple[int, int, Callable[[], None]]] = queue.PriorityQueue()
        self._event_numbers = itertools.count()
        self._wake = os.eventfd(0)
        self._sending = threading.Lock()
        self._encoder = wire.ForceEncoder(len(self.service.names))
        self._sent = 0

    # Start and stop

    def start(self) -> None:
        with _notice_after(
            2.0, "compiling the real-time functions, once for this machine: about half a minute"
        ):
            warm_up(self.service.model.period_s, len(self.service.names))
        session, keys = self._session, self.service.keys
        real_time = zenoh.Priority.REAL_TIME
        drop = zenoh.CongestionControl.DROP
        self._force = session.declare_publisher(
            keys.force, encoding=wire.ENCODING, priority=real_time, express=True, congestion_control=drop
        )
        self._status = session.declare_publisher(
            keys.status, encoding=wire.ENCODING, priority=zenoh.Priority.DATA, congestion_control=drop
        )
        self._surface = session.declare_publisher(
            keys.surface, encoding=wire.ENCODING, priority=zenoh.Priority.DATA_LOW, congestion_control=drop
        )
        self._declared: list[Any] = [
            session.declare_queryable(keys.describe, self._queue_query(self._answer_describe)),
            session.declare_queryable(keys.geometry, self._queue_query(self._answer_geometry)),
            session.declare_queryable(keys.control("*", "*"), self._queue_query(self._answer_control)),
            session.liveliness().declare_subscriber(
                keys.client("*"),
                lambda sample: self._queue(_LEASES_FIRST, lambda: self._on_liveliness(sample)),
                history=True,
            ),
            session.declare_subscriber(keys.command("*"), self._on_command),
        ]
        self._threads = [
            threading.Thread(target=target, name=name, daemon=True)
            for name, target in (
                ("deadlines", self._run_deadlines),
                ("forces", self._send_at_deadlines),
                ("queries", self._serve_events),
                ("surface", self._publish_surfaces),
            )
        ]
        if notice := threads.lock_memory():
            log.warning(notice)
        threads.calm_interpreter()
        memory = self.service.memory
        memory.shared[shared_memory.DEADLINE_NS] = time.monotonic_ns() + memory.period_ns[0]
        for thread in self._threads:
            thread.start()
        # Last, as the sign that everything else answers.
        self._declared.append(session.liveliness().declare_token(keys.server))

    def stop(self) -> None:
        """Say so, let the forces fade, stop the loop and take everything back from the session."""
        service = self.service
        service.state = "stopping"  # from here on commands are refused, and forces fade as after silence
        self.publish_status()
        time.sleep((safety.HOLD_NS + safety.DECAY_NS) * 1e-9 + 10 * service.model.period_s)
        self.publish_status()
        service.stopping.set()
        scheduler.stop(service.memory.shared)
        for declared in reversed(self._declared):
            declared.undeclare()
        self._queue(_END, lambda: None)  # nothing comes behind it any more, and what is before it is refused
        self._threads[0].join()
        self.control.end_recording()
        os.eventfd_write(self._wake, 1)
        for thread in self._threads[1:]:
            thread.join()
        os.close(self._wake)

    # Commands in, forces out

    def _on_command(self, sample: zenoh.Sample) -> None:
        """Runs on Zenoh's thread for every command: hand it over, and tick if it is time."""
        arrival_ns = time.monotonic_ns()
        if not self._command_thread_prepared:
            self._command_thread_prepared = True
            self._prepare_thread(threads.COMMAND_PRIORITY)  # what it may not, the loop's thread has said
        service, messages = self.service, self.service.messages
        payload = sample.payload
        key = str(sample.key_expr)
        try:
            wire.check_size(len(payload), wire.MAX_COMMAND_BYTES)
            content = payload.to_bytes()
            if (recorder := service.recorder) is not None:
                recorder.command(key, content)
            command = wire.decode_command(content)
        except wire.MalformedMessage as error:
            messages.malformed[error.reason] += 1
            return
        # Read before it is known who holds the contacts: should one change hands meanwhile, the number tells.
        lease = service.memory.commands.lease.tolist()
        if reason := self._why_refused(command, wire.last_chunk(key), lease):
            messages.refused[reason] += 1
            return
        messages.accepted += 1
        *_, last = command.displacement_m
        for name, displacement in command.displacement_m.items():
            contact = service.contact_index[name]
            service.last_sequence[contact] = (lease[contact], command.sequence)
            messages.accepted_of[contact] += 1
            hand_over = scheduler.write_command if name is last else scheduler.stage_command
            hand_over(
                service.memory.commands,
                contact,
                command.sequence,
                command.client_time_ns,
                arrival_ns,
                command.rendered_tick,
                lease[contact],
                displacement,
                command.velocity_m_per_s[name],
            )
        if scheduler.tick_on_arrival(service.image, arrival_ns):
            self._send_forces()

    def _why_refused(self, command: wire.Command, client: str, lease: list[int]) -> str | None:
        """One of wire.REFUSED, or None when the command is to be carried out. Refused as a whole or not at all."""
        if self.service.state != "running":
            return "stopping"
        for name in command.displacement_m:
            contact = self.service.contact_index.get(name)
            if contact is None:
                return "unknown_contact"
            if self.service.leases.holders[name] != client:
                return "not_holder"
            last_lease, last_sequence = self.service.last_sequence[contact]
            if last_lease == lease[contact] and command.sequence <= last_sequence:
                return "old_sequence"
        if not wire.is_finite(command):
            return "not_finite"
        return None if wire.is_in_range(command) else "out_of_range"

    def _send_forces(self) -> None:
        """Publish the ticks that are not sent yet, in order, unless another thread is at it (which then is told)."""
        if self._sending.acquire(blocking=False):
            self._send_forces_alone()
        else:
            os.eventfd_write(self._wake, 1)

    def _send_forces_alone(self) -> None:
        """With `_sending` held, which is given back."""
        try:
            memory = self.service.memory
            head = int(scheduler.records_written(memory.shared))
            if head - self._sent > MAX_UNSENT:
                self.service.messages.unsent_forces += head - self._sent - MAX_UNSENT
                self._sent = head - MAX_UNSENT
            while self._sent < head:
                row = self._sent % shared_memory.RECORDS
                start_ns = int(memory.record_times[row, shared_memory.START_NS])
                payload = self._encoder.encode(
                    self._sent, start_ns, memory.record_inputs[row], memory.record_motion[row]
                )
                self._force.put(payload)
                self._sent += 1
        finally:
            self._sending.release()

    def _run_deadlines(self) -> None:
        for notice in self._prepare_thread(threads.LOOP_PRIORITY):
            log.warning(notice)
        scheduler.run_at_deadlines(self.service.image, self._wake)

    def _prepare_thread(self, priority: int) -> list[str]:
        """For ticks: real-time priority, and the processor that was asked for; what is not allowed."""
        pinned = None if self._cpu is None else threads.pin(self._cpu)
        return [notice for notice in (threads.raise_priority(priority), pinned) if notice]

    def _send_at_deadlines(self) -> None:
        threads.raise_priority(threads.COMMAND_PRIORITY)  # that a force fades is told by this thread alone
        while not self.service.stopping.is_set():
            os.eventfd_read(self._wake)
            self._sending.acquire()
            with _logged("forces could not be sent"):
                self._send_forces_alone()

    # Status and surface

    def publish_status(self) -> None:
        """Send the status, and see whether the black box has cause to write. No mistake in it ends the service."""
        with _logged("the status could not be sent"), self._publishing:
            self._publish_status()

    def _publish_status(self) -> None:
        recorder = self.service.recorder
        payload = wire.pack(self.service.status())
        self._status.put(payload)
        if recorder is not None:
            recorder.status(payload)
        if self._black_box is not None:
            self._black_box.examine(self.service.lost_clients)

    def _publish_surfaces(self) -> None:
        service = self.service
        tips = np.zeros((len(service.names), 3))
        last_tick = -1
        due_s = time.monotonic()
        while not service.stopping.wait(max(0.0, due_s - time.monotonic())):
            due_s = max(due_s + service.surface_period_s, time.monotonic())
            if not self._surface.matching_status:
                continue
            with _logged("the surface could not be sent"):
                with service.model_in_use:
                    surface = service.model.surface
                    state = np.zeros(service.model.order)
                    tick = scheduler.read_snapshot(service.image, state, tips)
                if tick <= last_tick:
                    continue
                last_tick = tick
                displacement = surface.output @ state.astype(np.float32)
                displacement += surface.feedthrough @ tips.ravel().astype(np.float32)
                self._surface.put(wire.encode_surface(tick, time.monotonic_ns(), displacement))

    # Queries and leases, one after another on a thread of their own

    def _queue(self, urgency: int, event: Callable[[], None]) -> None:
        """Leave work for the query thread: a Zenoh callback that did it would stall the session."""
        self._events.put((urgency, next(self._event_numbers), event))

    def _queue_query(self, answer: Callable[[zenoh.Query], None]) -> Callable[[zenoh.Query], None]:
        def take(query: zenoh.Query) -> None:
            try:
                # A large one is not left waiting: many would take much room.
                parts = (query.payload, query.attachment)
                wire.check_size(sum(len(part) for part in parts if part is not None), wire.MAX_REQUEST_BYTES)
            except wire.MalformedMessage as error:
                with query:
                    _refuse(query, error.reason, str(error))
                return
            if self._events.qsize() < MAX_WAITING:
                self._queue(_QUERIES, lambda: answer(query))
            else:
                with query:
                    _refuse(query, "busy", f"{MAX_WAITING} queries are waiting")

        return take

    def _serve_events(self) -> None:
        urgency = _QUERIES
        while urgency != _END:
            urgency, _, event = self._events.get()
            with _logged("a query could not be answered"):
                event()

    def _answer_describe(self, query: zenoh.Query) -> None:
        with query:
            query.reply(
                self.service.keys.describe, wire.pack(self.service.describe()), encoding=wire.ENCODING
            )

    def _answer_geometry(self, query: zenoh.Query) -> None:
        with query:
            surface = self.service.model.surface
            payload = wire.encode_geometry(surface.vertices, surface.triangles)
            query.reply(self.service.keys.geometry, payload, encoding=wire.ENCODING)

    def _answer_control(self, query: zenoh.Query) -> None:
        action = wire.client_and_action(str(query.key_expr))[1]
        if action in ("load", "record"):  # take their time, and change no lease
            threading.Thread(target=self._answer_action, args=(query,), name=action, daemon=True).start()
        else:
            self._answer_action(query)

    def _answer_action(self, query: zenoh.Query) -> None:
        with query:
            try:
                client, action = wire.client_and_action(str(query.key_expr))
                reply = self.control.carry_out(client, action, _request(query))
            except (wire.MalformedMessage, Refused) as error:
                _refuse(query, error.reason, str(error))
            except Exception:  # a mistake of ours: whoever waits for the answer shall not wait in vain
                log.exception("a query could not be answered")
                _refuse(query, "internal", "the server failed at it; its log says why")
            else:
                query.reply(query.key_expr, wire.pack(reply), encoding=wire.ENCODING)
                self.publish_status()  # so that no terms are unheard of, however soon they change again

    def _on_liveliness(self, sample: zenoh.Sample) -> None:
        client = wire.last_chunk(str(sample.key_expr))
        self.control.on_client(client, alive=sample.kind == zenoh.SampleKind.PUT)

    def _has_token(self, client: str) -> bool:
        replies = self._session.liveliness().get(self.service.keys.client(client), timeout=_ALIVE_TIMEOUT_S)
        return any(reply.ok is not None for reply in replies)


@contextmanager
def _logged(text: str) -> Iterator[None]:
    """A mistake in one message must not end the thread that serves all of them: log it and go on."""
    try:
        yield
    except Exception:
        log.exception(text)


@contextmanager
def _notice_after(seconds: float, text: str) -> Iterator[None]:
    """Say what is going on when it takes longer than this."""
    timer = threading.Timer(seconds, log.info, [text])
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        timer.cancel()


def warm_up(period_s: float, n_contacts: int) -> None:
    """Compile (or load from the cache) every function of the real-time path, on a model of its own."""
    channels = 3 * n_contacts
    system = StateSpace(
        np.zeros(2),
        np.zeros(2),
        np.zeros((2, channels)),
        np.zeros((channels, 2)),
        np.zeros((channels, channels)),
    )
    limits = [Limits(1.0, 1.0, 1.0, 1.0, 1.0)] * n_contacts
    memory = shared_memory.make_memory(system, period_s, limits, 1 / USUAL_SURFACE_HZ)
    scheduler.stage_command(memory.commands, 0, 1, 1, 1, -1, 0, wire.STILL, wire.STILL)
    scheduler.write_command(memory.commands, 0, 1, 1, 1, -1, 0, wire.STILL, wire.STILL)
    scheduler.forget_command(memory.commands, 0)
    image = make_image(memory)
    scheduler.tick_on_arrival(image, time.monotonic_ns())
    scheduler.records_written(memory.shared)
    wire.ForceEncoder(n_contacts).encode(0, 0, memory.record_inputs[0], memory.record_motion[0])
    scheduler.is_silent(image, 0)
    scheduler.set_frame(image, 0, np.eye(3), 1.0, np.zeros(3))
    scheduler.set_limits(image, 0, np.ones(5))
    scheduler.reset(image)
    scheduler.exchange(image, make_image(memory))
    scheduler.changed_at(image)
    scheduler.withdraw_change(image)
    scheduler.read_snapshot(image, np.zeros(2), np.zeros((n_contacts, 3)))
    scheduler.stop(memory.shared)
    wake = os.eventfd(0)
    scheduler.run_at_deadlines(image, wake)
    os.close(wake)


def _refuse(query: zenoh.Query, reason: str, message: str) -> None:
    query.reply_err(wire.pack({"reason": reason, "message": message}), encoding=wire.ENCODING)


def _request(query: zenoh.Query) -> dict[str, Any]:
    payload = query.payload
    if payload is None:
        return {}
    return wire.unpack_map(payload.to_bytes(), wire.MAX_REQUEST_BYTES)


def serve(
    model: ReducedModel,
    limits: Limits,
    session: zenoh.Session,
    keys: wire.Keys,
    stop: threading.Event,
    on_ready: Callable[[], None],
    models: Path,
    black_box: Path | None = None,
    surface_hz: float = USUAL_SURFACE_HZ,
    cpu: int | None = None,
    recordings: Path | None = None,
) -> None:
    """Serve until `stop` is set. Clients may load from the folder `models`, and record to the folder `recordings`, if any;
    black box files go to `black_box`, or nowhere.
    """
    server = Server(model, limits, session, keys, models, black_box, surface_hz, cpu, recordings)
    server.start()
    try:
        on_ready()
        while not stop.wait(STATUS_PERIOD_S):
            server.publish_status()
    finally:
        server.stop()
