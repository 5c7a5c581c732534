"""Admission of commands: decode, check, refuse with a reason or hand over to the loop. Nothing else does any of this."""

from __future__ import annotations

from palpate_client.wire import (
    MAX_COMMAND_BYTES,
    MAX_POSITION_M,
    MAX_VELOCITY_M_PER_S,
    MalformedMessage,
    check_size,
    last_chunk,
)
from palpate_server import wire
from palpate_server.realtime import scheduler
from palpate_server.session.state import SessionState


class Admission:
    """Takes the commands of all clients; one thread at a time may call it."""

    def __init__(self, state: SessionState) -> None:
        self._state = state
        # Of each tool, the number of the lease that its newest command came under, and its sequence.
        self._last_sequence = [(0, -1)] * len(state.tools)

    def admit(self, key: str, payload: wire.Payload, arrival_ns: int) -> int:
        """Carry out a command as a whole, or count why not; the number of ticks that ran with it.

        key: palpate/SESSION/command/CLIENT. arrival_ns: when it came, on the monotonic clock
        """
        state, messages = self._state, self._state.messages
        try:
            check_size(len(payload), MAX_COMMAND_BYTES)
            content = payload.to_bytes()
            if (recorder := state.recorder) is not None:
                recorder.command(key, content)
            command = wire.decode_command(content)
        except MalformedMessage as error:
            messages.malformed[error.reason] += 1
            return 0
        # Read before it is known who holds the tools: should one change hands meanwhile, the number tells.
        lease = state.memory.commands.lease.tolist()
        if reason := self.why_refused(command, last_chunk(key), lease):
            messages.refused[reason] += 1
            return 0
        messages.accepted += 1
        return self._hand_over(command, lease, arrival_ns)

    def why_refused(self, command: wire.Command, client: str, lease: list[int]) -> str | None:
        """One of wire.REFUSED, or None when the command is to be carried out. Refused as a whole or not at all."""
        state = self._state
        if not state.running:
            return "stopping"
        for name in command.position_m:
            tool = state.tool_index.get(name)
            if tool is None:
                return "unknown_tool"
            if state.leases.holders[name] != client:
                return "not_holder"
            last_lease, last_sequence = self._last_sequence[tool]
            if last_lease == lease[tool] and command.sequence <= last_sequence:
                return "old_sequence"
        return out_of_range(command)

    def _hand_over(self, command: wire.Command, lease: list[int], arrival_ns: int) -> int:
        state, commands = self._state, self._state.memory.commands
        *_, last = command.position_m
        for name, position in command.position_m.items():
            tool = state.tool_index[name]
            self._last_sequence[tool] = (lease[tool], command.sequence)
            state.messages.accepted_of[tool] += 1
            hand_over = scheduler.write_command if name is last else scheduler.stage_command
            hand_over(
                commands,
                tool,
                command.sequence,
                command.client_time_ns,
                arrival_ns,
                command.rendered_tick,
                lease[tool],
                position,
                command.velocity_m_per_s[name],
            )
        ticks: int = scheduler.tick_on_arrival(state.image, arrival_ns)
        return ticks


def out_of_range(command: wire.Command) -> str | None:
    for vectors, most in (
        (command.position_m, MAX_POSITION_M),
        (command.velocity_m_per_s, MAX_VELOCITY_M_PER_S),
    ):
        for x, y, z in vectors.values():
            if x - x + y - y + z - z != 0.0:  # infinity minus itself is not a number either
                return "not_finite"
            if not (abs(x) <= most and abs(y) <= most and abs(z) <= most):
                return "out_of_range"
    return None
