"""From a client's frame to the model's and back: the one place where the two meet.

displacement in the model = scale · rotation · (client position - home), where `home` (3,), m, is the client position at
which the tip is at its tool's start. Forces go back as scale · rotation^T · force, so that power is the same on both sides.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from palpate_server.realtime.compiled import compiled

Floats = NDArray[np.float64]


@compiled
def to_model(rotation: Floats, scale: float, home: Floats, position: Floats, displacement: Floats) -> None:
    """Write the model displacement (3,) of a client position (3,) into `displacement`, m."""
    for i in range(3):
        total = 0.0
        for j in range(3):
            total += rotation[i, j] * (position[j] - home[j])
        displacement[i] = scale * total


@compiled
def to_device(rotation: Floats, scale: float, model_force: Floats, force: Floats) -> None:
    """Write the force (3,) in the client's frame of a model force (3,) into `force`, N."""
    for i in range(3):
        total = 0.0
        for j in range(3):
            total += rotation[j, i] * model_force[j]
        force[i] = scale * total
