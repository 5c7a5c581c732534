"""Presses the tools of a model that is to be faded in to where they are, so that it begins settled."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from palpate_server.coupling import running as models
from palpate_server.coupling.running import Running
from palpate_server.coupling.spheres import LIFTED
from palpate_server.realtime import native_image
from palpate_server.realtime.compiled import compiled
from palpate_server.realtime.native_image import Image, make_image, view
from palpate_server.realtime.records import REACTION

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Records = NDArray[np.void]

TICKS = 300  # in the first two thirds the tools come, then the tissue settles
_AT_ONCE = 5  # ticks in one call, which holds the interpreter


class Touch(NamedTuple):
    """How tools touch another model: wanted (n_tools,), as in `running.advance`; reactions (n_tools,) REACTION."""

    wanted: Integers
    reactions: Records


def press(running: Running, displacement: Floats, touch: Touch, radius_m: Sequence[float]) -> None:
    """Let the tools come to `displacement` (n_tools, 3), m, from outside of the tissue, along the normals of their contacts."""
    n = len(displacement)
    depth = np.maximum(touch.reactions["penetration_m"], 0.0) + np.array(radius_m)
    away = touch.reactions["normal"] * np.where(touch.wanted != LIFTED, depth, 0.0)[:, None]
    image = make_image(running)
    now, force, reactions, ledger = np.zeros((n, 3)), np.zeros((n, 3)), np.zeros(n, REACTION), np.zeros(2)
    for first in range(0, TICKS, _AT_ONCE):
        _press(image, displacement, away, now, touch.wanted, force, reactions, ledger, first)


@compiled
def _press(
    image: Image,
    displacement: Floats,
    away: Floats,
    now: Floats,
    wanted: Integers,
    force: Floats,
    reactions: Records,
    ledger: Floats,
    first: int,
) -> None:
    running = view(image)
    for tick in range(first, first + _AT_ONCE):
        share = max(0.0, 1.0 - 1.5 * (tick + 1) / TICKS)
        for i in range(displacement.shape[0]):
            for j in range(3):
                now[i, j] = displacement[i, j] + share * away[i, j]
        models.advance(running, now, wanted, force, reactions, ledger)


native_image.register("running", models.empty())
