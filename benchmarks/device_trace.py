"""What n ticks of a device and m of a server had to do with each other: made up, or measured on a served model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from palpate_server.diagnostics.round_trips import (
    RATE_HZ,
    SETTLE_S,
    ReceivedForce,
    RoundTrips,
    answered,
    driven,
)


@dataclass(frozen=True)
class Trace:
    """What n ticks of a device and m of the server had to do with each other, in order; ns on one monotonic clock.

    device_ns (n,): when the device's tick k reads its position, sends it as command k and takes up the newest force it has;
    rendered (n,): of which tick of the server that force is, -1 while there is none
    server_ns (m,): when the server's tick began; arrival_ns (m,): when the command that it used had come; used (m,): which
    one that was, negative while there is none. A tick without a new command used the one before again.
    """

    device_ns: NDArray[np.int64]
    rendered: NDArray[np.int64]
    server_ns: NDArray[np.int64]
    arrival_ns: NDArray[np.int64]
    used: NDArray[np.int64]

    def answered(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """The device's ticks at which it had a force, and the commands that these forces answer."""
        command = np.where(self.rendered >= 0, self.used[self.rendered], -1)
        return np.flatnonzero(command >= 0), command[command >= 0]

    def ages_ns(self) -> NDArray[np.int64]:
        """At each of these ticks, how long ago the device had read the position that its force answers."""
        ticks, commands = self.answered()
        return self.device_ns[ticks] - self.device_ns[commands]

    def piece(self, start: int, ticks: int) -> Trace:
        """The device's ticks from `start` on as a trace of its own; commands before it count as none."""
        stop = start + ticks
        if not 0 <= start < stop <= len(self.device_ns):
            raise ValueError(f"a trace of {len(self.device_ns)} ticks has no ticks from {start} to {stop}")
        first = max(int(self.rendered[start]), 0)
        last = max(int(self.rendered[stop - 1]) + 1, first)
        return Trace(
            device_ns=self.device_ns[start:stop],
            rendered=np.maximum(self.rendered[start:stop] - first, -1),
            server_ns=self.server_ns[first:last],
            arrival_ns=self.arrival_ns[first:last],
            used=np.maximum(self.used[first:last] - start, -1),
        )


def steady_trace(ticks: int, late: int) -> Trace:
    """Nothing is lost or early: at each tick the device has the force for its position `late` >= 1 ticks before."""
    device_ns = np.arange(ticks) * (1_000_000_000 // RATE_HZ)
    return Trace(device_ns, np.maximum(np.arange(ticks) - late, -1), device_ns, device_ns, np.arange(ticks))


def trace_of(sent_ns: Sequence[int], heard: Sequence[ReceivedForce]) -> Trace:
    """Of commands 1, 2, ... sent at these times, each at a tick of a device, and the forces that came, in order of ticks.

    What a tick did whose force was lost is not known: it is taken to have used the command of the tick before again.
    """
    device_ns = np.array(sent_ns, np.int64)
    arrival, tick, server_ns, sequence, age = np.array(heard, np.int64).reshape(-1, 5).T
    if not len(tick):
        raise ValueError("no force was heard")
    # The newest at each of the server's ticks, also of those that were not heard.
    at = np.searchsorted(tick, np.arange(tick[0], tick[-1] + 1), side="right") - 1
    newest = np.searchsorted(arrival, device_ns, side="right") - 1
    return Trace(
        device_ns=device_ns,
        rendered=np.where(newest >= 0, tick[newest] - tick[0], -1),
        server_ns=server_ns[at],
        arrival_ns=(server_ns - age)[at],
        used=np.where(sequence > 0, sequence - 1, -1)[at],
    )


def trace_through_a_model(path: Path, tool: str, seconds: float) -> tuple[RoundTrips, Trace]:
    """The round trips with a server of its own for the model in `path`, and all that a device would have lived through."""
    sent, forces, _ = driven(path, [tool], seconds, viewer=False)
    settled = int(SETTLE_S * RATE_HZ)
    return answered(sent, forces), trace_of(sent, forces).piece(settled, len(sent) - settled)
