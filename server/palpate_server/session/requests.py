"""What clients ask for: contacts, limits, a reset, another model, a recording. Each is carried out, or refused with a reason."""

from __future__ import annotations

import logging
import math
import threading
import time
from collections.abc import Callable, Iterable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from palpate.files import LONGEST_NAME_BYTES, is_plain_name
from palpate.model_file import ModelFileError, ReducedModel, load_model
from palpate_server import wire
from palpate_server.realtime import safety, scheduler, shared_memory
from palpate_server.realtime.frames import Frame, read_frame
from palpate_server.realtime.native_image import make_image
from palpate_server.realtime.safety import Limits
from palpate_server.recording.recorder import Recorder, file_in
from palpate_server.session.devices import PROFILES, Device, limits_for, warnings_for
from palpate_server.session.leases import Refused, Terms
from palpate_server.session.state import Service

log = logging.getLogger("palpate_server")

FADE_OVER_S = 0.5  # from one model to another
LEAST_SPEED_M_PER_S = 0.01
MOST_DAMPING_N_S_PER_M = 100.0  # that passivity control may do without a device that says what it can


class Control:
    """Carries out the actions of wire.ACTIONS; leases change on one thread alone, the one that calls `carry_out`.

    has_token       asks the session whether a client has its liveliness token
    publish_status  sends a status now
    models          the folder that clients may load from
    recordings      the folder that clients may have recordings made in, or None
    """

    def __init__(
        self,
        service: Service,
        has_token: Callable[[str], bool],
        publish_status: Callable[[], None],
        models: Path,
        recordings: Path | None,
    ) -> None:
        self._service = service
        self._has_token = has_token
        self._publish_status = publish_status
        self._models = models
        self._recordings = recordings
        self._alive: set[str] = set()  # clients whose liveliness token is known
        self._loading = threading.Lock()
        self._handed_over: tuple[
            shared_memory.Memory, ...
        ] = ()  # what the loop may run on, also at the very end
        self._recording = threading.Lock()  # is being started or ended

    def on_client(self, client: str, alive: bool) -> None:
        """A client's liveliness token has come or gone; with it go its contacts."""
        if alive:
            self._alive.add(client)
            return
        self._alive.discard(client)
        released = self._release(client)
        self._service.lost_clients += bool(released)
        for name in released:
            log.info("client %s is gone: contact %s is free", client, name)

    def end_recording(self) -> None:
        """At the end of the service."""
        if self._recording.acquire(timeout=1.0) and self._service.recorder is not None:
            self._service.recorder.stop()

    def carry_out(self, client: str, action: str, request: dict[str, Any]) -> dict[str, Any]:
        """The answer to a client's request. Raises Refused, or MalformedMessage for a request that breaks the schema."""
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
        contacts = _needed(request, "contacts")
        if not isinstance(contacts, list) or not contacts or not all(isinstance(c, str) for c in contacts):
            raise wire.MalformedMessage("wrong_type", f"contacts is {contacts!r}: expected a list of names")
        if len(set(contacts)) < len(contacts):
            raise wire.MalformedMessage("wrong_shape", "contacts names one of them twice")
        try:
            frame = read_frame(request.get("frame"))
        except TypeError as error:
            raise wire.MalformedMessage("wrong_type", str(error)) from error
        except ValueError as error:
            raise Refused("out_of_range", str(error)) from error
        device = _device(request)
        if self._service.state != "running":
            raise Refused("stopping", "the server is stopping")
        self._check_alive(client)
        self._service.leases.check(client, contacts)

        limits = self._service.limits if device is None else limits_for(device.profile, self._service.limits)
        if not self._loading.acquire(blocking=False):  # whoever comes now would feel the change
            raise Refused("busy", "another model is being loaded")
        try:
            self._silence(contacts)
            for name in contacts:
                self._set_terms(name, limits, frame, device)
            self._service.leases.holders |= dict.fromkeys(contacts, client)
        finally:
            self._loading.release()
        return {
            "contacts": contacts,
            "limits": limits._asdict(),
            "frame": asdict(frame),
            "warnings": self._warnings(contacts),
        }

    def _check_alive(self, client: str) -> None:
        # A token may be so new that we have not been told of it.
        if client not in self._alive and not self._has_token(client):
            token = self._service.keys.client(client)
            raise Refused("not_alive", f"client {client!r} has no liveliness token at {token}")

    def _silence(self, contacts: list[str]) -> None:
        """Let the contacts' forces fade to zero, as after a client that has gone, and wait for it.

        Until it is over nobody holds them, so that no command is heard. Refused when one does not fade: then they are
        held as before.
        """
        before = {name: self._service.leases.holders[name] for name in contacts}
        self._service.leases.holders |= dict.fromkeys(contacts)
        self._service.forget_commands(contacts)
        indices = [self._service.contact_index[name] for name in contacts]
        give_up = time.monotonic() + 10 * safety.DECAY_NS * 1e-9
        while not all(scheduler.is_silent(self._service.image, contact) for contact in indices):
            if time.monotonic() > give_up:
                self._service.leases.holders |= before
                raise Refused("busy", "the force did not fade in time: the server is overloaded")
            time.sleep(self._service.model.period_s)

    def _set_terms(self, name: str, limits: Limits, frame: Frame, device: Device | None) -> None:
        contact = self._service.contact_index[name]
        rotation, origin = np.array(frame.rotation), np.array(frame.origin_m)
        terms = self._service.leases.terms  # true at each moment, also if no tick comes for the second half
        held_since = self._service.between_ticks(scheduler.set_frame, contact, rotation, frame.scale, origin)
        terms[name] = Terms(terms[name].limits, frame, device, held_since, held_since)
        # The tip is at rest now, where it does not matter that the limits come a tick later.
        since = self._service.between_ticks(scheduler.set_limits, contact, np.array(limits))
        terms[name] = replace(terms[name], limits=limits, since_tick=since)

    def _warnings(self, contacts: Iterable[str]) -> list[str]:
        """What whoever renders these contacts with the device it named should know of the model that runs."""
        warnings: list[str] = []
        for name in contacts:
            terms = self._service.leases.terms[name]
            if terms.device is not None:
                index = self._service.contact_index[name]
                warnings += warnings_for(terms.device, self._service.model, index, terms.frame.scale)
        return list(dict.fromkeys(warnings))  # contacts are often alike

    def _set_limits(self, client: str, request: dict[str, Any]) -> dict[str, Any]:
        leases = self._service.leases
        wanted = _needed(request, "limits")
        if not isinstance(wanted, dict):
            raise wire.MalformedMessage("wrong_type", f"limits is {wanted!r}: expected a map of numbers")
        for field in wanted:
            if field not in Limits._fields:
                known = ", ".join(Limits._fields)
                raise Refused("unknown_limit", f"no limit is called {field!r}: there are {known}")
        numbers = {field: _number(wanted, field) for field in wanted}
        held = leases.held_by(client)
        if not held:
            raise Refused("not_holder", f"client {client!r} holds no contact")
        for name in held:  # for all of them or for none
            self._check_limits(numbers, leases.terms[name].device)
        for name in held:
            limits = leases.terms[name].limits._replace(**numbers)
            tick = self._service.between_ticks(
                scheduler.set_limits, self._service.contact_index[name], np.array(limits)
            )
            leases.terms[name] = replace(leases.terms[name], limits=limits, since_tick=tick)
        return {
            "contacts": list(held),
            "limits": {name: leases.terms[name].limits._asdict() for name in held},
        }

    def _check_limits(self, wanted: dict[str, float], device: Device | None) -> None:
        """Raises Refused for one that is beyond the server's, or the device's that renders."""
        ceiling = self._service.limits._replace(max_damping_n_s_per_m=MOST_DAMPING_N_S_PER_M)
        if device is not None:
            ceiling = limits_for(device.profile, ceiling)
        # Of the server's largest force, not the client's own: one that was allowed before may still stand.
        least_rate = safety.least_force_rate(self._service.limits.max_force_n)
        for field, value in wanted.items():
            most = getattr(ceiling, field)
            if field == "max_damping_n_s_per_m":
                allowed, expected = 0 <= value <= most, f"0 to {most:g}"
            elif field == "max_speed_m_per_s":
                allowed = min(LEAST_SPEED_M_PER_S, most) <= value <= most
                expected = f"{LEAST_SPEED_M_PER_S:g} to {most:g}, so that a tip can be withdrawn"
            elif field == "max_force_rate_n_per_s":
                allowed = least_rate <= value <= most
                expected = f"{least_rate:g} to {most:g}, so that a force can fade in time"
            else:
                allowed, expected = 0 < value <= most, f"above 0, at most {most:g}"
            if not allowed:
                raise Refused("out_of_range", f"{field} is {value:g}: expected {expected}")

    def _reset(self, client: str) -> dict[str, Any]:
        self._check_alone(client)
        self._service.undisturbed_since_tick = self._service.between_ticks(scheduler.reset)
        return {}

    def _check_alone(self, client: str) -> None:
        for name, holder in self._service.leases.holders.items():
            if holder not in (None, client):
                raise Refused("held", f"contact {name!r} is held by client {holder!r}, who would feel it")
        if not self._service.leases.held_by(client):
            raise Refused("not_holder", f"client {client!r} holds no contact")

    def _load(self, client: str, request: dict[str, Any]) -> dict[str, Any]:
        """Check another model file, build it beside the running one, fade over to it, and let the old one go."""
        if not self._loading.acquire(blocking=False):
            raise Refused("busy", "another model is being loaded, or a contact acquired")
        try:
            self._check_alone(client)
            service = self._service
            model = self._read_model(_needed(request, "model"))
            following = shared_memory.make_model(model.discrete, service.memory.displacement.ravel().copy())
            step = model.period_s / FADE_OVER_S
            fading = service.memory._replace(next_model=following, fade=np.array([0.0, step]))
            memory = service.memory._replace(
                model=following,
                snapshot_version=np.zeros(1, np.int64),
                snapshot_tick=np.full(1, -1),
                snapshot_state=np.zeros(model.order),
            )
            self._handed_over = (fading, memory)
            service.undisturbed_since_tick = service.between_ticks(scheduler.exchange, make_image(fading))
            while fading.fade[0] < 1.0:
                if service.stopping.wait(model.period_s):
                    raise Refused("stopping", "the server is stopping")
            with service.model_in_use:
                self._end_exchange(memory)
                service.memory, service.model = memory, model
            log.info("now serving %s (order %d)", model.name, model.order)
            warnings = self._warnings(self._service.leases.held_by(client))
            return {"model": model.name, "order": model.order, "warnings": warnings}
        finally:
            self._loading.release()

    def _end_exchange(self, memory: shared_memory.Memory) -> None:
        """What has been begun is ended, however long ticks are in coming: or until the server stops."""
        while True:
            try:
                self._service.between_ticks(scheduler.exchange, make_image(memory))
                return
            except Refused as error:
                if error.reason != "busy":
                    raise

    def _read_model(self, name: object) -> ReducedModel:
        if not is_plain_name(name):
            raise Refused(
                "bad_model",
                f"model is {str(name)[:300]!r}: expected a file's name, without a folder and of at most "
                f"{LONGEST_NAME_BYTES} bytes",
            )
        path = self._models / name
        try:
            if path.is_symlink() and path.resolve().parent != self._models.resolve():
                raise Refused("bad_model", f"{name}: leads out of the folder of models")
            model = load_model(path)
        except (OSError, RuntimeError, ModelFileError) as error:  # RuntimeError: links in a circle
            raise Refused("bad_model", str(error).replace(f"{self._models}/", "")) from error
        names = [contact.name for contact in model.contacts]
        if names != self._service.names:
            raise Refused(
                "bad_model",
                f"{name}: its contacts are {names}, the running model's are {self._service.names}",
            )
        if model.period_s != self._service.model.period_s:
            raise Refused(
                "bad_model",
                f"{name}: its period is {model.period_s} s, the running model's {self._service.model.period_s} s",
            )
        return model

    def _record(self, request: dict[str, Any]) -> dict[str, Any]:
        """Start or end a recording, whoever asks; it belongs to no client."""
        if self._recordings is None:
            raise Refused("no_recordings", "the server was started without a folder for recordings")
        file = _needed(request, "file")
        if not self._recording.acquire(blocking=False):
            raise Refused("busy", "a recording is being started or ended")
        try:
            if file is None:
                return self._end_recording()
            path = file_in(self._recordings, file)
            if self._service.state != "running":
                raise Refused("stopping", "the server is stopping")
            if self._service.recorder is not None and self._service.recorder.error is None:
                raise Refused("busy", f"{self._service.recorder.file} is being recorded")
            self._service.recorder = Recorder(
                path, self._service.keys, self._service.describe(), self._service.memory
            )
            return {"file": path.name}
        finally:
            self._recording.release()

    def _end_recording(self) -> dict[str, Any]:
        recorder = self._service.recorder
        if recorder is None:
            raise Refused("not_recording", "there is no recording to end")
        self._publish_status()  # what is recorded can be repeated as far as a status tells of it
        self._service.recorder = None
        recorder.stop()
        return recorder.report()

    def _release(self, client: str) -> tuple[str, ...]:
        released = self._service.leases.release(client)
        self._service.forget_commands(released)
        leases = self._service.leases
        for name in released:  # what was agreed is over; the loop keeps to it until another holder comes
            leases.terms[name] = replace(leases.terms[name], device=None)
        return released


def _device(request: dict[str, Any]) -> Device | None:
    name = request.get("device")
    round_trip_s = _optional_number(request, "round_trip_s")
    damping = _optional_number(request, "device_damping_n_s_per_m")
    if name is None:
        return None
    if not (isinstance(name, str) and name in PROFILES):
        raise Refused("unknown_device", f"device is {name!r}: there are {', '.join(PROFILES)}")
    return Device(PROFILES[name], round_trip_s, damping)


def _needed(request: dict[str, Any], field: str) -> Any:
    if field not in request:
        raise wire.MalformedMessage("missing_field", f"{field} is missing")
    return request[field]


def _number(request: dict[str, Any], field: str) -> float:
    value = request[field]
    if not isinstance(value, int | float) or isinstance(value, bool):
        raise wire.MalformedMessage("wrong_type", f"{field} is {value!r}: expected a number")
    if not abs(value) < math.inf:
        raise Refused("out_of_range", f"{field} is {value!r}: expected a finite number")
    return float(value)


def _optional_number(request: dict[str, Any], field: str) -> float | None:
    if request.get(field) is None:
        return None
    value = _number(request, field)
    if value < 0:
        raise Refused("out_of_range", f"{field} is {value:g}: expected at least 0")
    return value
