"""Admission of commands: decode, check, then hand over to the loop or refuse with a reason. All of it is done here."""

from __future__ import annotations

import struct

import numpy as np

from palpate_client.wire import MAX_COMMAND_BYTES, MalformedMessage, check_size, last_chunk
from palpate_server import codec
from palpate_server.realtime import scheduler
from palpate_server.realtime.records import COMMAND
from palpate_server.session.state import SessionState

# The layout of records.COMMAND: `struct` fills it much faster than numpy does.
_FIELDS = (COMMAND[name] for name in COMMAND.names or ())
_COMMAND = struct.Struct(
    "=" + "".join({"i": "q", "f": "d"}[f.base.kind] * (f.itemsize // 8) for f in _FIELDS)
)


class Admission:
    """Takes the commands of all clients; one thread at a time may call it."""

    def __init__(self, state: SessionState) -> None:
        self._state = state
        self._incoming = state.memory.commands.incoming.view(np.uint8).data

    def admit(self, key: str, payload: codec.Payload, arrival_ns: int) -> int:
        """Hand a command to the loop, or count why it is refused. Returns the number of ticks that ran on its arrival.

        key         palpate/SESSION/command/CLIENT
        arrival_ns  on the monotonic clock
        """
        messages = self._state.messages
        try:
            check_size(len(payload), MAX_COMMAND_BYTES)
            command = codec.decode_command(payload.to_bytes())
        except MalformedMessage as error:
            messages.malformed[error.reason] += 1
            return 0
        reason = self._write(command, last_chunk(key), arrival_ns)
        ticks = 0
        if reason is None:
            # `arrive` checks the numbers: sequence, finite, range.
            ticks = scheduler.arrive(self._state.image, len(command.position_m))
            reason = scheduler.REFUSALS[-ticks] if ticks < 0 else None
        if reason is not None:
            messages.refused[reason] += 1
            return 0
        messages.accepted += 1
        return ticks

    def _write(self, command: codec.Command, client: str, arrival_ns: int) -> str | None:
        """Write a command to where `arrive` reads it. Returns one of palpate_client.wire.REFUSED, or None."""
        state = self._state
        if not state.running:
            return "stopping"
        for place, (name, position) in enumerate(command.position_m.items()):
            tool = state.tool_index.get(name)
            if tool is None:
                return "unknown_tool"
            # Read before the holder. If the tool changes hands in between, the loop discards the command by this number.
            lease = state.lease_numbers[tool]
            if state.leases.holders[name] != client:
                return "not_holder"
            _COMMAND.pack_into(
                self._incoming,
                place * _COMMAND.size,
                tool,
                lease,
                command.sequence,
                command.client_time_ns,
                arrival_ns,
                command.rendered_tick,
                *position,
                *command.velocity_m_per_s[name],
                command.attach.get(name, False),
            )
        return None
