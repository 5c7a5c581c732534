"""Warnings of parts that are loaded and have too few nodes across to bend rightly."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from palpate.geometry.cloud import NodeCloud
from palpate.geometry.regions import ContactPatch
from palpate.geometry.thickness import nodes_across, thickness
from palpate.scene.schema import Config

FEWEST = 4
"""Nodes across, below which a build warns."""

_NODES, _TOO_SOFT = (2.0, 3.0, 5.0), (0.12, 0.08, 0.018)
"""Nodes across a square cantilever, and how much too soft it bends: twice the error of its frequency (docs/validation.md)."""

_SHARE_OF_AREA = 0.05
"""Smallest share of a working area that is worth a warning: next to a rim every body is thin."""


def thin_patch(name: str, patch: ContactPatch, cloud: NodeCloud) -> str | None:
    """The warning for a contact whose patch lies on a thin part, None where it does not."""
    across = nodes_across(cloud, patch.nodes)
    middle = patch.nodes[np.argsort(across)[len(across) // 2]]
    n_across = float(np.median(across))
    if n_across >= FEWEST:
        return None
    thick = float(thickness(cloud, np.array([middle]))[0])
    return f"contact {name!r}: the body is {thick:.2g} m thick there, {_told(n_across, thick)}"


def thin_working_area(config: Config, cloud: NodeCloud, working: NDArray[np.intp]) -> str | None:
    """The warning for working areas of which a twentieth or more lies on thin parts; working (n,) are their nodes."""
    across = nodes_across(cloud, working)
    thin = across < FEWEST
    share = float(cloud.areas[working[thin]].sum() / cloud.areas[working].sum())
    if share < _SHARE_OF_AREA:
        return None
    order = np.argsort(across[thin])
    typical = working[thin][order[len(order) // 2]]
    thick = float(thickness(cloud, np.array([typical]))[0])
    n_across = float(np.median(across[thin]))
    where = "surface.working_area" if config.surface.working_area else "surface"
    return f"{where}: {100 * share:.0f} % of it is on thin parts, half of them less than {thick:.2g} m thick, {_told(n_across, thick)}"


def _told(n_across: float, thick_m: float) -> str:
    soft = 100 * float(np.interp(n_across, _NODES, _TOO_SOFT))
    more = " or more" if n_across < _NODES[0] else ""
    return (
        f"{n_across:.2g} nodes across: it bends too softly by about {soft:.0f} %{more}. Expected at least {FEWEST} nodes, "
        f"as with a spacing_m of {thick_m / (FEWEST - 1):.2g}"
    )
