"""Carries out control requests, or refuses them with a reason: acquire, release, limits, reset, load, record."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from palpate_client.messages import Vector
from palpate_server.coupling import models
from palpate_server.coupling.running import Tip
from palpate_server.errors import Refused
from palpate_server.realtime import safety, scheduler
from palpate_server.realtime.safety import Limits
from palpate_server.session import fields
from palpate_server.session.devices import Device, limits_for
from palpate_server.session.leases import ToolSettings
from palpate_server.session.loading import ModelLoader, warnings_of
from palpate_server.session.recordings import Recordings
from palpate_server.session.state import SessionState
from palpate_server.session.tips import tip_for, tip_message

log = logging.getLogger("palpate_server")

LEAST_SPEED_M_PER_S = 0.01
MOST_DAMPING_N_S_PER_M = 100.0  # of passivity control, when no device profile states its own


class Requests:
    """Carries out the actions of palpate_client.wire.ACTIONS.

    One thread calls `on_client` and `carry_out`; only it changes leases. SLOW_ACTIONS run on threads of their own and change none.

    has_token       asks Zenoh whether a client's liveliness token exists
    publish_status  sends a status now
    models          the folder that clients may load from
    recordings      the folder for recordings, of at most max_recordings_bytes; or None
    """

    def __init__(
        self,
        state: SessionState,
        has_token: Callable[[str], bool],
        publish_status: Callable[[], None],
        models: Path,
        recordings: Path | None,
        max_recordings_bytes: int,
    ) -> None:
        self._state = state
        self._has_token = has_token
        self._loader = ModelLoader(state, models)
        self.recordings = Recordings(state, publish_status, recordings, max_recordings_bytes)
        self._alive: set[str] = set()  # clients whose liveliness token is known

    def on_client(self, client: str, alive: bool) -> None:
        """A client's liveliness token was declared or deleted; when deleted, its tools are released."""
        if alive:
            self._alive.add(client)
            return
        self._alive.discard(client)
        released = self._release(client)
        self._state.lost_clients += bool(released)
        for name in released:
            log.info("client %s is gone: tool %s is free", client, name)

    def carry_out(self, client: str, action: str, request: dict[str, Any]) -> dict[str, Any]:
        """The answer to a client's request. Raises Refused, or MalformedMessage for a request that breaks the schema."""
        match action:
            case "acquire":
                return self._acquire(client, request)
            case "release":
                return {"tools": list(self._release(client))}
            case "limits":
                return self._set_limits(client, request)
            case "reset":
                return self._reset(client)
            case "load":
                file, factor = fields.required(request, "file"), fields.stiffness_factor_in(request)
                return self._loader.load(client, file, factor)
            case "record":
                return self.recordings.record(client, fields.required(request, "file"))
        raise ValueError(f"{action!r} is none of wire.ACTIONS")

    def _acquire(self, client: str, request: dict[str, Any]) -> dict[str, Any]:
        tools = fields.tools_in(request)
        frame = fields.frame_in(request)
        device = fields.device_in(request)
        wanted = fields.tip_in(request)
        state, leases = self._state, self._state.leases
        state.check_running()
        self._check_alive(client)
        leases.check(client, tools)
        limits = state.limits if device is None else limits_for(device.profile, state.limits)
        if not state.exchanging.acquire(blocking=False):
            raise Refused("busy", "another model is being loaded")
        try:
            tips = {
                name: tip_for(state.model, state.tool_index[name], wanted, device, frame.scale)
                for name in tools
            }
            self._silence(tools)
            for name, tip in tips.items():
                home = frame.point_at_client(self._start_m(name, tip))
                self._set_up(name, ToolSettings(limits, frame, home, device, wanted), tip)
            leases.holders |= dict.fromkeys(tools, client)
        finally:
            state.exchanging.release()
        return {
            "tools": {
                name: {
                    "limits": limits._asdict(),
                    "home_m": leases.settings[name].home_m,
                    **tip_message(tips[name], frame.scale),
                }
                for name in tools
            },
            "frame": asdict(frame),
            "warnings": warnings_of(state, tools),
        }

    def _start_m(self, name: str, tip: Tip | None) -> Vector:
        if tip is not None:
            return tip.start_m
        return models.tools_of(self._state.model)[self._state.tool_index[name]].start_m

    def _check_alive(self, client: str) -> None:
        # The token may be so new that on_client was not called yet.
        if client not in self._alive and not self._has_token(client):
            token = self._state.keys.client(client)
            raise Refused("not_alive", f"client {client!r} has no liveliness token at {token}")

    def _silence(self, tools: list[str]) -> None:
        """Wait until the forces of the tools have faded to zero. Nobody holds them meanwhile, so no command is used.

        Raises Refused if a force does not fade in time; then the tools have the same holders as before.
        """
        state = self._state
        before = {name: state.leases.holders[name] for name in tools}
        state.leases.holders |= dict.fromkeys(tools)
        state.forget_commands(tools)
        indices = [state.tool_index[name] for name in tools]
        give_up = time.monotonic() + 10 * safety.DECAY_NS * 1e-9
        while not all(scheduler.is_silent(state.image, tool) for tool in indices):
            if time.monotonic() > give_up:
                state.leases.holders |= before
                raise Refused("busy", "the force did not fade in time: the server is overloaded")
            time.sleep(state.model.period_s)

    def _set_up(self, name: str, wanted: ToolSettings, tip: Tip | None) -> None:
        """Put a silent tool to rest with these settings and this tip."""
        state = self._state
        tool, frame = state.tool_index[name], wanted.frame
        settings = (
            state.leases.settings
        )  # updated after each change, so that they are right even if the next change fails
        home = np.array(wanted.home_m)
        state.between_ticks(scheduler.set_frame, tool, np.array(frame.rotation), frame.scale, home)
        settings[name] = replace(wanted, limits=settings[name].limits)
        # The tip is at rest, so limits and tip may change a tick later than the frame.
        state.between_ticks(scheduler.set_limits, tool, np.array(wanted.limits))
        settings[name] = wanted
        if tip is not None:
            state.between_ticks(scheduler.set_tip, tool, np.array(tip[:3]), np.array(tip.start_m))
            state.tips[name] = tip

    def _set_limits(self, client: str, request: dict[str, Any]) -> dict[str, Any]:
        state, settings = self._state, self._state.leases.settings
        wanted = fields.limits_in(request, Limits._fields)
        state.leases.check_holder(client)
        held = state.leases.held_by(client)
        for name in held:  # checked for all tools before any is changed
            self._check_limits(wanted, settings[name].device)
        for name in held:
            limits = settings[name].limits._replace(**wanted)
            state.between_ticks(scheduler.set_limits, state.tool_index[name], np.array(limits))
            settings[name] = replace(settings[name], limits=limits)
        return {"tools": {name: {"limits": settings[name].limits._asdict()} for name in held}}

    def _check_limits(self, wanted: dict[str, float], device: Device | None) -> None:
        """Raises Refused for a limit that is beyond the server's or the device's."""
        ceiling = self._state.limits._replace(max_damping_n_s_per_m=MOST_DAMPING_N_S_PER_M)
        if device is not None:
            ceiling = limits_for(device.profile, ceiling)
        # From the server's largest force, because the present force may exceed the client's new limit.
        least_rate = safety.least_force_rate(self._state.limits.max_force_n)
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
        self._state.check_alone(client)
        self._state.between_ticks(scheduler.reset)
        return {}

    def _release(self, client: str) -> tuple[str, ...]:
        leases = self._state.leases
        released = leases.release(client)
        self._state.forget_commands(released)
        for name in released:  # limits, frame and tip stay in use until the next acquire
            leases.settings[name] = replace(leases.settings[name], device=None, wanted=fields.AS_IT_IS)
        return released
