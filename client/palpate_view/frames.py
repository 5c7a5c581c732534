"""From a client's frame to the model's, and where a tool's sphere is."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from palpate_client import Force

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class ToolState:
    """A tool at one tick, in the model's frame.

    device_m  (3,): where the device is
    tip_m     (3,): where the sphere of a surface model, or the point that a patch follows, is
    force_n   (3,): of the tissue on the tool
    """

    device_m: Floats
    tip_m: Floats
    force_n: Floats


def point_in_model(frame: Mapping[str, Any], point_m: ArrayLike) -> Floats:
    """A point (3,), m, of a client's frame (docs/wire.md, "Frame") in the model's frame, m."""
    rotation, scale = np.asarray(frame["rotation"], float), float(frame["scale"])
    away = np.asarray(point_m, float) - np.asarray(frame["client_origin_m"], float)
    return np.asarray(frame["model_origin_m"], float) + scale * rotation @ away


def force_in_model(frame: Mapping[str, Any], force_n: ArrayLike) -> Floats:
    """A force (3,), N, that a client's device renders as the force in the model's frame, N."""
    return np.asarray(frame["rotation"], float) @ np.asarray(force_n, float) / float(frame["scale"])


def direction_in_model(frame: Mapping[str, Any], direction: Sequence[float]) -> Floats:
    """A direction (3,) along a client's axes, along the model's axes; its length stays."""
    return np.asarray(frame["rotation"], float) @ np.asarray(direction, float)


def tool_state(force: Force, tool: Mapping[str, Any]) -> ToolState:
    """Where a tool is and what it feels.

    tool: its part of the status message: `frame` and `stiffness_n_per_m`, nil for a patch model.

    The sphere of a surface model hangs on a spring at the device. The spring's energy says how far the sphere is from the
    device, and the force in which direction: its magnitude may be limited or fading, and its direction stays.
    """
    frame, stiffness = tool["frame"], tool["stiffness_n_per_m"]
    device = point_in_model(frame, force.position_m)
    force_n = force_in_model(frame, force.force_n)
    newtons = math.hypot(*force.force_n)
    if stiffness is None or newtons == 0:
        return ToolState(device, device, force_n)
    length_m = math.sqrt(2 * max(force.touch.stored_j, 0.0) / stiffness)  # at the client
    spring = [length_m / newtons * c for c in force.force_n]
    return ToolState(device, device + float(frame["scale"]) * direction_in_model(frame, spring), force_n)
