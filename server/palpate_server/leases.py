"""Who moves which contact: a client acquires contacts for itself alone, until it releases them or vanishes."""

from __future__ import annotations

from collections.abc import Iterable, Sequence


class Refused(Exception):
    """A request that is not granted; `reason` is a short fixed word, the message says it in full."""

    def __init__(self, reason: str, message: str) -> None:
        super().__init__(message)
        self.reason = reason


class Leases:
    """The holder of every contact. Changed by one thread alone; `holders` may be read by any."""

    def __init__(self, contacts: Sequence[str]) -> None:
        self.contacts = tuple(contacts)
        self.holders: dict[str, str | None] = dict.fromkeys(contacts)

    def acquire(self, client: str, contacts: Iterable[str]) -> None:
        """Give `contacts` to `client`, all or none. Raises Refused when one is unknown or another client's."""
        wanted = tuple(contacts)
        for name in wanted:
            if name not in self.holders:
                known = ", ".join(self.contacts)
                raise Refused("unknown_contact", f"no contact is called {name!r}: there are {known}")
            holder = self.holders[name]
            if holder is not None and holder != client:
                raise Refused("held", f"contact {name!r} is held by client {holder!r}")
        for name in wanted:
            self.holders[name] = client

    def release(self, client: str) -> tuple[str, ...]:
        """Take every contact away from `client`; the names of those it held."""
        held = tuple(name for name, holder in self.holders.items() if holder == client)
        for name in held:
            self.holders[name] = None
        return held
