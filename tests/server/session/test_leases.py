"""Leases: one holder a contact, and nothing half granted."""

from __future__ import annotations

import pytest

from palpate_server.realtime.safety import Limits
from palpate_server.session.leases import Leases, Refused

CEILING = Limits(1.0, 1.0, 1.0, 1.0, 0.0)


def test_a_held_contact_is_refused_to_others_and_not_to_its_holder() -> None:
    leases = Leases(["a", "b"], CEILING)
    leases.holders["a"] = "first"
    leases.check("first", ["a", "b"])
    with pytest.raises(Refused, match="first") as refusal:
        leases.check("second", ["b", "a"])
    assert refusal.value.reason == "held"


def test_an_unknown_contact_is_refused_by_name() -> None:
    with pytest.raises(Refused, match=r"'c'.*a, b") as refusal:
        Leases(["a", "b"], CEILING).check("first", ["a", "c"])
    assert refusal.value.reason == "unknown_contact"


def test_release_frees_what_the_client_held_and_nothing_else() -> None:
    leases = Leases(["a", "b", "c"], CEILING)
    leases.holders |= {"a": "first", "b": "second", "c": "first"}
    assert leases.held_by("first") == ("a", "c")
    assert leases.release("first") == ("a", "c")
    assert leases.holders == {"a": None, "b": "second", "c": None}
    assert leases.release("first") == ()
