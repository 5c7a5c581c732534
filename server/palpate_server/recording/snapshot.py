"""The state between two ticks as a message: what a recording begins with, and what each change of settings is recorded as."""

from __future__ import annotations

from typing import Any

import numpy as np

from palpate_server.coupling.models import Model
from palpate_server.realtime.records import COMMAND, COUNTERS, PORT, SETTINGS, Change
from palpate_server.realtime.shared_memory import Memory, Saved
from palpate_server.recording.json_records import as_objects, from_objects


def identity(model: Model) -> dict[str, Any]:
    """What tells a model from others in a recording."""
    return {
        "name": model.name,
        "kind": model.kind,
        "order": model.order,
        "config_sha256": model.config_sha256,
        "stiffness_factor": model.stiffness_factor,
    }


def as_message(memory: Memory, model: Model, following: Model | None) -> dict[str, Any]:
    """The state that the last change saved; `following` is the model that is being faded in."""
    saved = memory.saved
    (counters,) = as_objects(saved.counters)
    tick = counters["ticks"]
    change = Change(int(memory.ring.ticks["change"][tick % len(memory.ring.ticks)]))
    return {
        "tick": tick,
        "change": change.name.lower(),
        "model": identity(model),
        "following": following and identity(following),
        "counters": counters,
        "used": as_objects(saved.used),
        "settings": as_objects(saved.settings),
        "ports": as_objects(saved.ports),
        "state": saved.state.tolist(),
    }


def from_message(message: dict[str, Any]) -> Saved:
    """The state in a message. Raises KeyError, TypeError or ValueError when it is none."""
    return Saved(
        from_objects([message["counters"]], COUNTERS),
        from_objects(message["used"], COMMAND),
        from_objects(message["settings"], SETTINGS),
        from_objects(message["ports"], PORT),
        np.array(message["state"], np.float64),
    )
