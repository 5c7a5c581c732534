"""Who moves which contact: a client acquires contacts for itself alone, until it releases them or vanishes."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from palpate_server.realtime.frames import IDENTITY, Frame
from palpate_server.realtime.safety import Limits
from palpate_server.session.devices import Device


class Refused(Exception):
    """A request that is not granted; `reason` is a short fixed word, the message says it in full."""

    def __init__(self, reason: str, message: str) -> None:
        super().__init__(message)
        self.reason = reason


@dataclass(frozen=True)
class Terms:
    """How a contact is held: within which limits, in which frame and with which device, from which tick on.

    held_since_tick is the first tick of the present hold, which begins at rest; limits may have changed since.
    """

    limits: Limits
    frame: Frame
    device: Device | None = None
    since_tick: int = 0
    held_since_tick: int = 0


class Leases:
    """The holder of every contact, and the terms. Changed by one thread alone; may be read by any."""

    def __init__(self, contacts: Sequence[str], ceiling: Limits) -> None:
        self.contacts = tuple(contacts)
        self.holders: dict[str, str | None] = dict.fromkeys(contacts)
        self.terms: dict[str, Terms] = dict.fromkeys(contacts, Terms(ceiling, IDENTITY))

    def check(self, client: str, contacts: Iterable[str]) -> None:
        """Raises Refused when one of `contacts` is unknown or another client's."""
        for name in contacts:
            if name not in self.holders:
                known = ", ".join(self.contacts)
                raise Refused("unknown_contact", f"no contact is called {name!r}: there are {known}")
            holder = self.holders[name]
            if holder is not None and holder != client:
                raise Refused("held", f"contact {name!r} is held by client {holder!r}")

    def held_by(self, client: str) -> tuple[str, ...]:
        return tuple(name for name, holder in self.holders.items() if holder == client)

    def release(self, client: str) -> tuple[str, ...]:
        """Take every contact away from `client`; the names of those it held."""
        held = self.held_by(client)
        for name in held:
            self.holders[name] = None
        return held
