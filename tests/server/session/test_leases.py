"""Leases: one holder a tool, and nothing half granted."""

from __future__ import annotations

import pytest

from palpate_client import Frame
from palpate_server.errors import Refused
from palpate_server.realtime.safety import Limits
from palpate_server.session.leases import Leases, ToolSettings

SETTINGS = ToolSettings(Limits(1.0, 1.0, 1.0, 1.0, 0.0), Frame(), (0.0, 0.0, 0.0))


def leases_of(*tools: str) -> Leases:
    return Leases(dict.fromkeys(tools, SETTINGS))


def test_a_held_tool_is_refused_to_others_and_not_to_its_holder() -> None:
    leases = leases_of("a", "b")
    leases.holders["a"] = "first"
    leases.check("first", ["a", "b"])
    with pytest.raises(Refused, match="first") as refusal:
        leases.check("second", ["b", "a"])
    assert refusal.value.reason == "held"


def test_an_unknown_tool_is_refused_by_name() -> None:
    with pytest.raises(Refused, match=r"'c'.*a, b") as refusal:
        leases_of("a", "b").check("first", ["a", "c"])
    assert refusal.value.reason == "unknown_tool"


def test_release_frees_what_the_client_held_and_nothing_else() -> None:
    leases = leases_of("a", "b", "c")
    leases.holders |= {"a": "first", "b": "second", "c": "first"}
    assert leases.held_by("first") == ("a", "c")
    assert leases.release("first") == ("a", "c")
    assert leases.holders == {"a": None, "b": "second", "c": None}
    assert leases.release("first") == ()
