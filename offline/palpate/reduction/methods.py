"""Four ways to reduce a viscoelastic body to a few states, by order or by the force error inside a frequency band."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from palpate.lti.block_form import diagonalize, to_block_form
from palpate.lti.errors import ReductionError as ReductionError
from palpate.lti.frequencies import band_frequencies, relative_errors
from palpate.lti.pole_residue import DiagonalSystem
from palpate.model_file import StateSpace
from palpate.reduction.balancing import Balancing, Gramians, balance
from palpate.reduction.gramians import band_controllability_factor, gramians, real_form
from palpate.reduction.search import smallest_order

Method = Literal["tbr", "tbr-band", "modal", "modal-static"]
METHODS: tuple[Method, ...] = ("tbr", "tbr-band", "modal", "modal-static")

Array = NDArray[np.float64]

# The trace of what a Gramian factor leaves out, relative to the Gramian's. Hankel singular values are off by about its
# square root at worst, so this keeps them to 1e-10 of the largest.
_GRAMIAN_TOLERANCE = 1e-20

Response = Callable[[DiagonalSystem, Array], NDArray[np.complex128]]


@dataclass(frozen=True)
class Reduction:
    """A reduced model dx/dt = A x + B u, F = C x + D u and what its method knows about it.

    system                  in diagonal form, every pole in the open left half plane
    hankel_singular_values  (k,), of the Gramians that were balanced, largest first; empty for modal methods
    error_bound             upper bound, in the units of F, on the largest error over all frequencies; None without
    """

    method: Method
    system: DiagonalSystem
    hankel_singular_values: Array
    error_bound: float | None

    @property
    def order(self) -> int:
        """Number of real states (that of `state_space` is one more where this is odd)."""
        return self.system.n_states

    @property
    def state_space(self) -> StateSpace:
        """In real block-diagonal form."""
        return to_block_form(self.system)


@dataclass(frozen=True)
class Family:
    """All reduced systems of one method: what is common to them is computed once.

    orders     the orders it has, ascending
    at         the system of one of them; its stability is for the caller to look at
    balancing  None for modal methods
    """

    orders: NDArray[np.intp]
    at: Callable[[int], DiagonalSystem]
    balancing: Balancing | None = None


def reduce(
    system: DiagonalSystem,
    method: Method,
    *,
    order: int | None = None,
    tolerance: float | None = None,
    band_hz: tuple[float, float] = (0.0, 30.0),
    response: Response | None = None,
) -> Reduction:
    """Reduce a stable system to `order` states, or to the fewest that keep the force error in the band.

    method     "tbr": balanced truncation (Moore 1981; H-infinity bound: Enns 1984, Glover 1984).
               "tbr-band": one-sided band-limited balanced truncation: the controllability Gramian limited to the band,
               the whole observability Gramian, so that the reduced model is stable (Sreeram & Ghafoor 2005); no bound.
               "modal": the modes of lowest frequency, whole, D unchanged.
               "modal-static": the same, and the residual stiffness of the dropped modes added to D: exact statics.
    order      number of real states; fewer where further ones are below round-off (the reduction says how many), and
               for modal methods as many as the whole modes that fit in have
    tolerance  largest over the band of |F - F_reduced| / |F|, a fraction, for every method
    band_hz    (low, high), 0 <= low < high
    response   what the tolerance holds for: maps a reduced system and frequencies omega (n,), rad/s, to its response
               (n, n_outputs, n_inputs), for example once sampled; left out: F_reduced(j omega)

    Raises ReductionError where the system is not stable (nothing is reduced silently then), the order is too
    small for the method, or the tolerance is not reached; ValueError for arguments out of range.
    """
    _check_arguments(order, tolerance)
    family = reductions(system, method, band_hz)
    if order is not None:
        chosen = _available(family.orders, order, method)
        reduced = family.at(chosen)
    else:
        assert tolerance is not None  # _check_arguments has seen to it
        reduced, chosen = _smallest(system, family, tolerance, band_hz, method, response or _continuous)
    if not reduced.spectral_abscissa < 0:
        raise ReductionError(
            f"{method} at order {chosen} has a spectral abscissa of {reduced.spectral_abscissa:.3g} 1/s, "
            "expected below 0: choose another order"
        )
    balancing = family.balancing
    singular_values = np.zeros(0) if balancing is None else balancing.sigma
    bound = 2 * balancing.tail(chosen) if method == "tbr" and balancing is not None else None
    return Reduction(method, reduced, singular_values, bound)


def reductions(system: DiagonalSystem, method: Method, band_hz: tuple[float, float] = (0.0, 30.0)) -> Family:
    """The reduced systems of a method at every order it has; arguments and errors as in `reduce`."""
    if method not in METHODS:
        raise ValueError(f"method = {method!r}: expected one of {', '.join(METHODS)}")
    if not 0 <= band_hz[0] < band_hz[1] < math.inf:
        raise ValueError(f"band_hz = {band_hz}: expected (low, high) with 0 <= low < high")
    _check_stability(system)
    if method == "tbr":
        return _balanced(system, gramians(system, _GRAMIAN_TOLERANCE))
    if method == "tbr-band":
        return _balanced(system, _band_limited(system, band_hz))
    return _modal(system, keep_statics=method == "modal-static")


def _continuous(system: DiagonalSystem, omega: Array) -> NDArray[np.complex128]:
    return system.transfer(1j * omega)


def _check_arguments(order: int | None, tolerance: float | None) -> None:
    if (order is None) == (tolerance is None):
        raise ValueError(f"order = {order} and tolerance = {tolerance}: expected exactly one of them")
    if order is not None and not (isinstance(order, int | np.integer) and order >= 1):
        raise ValueError(f"order = {order!r}: expected a whole number of states, at least 1")
    if tolerance is not None and not 0 < tolerance < math.inf:
        raise ValueError(f"tolerance = {tolerance}: expected a number above 0")


def _check_stability(system: DiagonalSystem) -> None:
    abscissa = system.spectral_abscissa
    if np.all(system.poles.real == 0):
        raise ReductionError(
            "the body is purely elastic: all its poles lie on the imaginary axis, so it has no Gramians and a "
            "reduced model would ring for ever; give the material a Prony series"
        )
    if not abscissa < 0:
        growing = int(np.count_nonzero(system.poles.real >= 0))
        raise ReductionError(
            f"the full model is not stable: {growing} of its {len(system.poles)} poles do not decay, spectral abscissa "
            f"{abscissa:.3g} 1/s, expected below 0"
        )


def _balanced(system: DiagonalSystem, gramians: Gramians) -> Family:
    form = real_form(system)
    balancing = balance(form, gramians)

    def at(order: int) -> DiagonalSystem:
        reduced = balancing.truncated(form, order)
        return diagonalize(reduced.a, reduced.b, reduced.c, reduced.d)

    return Family(np.arange(1, balancing.rank + 1), at, balancing)


def _band_limited(system: DiagonalSystem, band_hz: tuple[float, float]) -> Gramians:
    band = (2 * math.pi * band_hz[0], 2 * math.pi * band_hz[1])
    control = band_controllability_factor(system, band)
    return Gramians(control, gramians(system, _GRAMIAN_TOLERANCE).observe)


def _modal(system: DiagonalSystem, *, keep_statics: bool) -> Family:
    """The groups of lowest number, that is the relaxation of the static stiffness and the slowest modes."""
    sizes = np.bincount(system.group, weights=np.where(system.is_pair, 2, 1)).astype(np.intp)
    orders = np.unique(np.cumsum(sizes))
    orders = orders[orders > 0]

    def at(order: int) -> DiagonalSystem:
        kept = np.isin(system.group, np.flatnonzero(np.cumsum(sizes) <= order))
        reduced = system.take(kept)
        if not keep_statics:
            return reduced
        d = system.d + system.static_gain() - reduced.static_gain()
        return DiagonalSystem(reduced.poles, reduced.b, reduced.c, d, reduced.group)

    return Family(orders, at)


def _available(orders: NDArray[np.intp], order: int, method: str) -> int:
    """The largest order of the method up to the one asked for."""
    if not len(orders) or order < orders[0]:
        least = int(orders[0]) if len(orders) else 0
        raise ReductionError(f"order = {order}: {method} needs at least {least} states here")
    return int(orders[np.searchsorted(orders, order, side="right") - 1])


def _smallest(
    system: DiagonalSystem,
    family: Family,
    tolerance: float,
    band_hz: tuple[float, float],
    method: str,
    response: Response,
) -> tuple[DiagonalSystem, int]:
    """The stable system of smallest order within the tolerance, and that order."""
    omega = band_frequencies((system,), band_hz)
    full = system.transfer(1j * omega)
    best = (math.inf, 0)

    def attempt(order: int) -> DiagonalSystem | None:
        nonlocal best
        try:
            reduced = family.at(order)
        except ReductionError:  # poles that nearly coincide have no diagonal form; other orders do
            return None
        # Between the samples only the reduced model's own resonances can stand out.
        own = np.setdiff1d(band_frequencies((reduced,), band_hz), omega)
        error = float(np.max(relative_errors(full, response(reduced, omega))))
        if error <= tolerance and len(own):
            more = relative_errors(system.transfer(1j * own), response(reduced, own))
            error = max(error, float(np.max(more)))
        if reduced.spectral_abscissa < 0:
            best = min(best, (error, order))
            if error <= tolerance:
                return reduced
        return None

    found = smallest_order(family.orders, attempt)
    if found is None:
        raise ReductionError(
            f"tolerance = {tolerance:g}: {method} reaches {best[0]:.2g} in {band_hz[0]:g}-{band_hz[1]:g} Hz at best, "
            f"at order {best[1]}"
        )
    return found[1], found[0]
