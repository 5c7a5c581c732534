"""The reductions that the figures compare, each by the same call."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.lti.block_form import diagonalize
from palpate.lti.pole_residue import PoleResidueSystem
from palpate.reduction import Reduction, ReductionError, reduce
from palpate.reduction.methods import balanced
from palpate.scene.quantities import SystemMethod

Band = tuple[float, float]
Apply = Callable[[PoleResidueSystem, Band, int], Reduction]

_EQUAL = 1e-6
"""Hankel singular values this near to each other, relatively, are not separated by singular perturbation."""


@dataclass(frozen=True)
class Method:
    """A reduction to `order` states, by (system, band in Hz, order), and its style in plots."""

    name: str
    label: str
    color: str
    marker: str
    apply: Apply
    marker_size: int = 4

    @property
    def style(self) -> dict[str, Any]:
        """Style of the curve; one that another may cover has a larger open marker and a wider line."""
        return {
            "color": self.color,
            "marker": self.marker,
            "markersize": self.marker_size,
            "markerfacecolor": "none" if self.marker_size > 4 else self.color,
            "linewidth": self.marker_size / 4,
            "label": self.label,
        }


def singular_perturbation_balancing(system: PoleResidueSystem, order: int) -> Reduction:
    """The weak states of the balanced realization take their quasi-static values instead of being dropped: exact statics.

    The bound is that of balanced truncation (Liu & Anderson 1989). Nearly equal Hankel singular values are kept or dropped
    together: half of a lightly damped oscillator has no quasi-static value.

    Raises ReductionError where the reduced system is not stable or its poles nearly coincide.
    """
    balancing = balanced(system)
    orders = balancing.separated_orders(balancing.rank, _EQUAL)
    r = int(orders[orders <= order][-1])
    a, b, c, d = balancing.truncated(balancing.rank)
    fast = np.linalg.solve(a[r:, r:], np.hstack([a[r:, :r], b[r:]]))
    reduced = diagonalize(
        a[:r, :r] - a[:r, r:] @ fast[:, :r],
        b[:r] - a[:r, r:] @ fast[:, r:],
        c[:, :r] - c[:, r:] @ fast[:, :r],
        d - c[:, r:] @ fast[:, r:],
    )
    if not reduced.spectral_abscissa < 0:
        raise ReductionError(
            f"singular perturbation balancing to {r} states has a spectral abscissa of {reduced.spectral_abscissa:.3g} 1/s, "
            "expected below 0: choose another order"
        )
    return Reduction("singular-perturbation", reduced, balancing.sigma, 2 * balancing.tail(r))


def _by(method: SystemMethod) -> Apply:
    return lambda system, band, order: reduce(system, method, order=order, band_hz=band)


HOM = Method("HOM", "Hankel-optimal", "tab:green", "s", _by("hankel-optimal"))
MT = Method("MT", "modal truncation", "tab:orange", "^", _by("modal"), marker_size=10)
"""The modes of lowest frequency, each with its memory; by modulus of the poles alone the slow memories would come first."""

TBR = Method("TBR", "truncated balanced realization", "tab:red", "o", _by("tbr"), marker_size=8)
MT_STATICS = Method(
    "MT+statics",
    "modal truncation with residual stiffness",
    "tab:brown",
    "v",
    _by("modal-static"),
    marker_size=6,
)
SPB = Method(
    "SPB",
    "singular perturbation balancing",
    "tab:purple",
    "D",
    lambda system, band, order: singular_perturbation_balancing(system, order),
)
BAND = Method("band-limited", "band-limited truncation", "tab:blue", "*", _by("tbr-band"))

OF_THE_PAPER = (HOM, MT, TBR)
ALL = (*OF_THE_PAPER, MT_STATICS, SPB, BAND)


@dataclass(frozen=True)
class Reduced:
    """A reduced model.

    order                   number of states that the method reached, at most what was asked for
    bound                   on the largest error over all frequencies, units of the response; None without
    hankel_singular_values  (k,), largest first; empty for modal truncation
    seconds                 that the reduction took, from the full model's poles and residues on
    """

    method: Method
    order: int
    system: PoleResidueSystem
    bound: float | None
    hankel_singular_values: NDArray[np.float64]
    seconds: float


def reduce_by(method: Method, system: PoleResidueSystem, band_hz: Band, order: int) -> Reduced | None:
    """The reduced model, or None where the method raises ReductionError for that order."""
    start = time.perf_counter()
    try:
        reduced = method.apply(system, band_hz, order)
    except ReductionError:
        return None
    seconds = time.perf_counter() - start
    return Reduced(
        method, reduced.order, reduced.system, reduced.error_bound, reduced.hankel_singular_values, seconds
    )
