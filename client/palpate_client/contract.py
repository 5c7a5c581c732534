"""Checks every force against what the server promises, and measures round-trip times."""

from __future__ import annotations

import math
from array import array
from collections import Counter
from typing import Any

from palpate_client.messages import Description, Force
from palpate_client.wire import LEASE_MS, Flags

ROUNDING_N = 1e-9
REMEMBERED = 10_000  # commands; an answer to an older one breaks the contract
# A busy machine or network may delay commands until the force has faded. The flags say so, and the contract allows it. Zenoh
# closes a link that is silent for this long. So if forces stay faded for longer although we send, something else is wrong.
LONGEST_OUTAGE_NS = LEASE_MS * 1_000_000
# Plain numbers: an operation on `Flags` takes a microsecond, and a force comes each millisecond.
_STALE = int(Flags.STALE)
_FADING = int(Flags.DECAYING | Flags.STALE)
MAX_BREAKS_LISTED = 20  # one cause can break the contract in every tick


class Contract:
    """Checks the forces of one tool against the server's promises and against the commands that were sent.

    holding  whether we hold the tool, as far as we know
    broken   how the contract was broken, the first MAX_BREAKS_LISTED times
    """

    def __init__(self, description: Description) -> None:
        self.holding = False
        self.broken: list[str] = []
        self.forces_received = 0
        self.forces_lost = 0
        self.commands_sent = 0
        self.commands_answered = 0
        self.largest_force_n = 0.0
        self._max_force_n = description.max_force_n
        self._max_step_n = description.max_force_rate_n_per_s * description.period_s
        self._hold_ns = (description.hold_s + description.period_s) * 1e9
        self._fade_ns = (description.hold_s + description.decay_s) * 1e9
        self._sent: dict[int, int] = {}  # sequence -> client_time_ns, the newest REMEMBERED ones
        self._newest_sent = self._newest_answered = -1
        self._first_of_hold = 0  # the first command since the tool was acquired
        self._hold_is_answered = False  # whether one of those has been answered
        self._round_trips_ns = array("q")  # an hour at 1 kHz is 29 MB
        self._flag_words: Counter[int] = Counter()  # how often each combination of flags came
        self._breaks = 0
        self._last: Force | None = None
        self._newest_sent_ns = 0
        self._sending_since_ns = 0  # without a pause in which our force would fade
        self._in_outage = False

    def acquired(self, max_force_n: float) -> None:
        """Call it when `acquire` was granted, with the limit of the force."""
        self._max_force_n = max_force_n
        # Forces from before may still come, after the answer to `acquire`: they tell nothing about this hold.
        self._first_of_hold = self._newest_sent + 1
        self._hold_is_answered = False
        self.holding = True

    def released(self) -> None:
        """Call it before the tool is released or acquired again: after that the server may forget our commands."""
        self.holding = False

    def on_sending(self, sequence: int, client_time_ns: int) -> None:
        """Call it right before a command is sent: the answer may come before `put` returns."""
        if client_time_ns - self._newest_sent_ns > self._fade_ns:
            self._sending_since_ns = client_time_ns
        self._newest_sent_ns = client_time_ns
        self._newest_sent = sequence
        self._sent[sequence] = client_time_ns
        self.commands_sent += 1
        self._sent.pop(sequence - REMEMBERED, None)

    def on_force(self, force: Force) -> bool:
        """Check a force. True if it keeps the contract: it may be rendered only then, and only while `holding`."""
        breaks = self._breaks
        self.forces_received += 1
        self._flag_words[force.flags] += 1
        if self._check_value(force) and self._check_order(force):
            self._check_answer(force)
        return self._breaks == breaks

    def measure_anew(self) -> None:
        """Forget the round trips that were measured so far."""
        self._round_trips_ns = array("q")

    def round_trip_s(self, share: float) -> float | None:
        """The percentile of the round trips for a share of 0 to 1, s; None if there is none."""
        ordered = sorted(self._round_trips_ns)
        return ordered[min(len(ordered) - 1, int(share * len(ordered)))] * 1e-9 if ordered else None

    def summary(self) -> dict[str, Any]:
        """All counts, percentiles of the round trip (s), flags (ticks) and breaks, as `palpate client --json` prints them."""
        words = dict(self._flag_words)  # forces may go on coming, on another thread
        flags = {flag.name: sum(n for word, n in words.items() if word & flag) for flag in Flags}
        shares = {"p50": 0.5, "p99": 0.99, "p99_9": 0.999, "max": 1.0}
        return {
            "commands_sent": self.commands_sent,
            "commands_answered": self.commands_answered,
            "commands_unanswered": self.commands_sent - self.commands_answered,
            "forces_received": self.forces_received,
            "forces_lost": self.forces_lost,
            "round_trip_s": {name: self.round_trip_s(share) for name, share in shares.items()},
            "largest_force_n": self.largest_force_n,
            "flags": {name: count for name, count in flags.items() if count},
            "contract_broken": self.broken,
        }

    def _check_value(self, force: Force) -> bool:
        """Check force, limits and age. False if the order and the answer of this force can't be checked."""
        if not all(math.isfinite(f) for f in force.force_n):
            self._break(force, f"the force {list(force.force_n)} is not finite")
            return False
        magnitude = math.hypot(*force.force_n)
        self.largest_force_n = max(self.largest_force_n, magnitude)
        if magnitude > self._max_force_n + ROUNDING_N:
            self._break(force, f"the force is {magnitude} N, the limit {self._max_force_n} N")
        if force.flags & _STALE and magnitude > 0:
            self._break(force, f"the input is stale and the force still {magnitude} N")
        if not force.flags & _FADING and force.input_age_ns > self._hold_ns:
            self._break(force, f"the input is {force.input_age_ns / 1e6} ms old and no flag says so")
        if self.holding and force.sequence < 0 and self._hold_is_answered:
            # The server keeps a holder's last command, however silent the holder is.
            self._lose(
                force,
                "we no longer hold the tool, our commands are forgotten: it was released or taken back "
                "(after a long silence, for instance), or the server has stopped or was started again",
            )
            return False
        return True

    def _check_order(self, force: Force) -> bool:
        """Check the order of ticks and answers, and the change of the force. False for a force that came too late."""
        last = self._last
        if last is not None:
            if force.tick <= last.tick:
                self._break(force, f"it came after tick {last.tick}")
                return False
            self.forces_lost += force.tick - last.tick - 1
            step = math.dist(force.force_n, last.force_n)
            if force.tick == last.tick + 1 and step > self._max_step_n + ROUNDING_N:
                self._break(force, f"the force jumped by {step} N in one tick")
            if self.holding and 0 <= force.sequence < last.sequence:
                self._break(
                    force, f"it answers command {force.sequence}, the tick before answered {last.sequence}"
                )
        self._last = force
        return True

    def _check_answer(self, force: Force) -> None:
        sent_ns = self._sent.get(force.sequence)
        if sent_ns is not None and sent_ns == force.client_time_ns:
            self._hold_is_answered |= force.sequence >= self._first_of_hold
            if force.sequence > self._newest_answered:
                self._newest_answered = force.sequence
                self.commands_answered += 1
                self._round_trips_ns.append(force.arrival_ns - sent_ns)
            if self.holding:
                self._check_outage(force, sent_ns)
        elif (
            self.holding and force.sequence >= 0
        ):  # while we do not hold the tool, the answers are to other clients
            self._lose(
                force,
                f"we no longer hold the tool: it answers command {force.sequence}, which was not sent "
                "(or not at that time)",
            )

    def _check_outage(self, force: Force, sent_ns: int) -> None:
        """Check that the force has not stayed faded for LONGEST_OUTAGE_NS while we sent commands.

        All times are on our clock. The tick began at least `input_age_ns` after its command was sent. The message's time of
        arrival is not used: it may have waited while this process was paused.
        """
        end_ns = min(sent_ns + force.input_age_ns, self._newest_sent_ns)
        outage_ns = end_ns - max(sent_ns, self._sending_since_ns)
        in_outage = bool(force.flags & _STALE) and outage_ns > LONGEST_OUTAGE_NS
        if in_outage and not self._in_outage:
            self._break(
                force,
                f"the force has faded although we went on sending: for {outage_ns / 1e9:.3g} s no command of ours "
                "has arrived, or they are refused",
            )
        self._in_outage = in_outage

    def _lose(self, force: Force, what: str) -> None:
        self.holding = False
        self._last = None  # another server counts its own ticks, another client its own commands
        self._break(force, what)

    def _break(self, force: Force, what: str) -> None:
        self._breaks += 1
        if len(self.broken) < MAX_BREAKS_LISTED:
            self.broken.append(f"tick {force.tick}: {what}")
