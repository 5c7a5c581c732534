"""The running server: wires the tick loop, the messages and the leases to a Zenoh session, and stops them again."""

from __future__ import annotations

import itertools
import logging
import math
import os
import queue
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import zenoh

from palpate.model import ModelFileError, ReducedModel, StateSpace, load_model
from palpate_server import layout, loop, realtime, safety, telemetry, wire
from palpate_server.black_box import BlackBox
from palpate_server.devices import PROFILES, Device, limits_for, warnings_for
from palpate_server.frames import Frame, read_frame
from palpate_server.image import make_image
from palpate_server.leases import Leases, Refused, Terms
from palpate_server.recorder import Recorder, file_in
from palpate_server.safety import Flags, Limits

log = logging.getLogger("palpate_server")

STATUS_PERIOD_S = 0.1
USUAL_SURFACE_HZ, FASTEST_SURFACE_HZ = 30.0, 60.0
FADE_OVER_S = 0.5  # from one model to another
MAX_UNSENT = 100  # ticks whose forces are still worth sending; what is older is dropped and counted
MAX_WAITING = 64  # queries; more are refused at once
_LEASES_FIRST, _QUERIES, _END = range(3)  # the order in which events are served
_ALIVE_TIMEOUT_S = 1.0
_CHANGE_TIMEOUT_S = 1.0
_LONGEST_FILE_NAME = 255  # bytes, on the usual file systems


class Server:
    """Serves one model in one Zenoh session, from `start` to `stop`.

    Threads: Zenoh's own one that receives commands (and runs most ticks), the deadline loop (compiled, never needs
    the GIL), one that sends the forces of its ticks, one for queries and leases, one for the surface, one for a recording. The thread that
    calls `publish_status` sends the status.

    cpu: to keep the threads that run ticks on, or None to leave that to the system. recordings: the folder that clients
    may have recordings made in, or None.
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
        self.model = model
        self.limits = limits
        self.session = session
        self.keys = keys
        self.names = [contact.name for contact in model.contacts]
        self.leases = Leases(self.names, limits)
        self.messages = telemetry.MessageCounters(len(self.names))
        self.surface_period_s = 1 / surface_hz
        self.memory = layout.make_memory(
            model.discrete, model.period_s, [limits] * len(self.names), self.surface_period_s
        )
        self.image = make_image(self.memory)
        self._models = models
        self._cpu = cpu
        self._recordings = recordings
        self._recorder: Recorder | None = None
        self._recording = threading.Lock()  # is being started or ended
        self._publishing = threading.Lock()  # a status
        self._changing = threading.Lock()  # the loop has one slot for changes
        self._model_in_use = (
            threading.Lock()
        )  # while the surface is computed from it, and while it is exchanged
        self._loading = threading.Lock()
        self._black_box = (
            BlackBox(black_box, keys.session, self.names, self.memory) if black_box is not None else None
        )
        self._alive: set[str] = set()  # clients whose liveliness token is known
        self._contact_index = {name: i for i, name in enumerate(self.names)}
        self._command_thread_raised = False
        self._last_sequence = [-1] * len(self.names)
        self._state = "running"
        self._undisturbed_since_tick = (
            0  # by a reset or another model: until then a recording can be repeated
        )
        self._events: queue.PriorityQueue[tuple[int, int, Callable[[], None]]] = queue.PriorityQueue()
        self._event_numbers = itertools.count()
        self._stopping = threading.Event()
        self._wake = os.eventfd(0)
        self._sending = threading.Lock()
        self._encoder = wire.ForceEncoder(len(self.names))
        self._sent = 0

    # Start and stop

    def start(self) -> None:
        with _notice_after(
            2.0, "compiling the real-time functions, once for this machine: about half a minute"
        ):
            warm_up(self.model.period_s, len(self.names))
        session, keys = self.session, self.keys
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
        if notice := realtime.lock_memory():
            log.warning(notice)
        realtime.calm_interpreter()
        self.memory.shared[layout.DEADLINE_NS] = time.monotonic_ns() + self.memory.period_ns[0]
        for thread in self._threads:
            thread.start()
        # Last, as the sign that everything else answers.
        self._declared.append(session.liveliness().declare_token(keys.server))

    def stop(self) -> None:
        """Let the forces fade, say so in a last status, stop the loop and take everything back from the session."""
        self._state = "stopping"
        for contact in range(len(self.names)):
            loop.forget_command(self.memory.commands, contact)
        time.sleep((safety.DECAY_NS * 1e-9) + 10 * self.model.period_s)
        self.publish_status()
        loop.stop(self.memory.shared)
        self._stopping.set()
        self._queue(_END, lambda: None)
        self._threads[0].join()
        if self._recording.acquire(timeout=1.0) and self._recorder is not None:
            self._recorder.stop()
        os.eventfd_write(self._wake, 1)
        for thread in self._threads[1:]:
            thread.join()
        for declared in reversed(self._declared):
            declared.undeclare()
        os.close(self._wake)

    # Commands in, forces out

    def _on_command(self, sample: zenoh.Sample) -> None:
        """Runs on Zenoh's thread for every command: hand it over, and tick if it is time."""
        arrival_ns = time.monotonic_ns()
        if not self._command_thread_raised:
            self._command_thread_raised = True
            self._prepare_thread(
                realtime.COMMAND_PRIORITY
            )  # whether it may has been said by the loop's thread
        messages = self.messages
        payload = sample.payload
        key = str(sample.key_expr)
        try:
            if len(payload) > wire.MAX_COMMAND_BYTES:
                raise wire.MalformedMessage("too_large", f"payload has {len(payload)} bytes")
            content = payload.to_bytes()
            if (recorder := self._recorder) is not None:
                recorder.command(key, content)
            command = wire.decode_command(content)
        except wire.MalformedMessage as error:
            messages.malformed[error.reason] += 1
            return
        if reason := self._why_refused(command, wire.last_chunk(key)):
            messages.refused[reason] += 1
            return
        messages.accepted += 1
        for name, displacement in command.displacement_m.items():
            contact = self._contact_index[name]
            self._last_sequence[contact] = command.sequence
            messages.accepted_of[contact] += 1
            loop.write_command(
                self.memory.commands,
                contact,
                command.sequence,
                command.client_time_ns,
                arrival_ns,
                command.rendered_tick,
                displacement,
                command.velocity_m_per_s[name],
            )
        if loop.tick_on_arrival(self.image, arrival_ns):
            self._send_forces()

    def _why_refused(self, command: wire.Command, client: str) -> str | None:
        """One of wire.REFUSED, or None when the command is to be carried out. Refused as a whole or not at all."""
        if self._state != "running":
            return "stopping"
        for name in command.displacement_m:
            contact = self._contact_index.get(name)
            if contact is None:
                return "unknown_contact"
            if self.leases.holders[name] != client:
                return "not_holder"
            if command.sequence <= self._last_sequence[contact]:
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
            memory = self.memory
            head = int(loop.records_written(memory.shared))
            if head - self._sent > MAX_UNSENT:
                self.messages.unsent_forces += head - self._sent - MAX_UNSENT
                self._sent = head - MAX_UNSENT
            while self._sent < head:
                row = self._sent % layout.RECORDS
                start_ns = int(memory.record_times[row, layout.START_NS])
                payload = self._encoder.encode(
                    self._sent, start_ns, memory.record_inputs[row], memory.record_motion[row]
                )
                self._force.put(payload)
                self._sent += 1
        finally:
            self._sending.release()

    def _run_deadlines(self) -> None:
        for notice in self._prepare_thread(realtime.LOOP_PRIORITY):
            log.warning(notice)
        loop.run_at_deadlines(self.image, self._wake)

    def _prepare_thread(self, priority: int) -> list[str]:
        """For ticks: real-time priority, and the processor that was asked for; what is not allowed."""
        pinned = None if self._cpu is None else realtime.pin(self._cpu)
        return [notice for notice in (realtime.raise_priority(priority), pinned) if notice]

    def _send_at_deadlines(self) -> None:
        while not self._stopping.is_set():
            os.eventfd_read(self._wake)
            self._sending.acquire()
            self._send_forces_alone()

    # Status and surface

    def publish_status(self) -> None:
        """Send the status, and see whether the black box has cause to write. No mistake in it ends the service."""
        try:
            with self._publishing:
                self._publish_status()
        except Exception:
            log.exception("the status could not be sent")

    def _publish_status(self) -> None:
        recorder = self._recorder
        status = telemetry.status(
            self._state,
            time.monotonic_ns(),
            self.model,
            self.memory,
            self.messages,
            self.leases,
            self._undisturbed_since_tick,
            None if recorder is None else recorder.report(),
        )
        payload = wire.pack(status)
        self._status.put(payload)
        if recorder is not None:
            recorder.status(payload)
        if self._black_box is not None:
            self._black_box.examine()

    def _publish_surfaces(self) -> None:
        tips = np.zeros((len(self.names), 3))
        last_tick = -1
        due_s = time.monotonic()
        while not self._stopping.wait(max(0.0, due_s - time.monotonic())):
            due_s = max(due_s + self.surface_period_s, time.monotonic())
            if not self._surface.matching_status:
                continue
            with self._model_in_use:
                surface = self.model.surface
                state = np.zeros(self.model.order)
                tick = loop.read_snapshot(self.image, state, tips)
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
            try:
                event()
            except Exception:  # one client's query must not end the service of the others
                log.exception("a query could not be answered")

    def _answer_describe(self, query: zenoh.Query) -> None:
        with query:
            query.reply(self.keys.describe, wire.pack(self._describe()), encoding=wire.ENCODING)

    def _describe(self) -> dict[str, Any]:
        return describe(self.model, self.limits, self.keys.session, self.surface_period_s)

    def _answer_geometry(self, query: zenoh.Query) -> None:
        with query:
            surface = self.model.surface
            payload = wire.encode_geometry(surface.vertices, surface.triangles)
            query.reply(self.keys.geometry, payload, encoding=wire.ENCODING)

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
                reply = self._carry_out(client, action, _request(query))
            except (wire.MalformedMessage, Refused) as error:
                _refuse(query, error.reason, str(error))
            except Exception:  # a mistake of ours: whoever waits for the answer shall not wait in vain
                log.exception("a query could not be answered")
                _refuse(query, "internal", "the server failed at it; its log says why")
            else:
                query.reply(query.key_expr, wire.pack(reply), encoding=wire.ENCODING)
                self.publish_status()  # so that no terms are unheard of, however soon they change again

    def _carry_out(self, client: str, action: str, request: dict[str, Any]) -> dict[str, Any]:
        if not wire.is_name(client):
            raise wire.MalformedMessage(
                "wrong_type", f"the client in the key is {client!r}: expected 1 to 64 of A-Z a-z 0-9 _ -"
            )
        if action == "acquire":
            return self._acquire(client, request)
        if action == "release":
            return {"contacts": list(self._release(client))}
        if action == "limits":
            return self._set_limits(client, request)
        if action == "reset":
            return self._reset(client)
        if action == "load":
            return self._load(client, request)
        if action == "record":
            return self._record(request)
        known = ", ".join(wire.ACTIONS)
        raise Refused("unknown_action", f"no control action is called {action!r}: there are {known}")

    def _acquire(self, client: str, request: dict[str, Any]) -> dict[str, Any]:
        contacts = request.get("contacts")
        if not isinstance(contacts, list) or not contacts or not all(isinstance(c, str) for c in contacts):
            raise wire.MalformedMessage("wrong_type", f"contacts is {contacts!r}: expected a list of names")
        try:
            frame = read_frame(request.get("frame"))
        except ValueError as error:
            raise wire.MalformedMessage("wrong_type", str(error)) from error
        device = _device(request)
        if self._state != "running":
            raise Refused("stopping", "the server is stopping")
        self._check_alive(client)
        self.leases.check(client, contacts)

        limits = self.limits if device is None else limits_for(device.profile, self.limits)
        self._silence(contacts)
        for name in contacts:
            self._last_sequence[self._contact_index[name]] = -1
            self._set_terms(name, limits, frame, device)
        self.leases.holders |= dict.fromkeys(contacts, client)
        return {
            "contacts": contacts,
            "limits": limits._asdict(),
            "frame": asdict(frame),
            "warnings": self._warnings(contacts),
        }

    def _check_alive(self, client: str) -> None:
        if client in self._alive:
            return
        token = self.keys.client(client)  # may be so new that we have not been told of it
        replies = self.session.liveliness().get(token, timeout=_ALIVE_TIMEOUT_S)
        if not any(reply.ok is not None for reply in replies):
            raise Refused("not_alive", f"client {client!r} has no liveliness token at {token}")

    def _silence(self, contacts: list[str]) -> None:
        """Let the contacts' forces fade to zero, as after a client that has gone, and wait for it.

        Until it is over nobody holds them, so that no command is heard. Refused when one does not fade: then they are
        held as before.
        """
        before = {name: self.leases.holders[name] for name in contacts}
        self.leases.holders |= dict.fromkeys(contacts)
        indices = [self._contact_index[name] for name in contacts]
        for contact in indices:
            loop.forget_command(self.memory.commands, contact)
        give_up = time.monotonic() + 10 * safety.DECAY_NS * 1e-9
        while not all(loop.is_silent(self.image, contact) for contact in indices):
            if time.monotonic() > give_up:
                self.leases.holders |= before
                raise Refused("busy", "the force did not fade in time: the server is overloaded")
            time.sleep(self.model.period_s)

    def _set_terms(self, name: str, limits: Limits, frame: Frame, device: Device | None) -> None:
        contact = self._contact_index[name]
        rotation, origin = np.array(frame.rotation), np.array(frame.origin_m)
        held_since = self._between_ticks(loop.set_frame, contact, rotation, frame.scale, origin)
        # The tip is at rest now, where it does not matter that the limits come a tick later.
        since = self._between_ticks(loop.set_limits, contact, np.array(limits))
        self.leases.terms[name] = Terms(limits, frame, device, since, held_since)

    def _between_ticks(self, ask: Callable[..., None], *what: Any) -> int:
        """Have the loop change something; the first tick after it. Raises Refused when no tick comes."""
        with self._changing:
            self._wait_for_change()
            ask(self.image, *what)
            return self._wait_for_change()

    def _wait_for_change(self) -> int:
        give_up = time.monotonic() + _CHANGE_TIMEOUT_S
        while (tick := loop.changed_at(self.image)) < 0:
            if time.monotonic() > give_up:
                raise Refused(
                    "busy", "no tick came that could have made the change: the server is overloaded"
                )
            time.sleep(self.model.period_s / 4)
        return tick

    def _warnings(self, contacts: Iterable[str]) -> list[str]:
        """What whoever renders these contacts with the device it named should know of the model that runs."""
        warnings: list[str] = []
        for name in contacts:
            terms = self.leases.terms[name]
            if terms.device is not None:
                index = self._contact_index[name]
                warnings += warnings_for(terms.device, self.model, index, terms.frame.scale)
        return list(dict.fromkeys(warnings))  # contacts are often alike

    def _set_limits(self, client: str, request: dict[str, Any]) -> dict[str, Any]:
        held = self.leases.held_by(client)
        wanted = request.get("limits")
        if not isinstance(wanted, dict) or not wanted:
            raise wire.MalformedMessage("wrong_type", f"limits is {wanted!r}: expected a map of numbers")
        if not held:
            raise Refused("not_holder", f"client {client!r} holds no contact")
        for field in wanted:
            if field not in Limits._fields:
                raise Refused(
                    "unknown_limit", f"no limit is called {field!r}: there are {', '.join(Limits._fields)}"
                )
            value, ceiling = _optional_number(wanted, field), getattr(self.limits, field)
            if value is None:
                raise wire.MalformedMessage("wrong_type", f"{field} is None: expected a number")
            if field != "max_damping_n_s_per_m" and not 0 < value <= ceiling:
                raise Refused("limit_too_high", f"{field} is {value}: expected above 0, at most {ceiling}")
            # Of the server's largest force, not the client's own: one that was allowed before may still stand.
            least = safety.least_force_rate(self.limits.max_force_n)
            if field == "max_force_rate_n_per_s" and value < least:
                raise Refused(
                    "limit_too_low",
                    f"{field} is {value}: expected at least {least:g}, so that a force can fade in time",
                )
        for name in held:
            terms = self.leases.terms[name]
            limits = terms.limits._replace(**wanted)
            tick = self._between_ticks(loop.set_limits, self._contact_index[name], np.array(limits))
            self.leases.terms[name] = replace(terms, limits=limits, since_tick=tick)
        return {"contacts": list(held), "limits": limits._asdict()}

    def _reset(self, client: str) -> dict[str, Any]:
        self._check_alone(client)
        self._undisturbed_since_tick = self._between_ticks(loop.reset)
        return {}

    def _check_alone(self, client: str) -> None:
        for name, holder in self.leases.holders.items():
            if holder not in (None, client):
                raise Refused("held", f"contact {name!r} is held by client {holder!r}, who would feel it")
        if not self.leases.held_by(client):
            raise Refused("not_holder", f"client {client!r} holds no contact")

    def _load(self, client: str, request: dict[str, Any]) -> dict[str, Any]:
        """Check another model file, build it beside the running one, fade over to it, and let the old one go."""
        self._check_alone(client)
        if not self._loading.acquire(blocking=False):
            raise Refused("busy", "another model is being loaded")
        try:
            model = self._read_model(request.get("model"))
            displacement = self.memory.displacement.ravel().copy()
            following = layout.make_model(model.discrete, displacement)
            step = model.period_s / FADE_OVER_S
            fading = self.memory._replace(next_model=following, fade=np.array([0.0, step]))
            self._undisturbed_since_tick = self._between_ticks(loop.exchange, make_image(fading))
            while fading.fade[0] < 1.0:
                if self._stopping.wait(model.period_s):
                    raise Refused("stopping", "the server is stopping")
            with self._model_in_use:
                self.memory = self.memory._replace(
                    model=following,
                    snapshot_version=np.zeros(1, np.int64),
                    snapshot_tick=np.full(1, -1),
                    snapshot_state=np.zeros(model.order),
                )
                self._between_ticks(loop.exchange, make_image(self.memory))
                self.model = model
            log.info("now serving %s (order %d)", model.name, model.order)
            warnings = self._warnings(self.leases.held_by(client))
            return {"model": model.name, "order": model.order, "warnings": warnings}
        finally:
            self._loading.release()

    def _read_model(self, name: object) -> ReducedModel:
        if not isinstance(name, str) or Path(name).name != name or name in ("", ".", ".."):
            raise Refused(
                "bad_model", f"model is {str(name)[:300]!r}: expected a file's name, without a folder"
            )
        if len(os.fsencode(name)) > _LONGEST_FILE_NAME or "\0" in name:
            raise Refused(
                "bad_model",
                f"model is {name[:40]!r}...: expected a file's name of at most {_LONGEST_FILE_NAME} bytes",
            )
        path = self._models / name
        try:
            if path.is_symlink() and path.resolve().parent != self._models.resolve():
                raise Refused("bad_model", f"{name}: leads out of the folder of models")
            model = load_model(path)
        except (OSError, RuntimeError, ModelFileError) as error:  # RuntimeError: links in a circle
            raise Refused("bad_model", str(error).replace(f"{self._models}/", "")) from error
        names = [contact.name for contact in model.contacts]
        if names != self.names:
            raise Refused(
                "bad_model", f"{name}: its contacts are {names}, the running model's are {self.names}"
            )
        if model.period_s != self.model.period_s:
            raise Refused(
                "bad_model",
                f"{name}: its period is {model.period_s} s, the running model's {self.model.period_s} s",
            )
        return model

    def _record(self, request: dict[str, Any]) -> dict[str, Any]:
        """Start or end a recording, whoever asks; it belongs to no client."""
        if self._recordings is None:
            raise Refused("no_recordings", "the server was started without a folder for recordings")
        if "file" not in request:
            raise wire.MalformedMessage("missing_field", "file is missing: expected a name, or null")
        if not self._recording.acquire(blocking=False):
            raise Refused("busy", "a recording is being started or ended")
        try:
            if request["file"] is None:
                return self._end_recording()
            path = file_in(self._recordings, request["file"])
            if self._state != "running":
                raise Refused("stopping", "the server is stopping")
            if self._recorder is not None and self._recorder.error is None:
                raise Refused("busy", f"{self._recorder.file} is being recorded")
            self._recorder = Recorder(path, self.keys, self._describe(), self.memory)
            return {"file": path.name}
        finally:
            self._recording.release()

    def _end_recording(self) -> dict[str, Any]:
        recorder = self._recorder
        if recorder is None:
            raise Refused("not_recording", "there is no recording to end")
        self.publish_status()  # what is recorded can be repeated as far as a status tells of it
        self._recorder = None
        recorder.stop()
        return recorder.report()

    def _release(self, client: str) -> tuple[str, ...]:
        released = self.leases.release(client)
        for name in released:
            loop.forget_command(self.memory.commands, self._contact_index[name])
        return released

    def _on_liveliness(self, sample: zenoh.Sample) -> None:
        client = wire.last_chunk(str(sample.key_expr))
        if sample.kind == zenoh.SampleKind.PUT:
            self._alive.add(client)
        else:
            self._alive.discard(client)
            for name in self._release(client):
                log.info("client %s is gone: contact %s is free", client, name)


def describe(model: ReducedModel, limits: Limits, session: str, surface_period_s: float) -> dict[str, Any]:
    """The describe reply: what a client must know before it moves anything."""
    summary = model.summary()
    summary["evidence"].pop("hankel_singular_values")
    return {
        "schema_version": wire.SCHEMA_VERSION,
        "session": session,
        "period_s": model.period_s,
        "contacts": [asdict(contact) for contact in model.contacts],
        "limits": limits._asdict(),
        "devices": {name: asdict(profile) for name, profile in PROFILES.items()},
        "hold_s": safety.HOLD_NS * 1e-9,
        "decay_s": safety.DECAY_NS * 1e-9,
        "soft_start_s": safety.SOFT_START_NS * 1e-9,
        "status_period_s": STATUS_PERIOD_S,
        "surface_period_s": surface_period_s,
        "flags": {flag.name: flag.value for flag in Flags},
        "model": summary,
    }


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
    memory = layout.make_memory(system, period_s, limits, 1 / USUAL_SURFACE_HZ)
    loop.write_command(memory.commands, 0, 1, 1, 1, -1, wire.STILL, wire.STILL)
    loop.forget_command(memory.commands, 0)
    image = make_image(memory)
    loop.tick_on_arrival(image, time.monotonic_ns())
    loop.records_written(memory.shared)
    wire.ForceEncoder(n_contacts).encode(0, 0, memory.record_inputs[0], memory.record_motion[0])
    loop.is_silent(image, 0)
    loop.set_frame(image, 0, np.eye(3), 1.0, np.zeros(3))
    loop.set_limits(image, 0, np.ones(5))
    loop.reset(image)
    loop.exchange(image, make_image(memory))
    loop.changed_at(image)
    loop.read_snapshot(image, np.zeros(2), np.zeros((n_contacts, 3)))
    loop.stop(memory.shared)
    wake = os.eventfd(0)
    loop.run_at_deadlines(image, wake)
    os.close(wake)


def _refuse(query: zenoh.Query, reason: str, message: str) -> None:
    query.reply_err(wire.pack({"reason": reason, "message": message}), encoding=wire.ENCODING)


def _device(request: dict[str, Any]) -> Device | None:
    name = request.get("device")
    if name is None:
        return None
    if not (isinstance(name, str) and name in PROFILES):
        raise Refused("unknown_device", f"device is {name!r}: there are {', '.join(PROFILES)}")
    return Device(
        PROFILES[name],
        _optional_number(request, "round_trip_s"),
        _optional_number(request, "device_damping_n_s_per_m"),
    )


def _optional_number(request: dict[str, Any], field: str) -> float | None:
    value = request.get(field)
    if value is None:
        return None
    if not isinstance(value, int | float) or isinstance(value, bool) or not 0 <= value < math.inf:
        raise wire.MalformedMessage("wrong_type", f"{field} is {value!r}: expected a number, at least 0")
    return float(value)


def _request(query: zenoh.Query) -> dict[str, Any]:
    payload = query.payload
    if payload is None:
        return {}
    if len(payload) > wire.MAX_REQUEST_BYTES:
        raise wire.MalformedMessage("too_large", f"payload has {len(payload)} bytes")
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
