"""The reductions of a linear system to a few states, by order or by the error inside a frequency band."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import get_args

import numpy as np
from numpy.typing import NDArray

from palpate.lti.block_form import diagonalize
from palpate.lti.errors import ReductionError
from palpate.lti.frequencies import band_frequencies, relative_errors, spectral_norms
from palpate.lti.pole_residue import PoleResidueSystem
from palpate.reduction.balancing import Balancing, balance
from palpate.reduction.gramians import Gramians, band_controllability_factor, gramians, real_form
from palpate.reduction.hankel_optimal import hankel_optimal, hankel_optimal_bound, hankel_optimal_orders
from palpate.reduction.search import smallest_order
from palpate.scene.quantities import SystemMethod

METHODS: tuple[SystemMethod, ...] = get_args(SystemMethod)

Array = NDArray[np.float64]
Response = Callable[[PoleResidueSystem, Array], NDArray[np.complex128]]

_LIGHTLY_DAMPED = 1e-6
"""|Re p| / |p| below which round-off moves a pole so far that a bound may fail."""


@dataclass(frozen=True)
class Reduction:
    """A reduced model and what its method knows about it.

    method                  its name
    system                  every pole in the open left half plane
    hankel_singular_values  (k,), of the Gramians that were balanced, largest first; empty for modal methods
    error_bound             upper bound, in the units of F, on the largest error over all frequencies; None without
    """

    method: str
    system: PoleResidueSystem
    hankel_singular_values: Array
    error_bound: float | None

    @property
    def order(self) -> int:
        """Number of real states."""
        return self.system.n_states


@dataclass(frozen=True)
class Family:
    """All reduced systems of one method: what is common to them is computed once.

    orders                  the orders it has, ascending
    at                      the system of one of them; the caller checks whether it is stable
    bound                   the bound of one of them, as in `Reduction`
    hankel_singular_values  as in `Reduction`
    """

    orders: NDArray[np.intp]
    at: Callable[[int], PoleResidueSystem]
    bound: Callable[[int], float | None]
    hankel_singular_values: Array


def reduce(
    system: PoleResidueSystem,
    method: SystemMethod,
    *,
    order: int | None = None,
    tolerance: float | None = None,
    band_hz: tuple[float, float] = (0.0, 30.0),
    response: Response | None = None,
) -> Reduction:
    """Reduce a stable system to `order` states, or to the fewest that keep the error in the band.

    Parameters
    ----------
    method
        "tbr": balanced truncation (Moore 1981; H-infinity bound 2 sum_{i > r} sigma_i: Enns 1984, Glover 1984).
        "tbr-band": one-sided band-limited balanced truncation: the controllability Gramian limited to the band, the whole
        observability Gramian, so that the reduced model is stable (Sreeram & Ghafoor 2005); no bound.
        "hankel-optimal": the Hankel norm of the error is sigma_{r+1}, the least that is possible (Glover 1984).
        "modal": the modes of lowest frequency, whole, D unchanged (Davison 1966). Bound: sum of |c_k b_k^T| / |Re p_k|
        over the dropped poles.
        "modal-static": the same, and the static response of the dropped modes added to D: exact statics, same bound.
    order
        Number of real states. Fewer where further ones are below round-off, where Hankel singular values are equal
        (hankel-optimal), or where the next mode does not fit (modal methods).
    tolerance
        Largest over the band of |F - F_reduced| / |F|, a fraction, for every method.
    band_hz
        (low, high), 0 <= low < high.
    response
        What the tolerance holds for: maps a reduced system and frequencies omega (n,), rad/s, to its response
        (n, n_outputs, n_inputs), for example once sampled. Default: F_reduced(j omega).

    Raises
    ------
    ReductionError
        The system is not stable, the order is too small for the method, the tolerance is not reached, or round-off spoils
        the reduced model (it is not stable, its poles nearly coincide, or it does not keep its bound).
    ValueError
        An argument is out of range.
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
    bound = family.bound(chosen)
    if bound is not None:
        _check_bound(system, reduced, method, bound)
    return Reduction(method, reduced, family.hankel_singular_values, bound)


def reductions(
    system: PoleResidueSystem, method: SystemMethod, band_hz: tuple[float, float] = (0.0, 30.0)
) -> Family:
    """The reduced systems of a method at every order it has; arguments and errors as in `reduce`."""
    if method not in METHODS:
        raise ValueError(f"method = {method!r}: expected one of {', '.join(METHODS)}")
    if not 0 <= band_hz[0] < band_hz[1] < math.inf:
        raise ValueError(f"band_hz = {band_hz}: expected (low, high) with 0 <= low < high")
    check_stability(system)
    if method in ("modal", "modal-static"):
        return _modal(system, keep_statics=method == "modal-static")
    balancing = balance(real_form(system), _gramians(system, method, band_hz))
    if method == "hankel-optimal":
        return Family(
            hankel_optimal_orders(balancing),
            lambda order: diagonalize(*hankel_optimal(balancing, order)),
            lambda order: hankel_optimal_bound(balancing, order),
            balancing.sigma,
        )
    return Family(
        np.arange(min(1, balancing.rank), balancing.rank + 1),
        lambda order: diagonalize(*balancing.truncated(order)),
        lambda order: 2 * balancing.tail(order) if method == "tbr" else None,
        balancing.sigma,
    )


def balanced(system: PoleResidueSystem) -> Balancing:
    """The balancing that "tbr" and "hankel-optimal" start from."""
    return balance(real_form(system), gramians(system))


def _continuous(system: PoleResidueSystem, omega: Array) -> NDArray[np.complex128]:
    return system.transfer(1j * omega)


def _check_arguments(order: int | None, tolerance: float | None) -> None:
    if (order is None) == (tolerance is None):
        raise ValueError(f"order = {order} and tolerance = {tolerance}: expected exactly one of them")
    if order is not None and not (isinstance(order, int | np.integer) and order >= 1):
        raise ValueError(f"order = {order!r}: expected a whole number of states, at least 1")
    if tolerance is not None and not 0 < tolerance < math.inf:
        raise ValueError(f"tolerance = {tolerance}: expected a number above 0")


def check_stability(system: PoleResidueSystem) -> None:
    abscissa = system.spectral_abscissa
    if len(system.poles) and np.all(system.poles.real == 0):
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


def _check_bound(
    full: PoleResidueSystem, reduced: PoleResidueSystem, method: SystemMethod, bound: float
) -> None:
    """At the resonances of very lightly damped poles, where round-off may break it; bounds are those of exact arithmetic."""
    poles = np.concatenate([full.poles, reduced.poles])
    narrow = poles[(poles.imag > 0) & (-poles.real < _LIGHTLY_DAMPED * poles.imag)]
    if not len(narrow):
        return
    exact = full.transfer(1j * narrow.imag)
    error = float(np.max(spectral_norms(exact - reduced.transfer(1j * narrow.imag))))
    round_off = 1e-13 * float(np.max(narrow.imag / -narrow.real) * np.max(spectral_norms(exact)))
    if not error <= bound + round_off:
        raise ReductionError(
            f"{method} to {reduced.n_states} states has an error of {error:.3g} at a resonance, expected at most {bound:.3g}: "
            "the system is too lightly damped for double precision there, choose another order"
        )


def _gramians(system: PoleResidueSystem, method: SystemMethod, band_hz: tuple[float, float]) -> Gramians:
    whole = gramians(system)
    if method != "tbr-band":
        return whole
    band = (2 * math.pi * band_hz[0], 2 * math.pi * band_hz[1])
    return Gramians(band_controllability_factor(system, band), whole.observe)


def _modal(system: PoleResidueSystem, *, keep_statics: bool) -> Family:
    """The groups of lowest number, that is the relaxation of the static stiffness and the slowest modes."""
    group = np.arange(len(system.poles)) if system.group is None else system.group
    states = np.where(system.is_pair, 2, 1)
    sizes = np.bincount(group, weights=states).astype(np.intp)
    orders = np.unique(np.cumsum(sizes))
    orders = orders[orders > 0] if len(orders) else np.zeros(1, dtype=np.intp)
    largest_error = states * np.linalg.norm(system.b, axis=1) * np.linalg.norm(system.c, axis=0)
    largest_error /= -system.poles.real

    def kept(order: int) -> NDArray[np.bool_]:
        return np.isin(group, np.flatnonzero(np.cumsum(sizes) <= order))

    def at(order: int) -> PoleResidueSystem:
        reduced = system.take(kept(order))
        if not keep_statics:
            return reduced
        d = system.d + system.static_gain() - reduced.static_gain()
        return PoleResidueSystem(reduced.poles, reduced.b, reduced.c, d, reduced.group)

    return Family(orders, at, lambda order: float(np.sum(largest_error[~kept(order)])), np.zeros(0))


def _available(orders: NDArray[np.intp], order: int, method: str) -> int:
    """The largest order of the method up to the one asked for."""
    if order < orders[0]:
        raise ReductionError(f"order = {order}: {method} needs at least {orders[0]} states here")
    return int(orders[np.searchsorted(orders, order, side="right") - 1])


def _smallest(
    system: PoleResidueSystem,
    family: Family,
    tolerance: float,
    band_hz: tuple[float, float],
    method: str,
    response: Response,
) -> tuple[PoleResidueSystem, int]:
    """The stable system of smallest order within the tolerance, and that order."""
    omega = band_frequencies((system,), band_hz)
    full = system.transfer(1j * omega)
    best = (math.inf, 0)

    def attempt(order: int) -> PoleResidueSystem | None:
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
