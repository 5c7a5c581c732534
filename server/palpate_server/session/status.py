"""What the loop and the wire have been doing, as plain numbers: the status message."""

from __future__ import annotations

from collections import Counter
from dataclasses import asdict
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.model_file import ReducedModel
from palpate_server.realtime import scheduler, shared_memory
from palpate_server.realtime.safety import Flags
from palpate_server.session.leases import Leases
from palpate_server.wire import DROPPED, MALFORMED, REFUSED

ROLLING_TICKS = 100
_BIN_S = 1e-6


class MessageCounters:
    """How many commands were accepted, refused and malformed, by reason; each written by the receiving thread.

    accepted_of counts by contact: a command can move several.
    """

    def __init__(self, n_contacts: int) -> None:
        self.accepted = 0
        self.accepted_of = [0] * n_contacts
        self.refused: Counter[str] = Counter(dict.fromkeys(REFUSED, 0))
        self.malformed: Counter[str] = Counter(dict.fromkeys(MALFORMED, 0))
        self.unsent_forces = 0


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


def recent_success_rate(memory: shared_memory.Memory, contact: int) -> float:
    """Share of the last 100 ticks in which a new command of the contact's client had come in time."""
    head = int(scheduler.records_written(memory.shared))
    if head == 0:
        return 0.0
    ticks = np.arange(max(0, head - ROLLING_TICKS), head) % shared_memory.RECORDS
    flags = memory.record_inputs[ticks, contact, shared_memory.CONTACT_FLAGS]
    late = Flags.HELD | Flags.DECAYING | Flags.STALE
    return float(np.mean(flags & int(late) == 0))


def dropped(memory: shared_memory.Memory, messages: MessageCounters) -> dict[str, int]:
    """What was accepted or made and then not used, by reason, as in wire.DROPPED.

    A command that waits for the tick at this moment is not yet used and counts as superseded until it is.
    """
    used = memory.tallies[:, shared_memory.FRESH_TICKS].tolist()
    superseded = sum(messages.accepted_of) - sum(used)
    return dict(zip(DROPPED, (max(0, superseded), messages.unsent_forces), strict=True))


def success_rate(memory: shared_memory.Memory, contact: int) -> float | None:
    """Share of the ticks since the start in which a new command had come in time, of those with a client; None without."""
    commanded, fresh = memory.tallies[contact].tolist()
    return fresh / commanded if commanded else None


def status(
    number: int,
    state: str,
    server_time_ns: int,
    model: ReducedModel,
    memory: shared_memory.Memory,
    messages: MessageCounters,
    leases: Leases,
    undisturbed_since_tick: int,
    lost_clients: int,
    recording: dict[str, Any] | None,
) -> dict[str, Any]:
    """The status message, the so many-th; `state` is "running" or "stopping", `recording` what its recorder reports."""
    ticks = memory.counters.tolist()
    durations = {
        "timer_lateness_s": shared_memory.TIMER_LATENESS,
        "tick_lateness_s": shared_memory.TICK_LATENESS,
        "compute_time_s": shared_memory.COMPUTE_TIME,
        "input_age_s": shared_memory.INPUT_AGE,
    }
    return {
        "number": number,
        "state": state,
        "server_time_ns": server_time_ns,
        "model": {"name": model.name, "order": model.order, "config_sha256": model.config_sha256},
        "undisturbed_since_tick": undisturbed_since_tick,
        "at_rest_since_tick": ticks[shared_memory.AT_REST_SINCE],
        "ticks": ticks[shared_memory.TICKS],
        "ticks_on_arrival": ticks[shared_memory.TICKS_ON_ARRIVAL],
        "late_ticks": ticks[shared_memory.LATE_TICKS],
        "caught_up_ticks": ticks[shared_memory.CAUGHT_UP_TICKS],
        "skipped_ticks": ticks[shared_memory.SKIPPED_TICKS],
        "faults": ticks[shared_memory.FAULTS],
        "lost_clients": lost_clients,
        **{
            name: percentiles(memory.histograms[row].copy(), int(memory.longest_ns[row]))
            for name, row in durations.items()
        },
        "accepted": messages.accepted,
        "refused": dict(messages.refused),
        "malformed": dict(messages.malformed),
        "dropped": dropped(memory, messages),
        "recording": recording,
        "contacts": {
            name: {
                "holder": holder,
                "success_rate": recent_success_rate(memory, index),
                "success_rate_since_start": success_rate(memory, index),
                "limits": leases.terms[name].limits._asdict(),
                "frame": asdict(leases.terms[name].frame),
                "since_tick": leases.terms[name].since_tick,
                "held_since_tick": leases.terms[name].held_since_tick,
            }
            for index, (name, holder) in enumerate(leases.holders.items())
        },
    }
