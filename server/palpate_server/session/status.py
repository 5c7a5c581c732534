"""The status message and the answer to `describe`, as plain maps."""

from __future__ import annotations

import time
from dataclasses import asdict
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate_client.wire import DROPPED, SCHEMA_VERSION, Flags, Kind
from palpate_server.coupling import models
from palpate_server.realtime import safety, scheduler, shared_memory
from palpate_server.realtime.records import RECORDS
from palpate_server.recording.snapshot import identity
from palpate_server.session.devices import PROFILES
from palpate_server.session.state import MessageCounters, SessionState
from palpate_server.session.tips import tip_message

STATUS_PERIOD_S = 0.1
ROLLING_TICKS = 100
_BIN_S = 1e-6
_TICK_COUNTERS = ("ticks", "ticks_on_arrival", "late_ticks", "caught_up_ticks", "skipped_ticks", "faults")
_DURATIONS = {
    "timer_lateness_s": shared_memory.TIMER_LATENESS,
    "tick_lateness_s": shared_memory.TICK_LATENESS,
    "compute_time_s": shared_memory.COMPUTE_TIME,
    "input_age_s": shared_memory.INPUT_AGE,
}


def percentiles(counts: NDArray[np.int64], longest_ns: int) -> dict[str, float | None]:
    """p50, p99, p99.9 and the maximum, in seconds, from a histogram with bins of a microsecond; None when empty.

    A percentile is its bin's upper edge; one in the last bin, which also holds all that is longer, is the maximum.
    """
    cumulative = np.cumsum(counts)
    total = int(cumulative[-1])
    if total == 0:
        return dict.fromkeys(("p50", "p99", "p99_9", "max"))
    longest_s = longest_ns * 1e-9

    def at(share: float) -> float:
        index = int(np.searchsorted(cumulative, share * total))
        return longest_s if index >= len(counts) - 1 else min((index + 1) * _BIN_S, longest_s)

    return {"p50": at(0.5), "p99": at(0.99), "p99_9": at(0.999), "max": longest_s}


def success_rate(memory: shared_memory.Memory, tool: int) -> float:
    """Share of the last ROLLING_TICKS ticks that had a new command for the tool in time."""
    head = int(scheduler.records_written(memory.shared))
    if head == 0:
        return 0.0
    ticks = np.arange(max(0, head - ROLLING_TICKS), head) % RECORDS
    flags = memory.ring.ports["flags"][ticks, tool]
    late = Flags.HELD | Flags.DECAYING | Flags.STALE
    return float(np.mean(flags & int(late) == 0))


def dropped(memory: shared_memory.Memory, messages: MessageCounters) -> dict[str, int]:
    """Accepted commands that no tick used, and forces that were not sent, as in palpate_client.wire.DROPPED.

    A command that still waits for its tick counts as superseded until the tick has used it.
    """
    superseded = int(memory.commands.accepted.sum() - memory.ports["fresh_ticks"].sum())
    return dict(zip(DROPPED, (max(0, superseded), messages.unsent_forces), strict=True))


def success_rate_since_start(memory: shared_memory.Memory, tool: int) -> float | None:
    """Of the ticks in which the tool had a command, the share with a new one; None if it never had one."""
    commanded, fresh = (int(memory.ports[name][tool]) for name in ("commanded_ticks", "fresh_ticks"))
    return fresh / commanded if commanded else None


def status(state: SessionState, number: int) -> dict[str, Any]:
    """The status message; `number` counts them."""
    memory, messages, model = state.memory, state.messages, state.model
    return {
        "kind": Kind.STATUS,
        "number": number,
        "state": "running" if state.running else "stopping",
        "server_time_ns": time.monotonic_ns(),
        "model": identity(model),
        **{name: int(memory.counters[name][0]) for name in _TICK_COUNTERS},
        "lost_clients": state.lost_clients,
        **{
            name: percentiles(memory.histograms[row].copy(), int(memory.longest_ns[row]))
            for name, row in _DURATIONS.items()
        },
        "accepted": messages.accepted,
        "refused": dict(messages.refused),
        "malformed": dict(messages.malformed),
        "dropped": dropped(memory, messages),
        "recording": None if state.recorder is None else state.recorder.report(),
        "tools": {name: _tool_status(state, name) for name in state.tools},
    }


def _tool_status(state: SessionState, name: str) -> dict[str, Any]:
    settings, index = state.leases.settings[name], state.tool_index[name]
    return {
        "holder": state.leases.holders[name],
        "success_rate": success_rate(state.memory, index),
        "success_rate_since_start": success_rate_since_start(state.memory, index),
        "limits": settings.limits._asdict(),
        "frame": asdict(settings.frame),
        "home_m": settings.home_m,
        **tip_message(state.tips.get(name), settings.frame.scale),
    }


def description(state: SessionState) -> dict[str, Any]:
    """The answer to `describe`, but for `model_files`."""
    summary = state.model.summary()
    summary["accuracy"].pop("hankel_singular_values", None)
    return {
        "kind": Kind.DESCRIBE,
        "schema_version": SCHEMA_VERSION,
        "session": state.keys.session,
        "period_s": state.model.period_s,
        "tools": [
            {
                "name": tool.name,
                "start_m": tool.start_m,
                "normal": tool.normal,
                "radius_m": tool.radius_m,
                "friction": tool.friction,
            }
            for tool in models.tools_of(state.model)
        ],
        "limits": state.limits._asdict(),
        "devices": {name: asdict(profile) for name, profile in PROFILES.items()},
        "hold_s": safety.HOLD_NS * 1e-9,
        "decay_s": safety.DECAY_NS * 1e-9,
        "soft_start_s": safety.SOFT_START_NS * 1e-9,
        "status_period_s": STATUS_PERIOD_S,
        "surface_period_s": state.surface_period_s,
        "flags": {flag.name: flag.value for flag in Flags},
        "model": summary | identity(state.model),
        "model_file": state.model_file,
    }
