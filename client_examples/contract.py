"""What a client may rely on, checked message by message, with the round-trip times that fall out of it."""

import array
import math

SLACK = 1e-9  # of a newton: rounding
REMEMBERED = 10_000  # commands: an answer to an older one would break the contract anyway
# A busy machine or network may hold commands up until the force has faded, which the flags tell and nobody has promised to
# prevent. A link on which nothing moves for as long as this is closed, so that then it is not the link.
UNHEARD_NS = 1_000_000_000


class Contract:
    """Feed it every command sent and every force received, for one contact; it keeps what broke the contract."""

    def __init__(self, description, contact):
        """`description` is the answer to `describe`, `contact` the name of ours."""
        names = [c["name"] for c in description["contacts"]]
        self.index = names.index(contact)
        self.flags = description["flags"]
        self.max_force_n = description["limits"]["max_force_n"]
        self.max_step_n = description["limits"]["max_force_rate_n_per_s"] * description["period_s"]
        self.hold_ns = (description["hold_s"] + description["period_s"]) * 1e9
        self.fade_ns = (description["hold_s"] + description["decay_s"]) * 1e9
        self.holding = False  # the contact, as far as we know
        self.sent = {}  # sequence -> client_time_ns, the newest REMEMBERED ones
        self.commands = 0
        self.answered = 0
        self.newest_answered = -1
        self.round_trips_ns = array.array("q")  # an hour of them is 29 MB
        self.forces = 0
        self.lost_ticks = 0
        self.flag_counts = dict.fromkeys(self.flags, 0)
        self.largest_force_n = 0.0
        self.broken = []  # the first times
        self._breaks = 0
        self._last = None
        self._newest_sent_ns = 0
        self._sending_since_ns = 0  # without a pause in which our force would fade
        self._unheard = False

    def agree(self, terms):
        """The answer to `acquire`: from now on we hold the contact, within these limits."""
        self.max_force_n = terms["limits"]["max_force_n"]
        self.newest_answered = -1
        self.holding = True

    def release(self):
        """Call it before the contact is given back, or acquired again: our commands are then forgotten rightly."""
        self.holding = False

    def on_sent(self, command):
        now_ns = command["client_time_ns"]
        if now_ns - self._newest_sent_ns > self.fade_ns:
            self._sending_since_ns = now_ns
        self._newest_sent_ns = now_ns
        self.sent[command["sequence"]] = now_ns
        self.commands += 1
        self.sent.pop(command["sequence"] - REMEMBERED, None)

    def on_force(self, message, arrival_ns):
        """Whether nothing about it breaks the contract: only then, and while we hold the contact, may it be rendered."""
        breaks = self._breaks
        self._check(message, arrival_ns)
        return self._breaks == breaks

    def _check(self, message, arrival_ns):
        i = self.index
        tick, sequence, flags = message["tick"], message["sequence"][i], message["flags"][i]
        force = message["force_n"][i]
        self.forces += 1
        for name, bit in self.flags.items():
            if flags & bit:
                self.flag_counts[name] += 1

        if not all(math.isfinite(f) for f in force):
            self._break(tick, f"the force {force} is not finite")
            return
        magnitude = math.hypot(*force)
        self.largest_force_n = max(self.largest_force_n, magnitude)
        if magnitude > self.max_force_n + SLACK:
            self._break(tick, f"the force is {magnitude} N, the limit {self.max_force_n} N")
        if flags & self.flags["STALE"] and magnitude > 0:
            self._break(tick, f"the input is stale and the force still {magnitude} N")
        silent = flags & (self.flags["DECAYING"] | self.flags["STALE"])
        if not silent and message["input_age_ns"][i] > self.hold_ns:
            self._break(tick, f"the input is {message['input_age_ns'][i] / 1e6} ms old and no flag says so")

        if self.holding and sequence < 0 <= self.newest_answered:
            # The server keeps a holder's last command, however silent the holder is.
            self._lose(
                tick,
                "we no longer hold the contact, our commands are forgotten: it was released or taken back "
                "(after a second of silence, for instance), or the server has stopped or was started again",
            )
            return

        if self._last is not None:
            last_tick, last_sequence, last_force = self._last
            if tick <= last_tick:
                self._break(tick, f"it came after tick {last_tick}")
                return
            self.lost_ticks += tick - last_tick - 1
            if tick == last_tick + 1 and math.dist(force, last_force) > self.max_step_n + SLACK:
                self._break(tick, f"the force jumped by {math.dist(force, last_force)} N in one tick")
            if self.holding and 0 <= sequence < last_sequence:
                self._break(tick, f"it answers command {sequence}, the tick before answered {last_sequence}")
        self._last = tick, sequence, force

        if self.sent.get(sequence) == message["client_time_ns"][i]:
            if sequence > self.newest_answered:
                self.newest_answered = sequence
                self.answered += 1
                self.round_trips_ns.append(arrival_ns - self.sent[sequence])
            if self.holding:
                self._check_heard(tick, sequence, message["input_age_ns"][i], flags & self.flags["STALE"])
        elif self.holding and sequence >= 0:  # while we don't hold the contact, others' are answered
            self._lose(
                tick,
                f"we no longer hold the contact: it answers command {sequence}, which was not sent "
                "(or not at that time)",
            )

    def measure_anew(self):
        """Round trips that were measured until now do not count."""
        self.round_trips_ns = array.array("q")

    def _check_heard(self, tick, sequence, age_ns, stale):
        """That the force has faded is our own doing when we were silent, but not while we went on sending.

        All times are on our clock: the tick began `age_ns` or more after its command was sent. When the message comes
        says nothing: it may have waited while we were paused.
        """
        sent_ns = self.sent[sequence]
        end_ns = min(sent_ns + age_ns, self._newest_sent_ns)
        unheard_ns = end_ns - max(sent_ns, self._sending_since_ns)
        unheard = bool(stale) and unheard_ns > UNHEARD_NS
        if unheard and not self._unheard:
            self._break(
                tick,
                f"the force has faded although we went on sending: for {unheard_ns / 1e9:.3g} s no command of ours "
                "has arrived, or they are refused",
            )
        self._unheard = unheard

    def _lose(self, tick, what):
        self.holding = False
        self._last = None  # another server counts its own ticks, another client its own commands
        self._break(tick, what)

    def _break(self, tick, what):
        self._breaks += 1
        if len(self.broken) < 20:  # one cause can break every tick; the first ones tell
            self.broken.append(f"tick {tick}: {what}")

    def summary(self):
        ordered = sorted(self.round_trips_ns)

        def at(share):
            return ordered[min(len(ordered) - 1, int(share * len(ordered)))] * 1e-9 if ordered else None

        return {
            "commands_sent": self.commands,
            "commands_answered": self.answered,
            "commands_unanswered": self.commands - self.answered,
            "forces_received": self.forces,
            "forces_lost": self.lost_ticks,
            "round_trip_s": {"p50": at(0.5), "p99": at(0.99), "p99_9": at(0.999), "max": at(1.0)},
            "largest_force_n": self.largest_force_n,
            "flags": {name: count for name, count in self.flag_counts.items() if count},
            "contract_broken": self.broken,
        }
