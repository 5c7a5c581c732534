"""What a client may rely on, checked message by message, with the round-trip times that fall out of it."""

import array
import math

SLACK = 1e-9  # of a newton: rounding
REMEMBERED = 10_000  # commands: an answer to an older one would break the contract anyway


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
        self.sent = {}  # sequence -> client_time_ns, the newest REMEMBERED ones
        self.commands = 0
        self.newest_answered = -1
        self.round_trips_ns = array.array("q")  # an hour of them is 29 MB
        self.forces = 0
        self.lost_ticks = 0
        self.flag_counts = dict.fromkeys(self.flags, 0)
        self.largest_force_n = 0.0
        self.broken = []
        self._last = None

    def agree(self, terms):
        """The answer to `acquire`: its limits are those that hold for us."""
        self.max_force_n = terms["limits"]["max_force_n"]

    def on_sent(self, command):
        self.sent[command["sequence"]] = command["client_time_ns"]
        self.commands += 1
        self.sent.pop(command["sequence"] - REMEMBERED, None)

    def on_force(self, message, arrival_ns):
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

        if self._last is not None:
            last_tick, last_sequence, last_force = self._last
            if tick <= last_tick:
                self._break(tick, f"it came after tick {last_tick}")
                return
            self.lost_ticks += tick - last_tick - 1
            if tick == last_tick + 1 and math.dist(force, last_force) > self.max_step_n + SLACK:
                self._break(tick, f"the force jumped by {math.dist(force, last_force)} N in one tick")
            if 0 <= sequence < last_sequence:
                self._break(tick, f"it answers command {sequence}, the tick before answered {last_sequence}")
        self._last = tick, sequence, force

        # An answer to one of our commands: before we hold the contact, others' (or nobody's, -1) are echoed.
        if sequence >= 0 and self.sent:
            if self.sent.get(sequence) != message["client_time_ns"][i]:
                self._break(tick, f"it answers command {sequence}, which was not sent (or not at that time)")
            elif sequence > self.newest_answered:
                self.newest_answered = sequence
                self.round_trips_ns.append(arrival_ns - self.sent[sequence])

    def _break(self, tick, what):
        if len(self.broken) < 20:  # one cause can break every tick; the first ones tell
            self.broken.append(f"tick {tick}: {what}")

    def summary(self):
        ordered = sorted(self.round_trips_ns)

        def at(share):
            return ordered[min(len(ordered) - 1, int(share * len(ordered)))] * 1e-9 if ordered else None

        return {
            "commands_sent": self.commands,
            "commands_answered": len(ordered),
            "commands_unanswered": self.commands - len(ordered),
            "forces_received": self.forces,
            "forces_lost": self.lost_ticks,
            "round_trip_s": {"p50": at(0.5), "p99": at(0.99), "p99_9": at(0.999), "max": at(1.0)},
            "largest_force_n": self.largest_force_n,
            "flags": {name: count for name, count in self.flag_counts.items() if count},
            "contract_broken": self.broken,
        }
