"""The reductions that the figures compare, each by the same call."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from palpate.lti.block_form import diagonalize
from palpate.lti.pole_residue import DiagonalSystem
from palpate.reduction import (
    ReducedSystem,
    Reduction,
    ReductionError,
    balanced_truncation,
    band_limited_truncation,
    hankel_optimal,
    reduce,
    singular_perturbation_balancing,
)

Band = tuple[float, float]
Apply = Callable[[DiagonalSystem, Band, int], ReducedSystem | Reduction]


@dataclass(frozen=True)
class Method:
    """A reduction to `order` states, by (system, band in Hz, order), and how plots show it."""

    name: str
    label: str
    color: str
    marker: str
    apply: Apply
    marker_size: int = 4

    @property
    def style(self) -> dict[str, Any]:
        """For plots of all methods: what another may cover is larger, with an open marker and a wider line."""
        return {
            "color": self.color,
            "marker": self.marker,
            "markersize": self.marker_size,
            "markerfacecolor": "none" if self.marker_size > 4 else self.color,
            "linewidth": self.marker_size / 4,
            "label": self.label,
        }


def _modal(system: DiagonalSystem, name: Literal["modal", "modal-static"], order: int) -> Reduction:
    """With the bound that dropped modes have: |F - F_r| <= sum of |c_k b_k^T| / |Re lambda_k|, their statics kept or not."""
    reduced = reduce(system, name, order=order)
    dropped = system.take(~np.isin(system.group, reduced.system.group))
    share = np.linalg.norm(dropped.b, axis=1) * np.linalg.norm(dropped.c, axis=0) / -dropped.poles.real
    return replace(reduced, error_bound=float(np.sum(np.where(dropped.is_pair, 2, 1) * share)))


HOM = Method("HOM", "Hankel-optimal", "tab:green", "s", lambda g, band, r: hankel_optimal(g, r))
MT = Method(
    "MT", "modal truncation", "tab:orange", "^", lambda g, band, r: _modal(g, "modal", r), marker_size=10
)
"""The modes of lowest frequency, each with its memory; by modulus of the poles alone the slow memories would come first."""

TBR = Method(
    "TBR",
    "truncated balanced realization",
    "tab:red",
    "o",
    lambda g, band, r: balanced_truncation(g, r),
    marker_size=8,
)
MT_STATICS = Method(
    "MT+statics",
    "modal truncation with residual stiffness",
    "tab:brown",
    "v",
    lambda g, band, r: _modal(g, "modal-static", r),
    marker_size=6,
)
SPB = Method(
    "SPB",
    "singular perturbation balancing",
    "tab:purple",
    "D",
    lambda g, band, r: singular_perturbation_balancing(g, r),
)
BAND = Method(
    "band-limited",
    "band-limited truncation",
    "tab:blue",
    "*",
    lambda g, band, r: band_limited_truncation(g, band, r),
)

OF_THE_PAPER = (HOM, MT, TBR)
ALL = (*OF_THE_PAPER, MT_STATICS, SPB, BAND)


@dataclass(frozen=True)
class Reduced:
    """A reduced model in diagonal form.

    order                   number of states that the method reached, at most what was asked for
    bound                   on the largest error over all frequencies, units of the response; None without
    hankel_singular_values  (k,), largest first; empty for modal truncation
    seconds                 that the reduction took, from the full model's poles and residues on
    """

    method: Method
    order: int
    system: DiagonalSystem
    bound: float | None
    hankel_singular_values: NDArray[np.float64]
    seconds: float


def reduce_by(method: Method, system: DiagonalSystem, band_hz: Band, order: int) -> Reduced | None:
    """The reduced model, or None where the method has none of that order (it says so by ReductionError)."""
    start = time.perf_counter()
    try:
        reduced = method.apply(system, band_hz, order)
    except ReductionError:
        return None
    plain = reduced.system
    diagonal = plain if isinstance(plain, DiagonalSystem) else diagonalize(plain.a, plain.b, plain.c, plain.d)
    seconds = time.perf_counter() - start
    return Reduced(
        method, reduced.order, diagonal, reduced.error_bound, reduced.hankel_singular_values, seconds
    )
