"""Reductions of any stable linear system, tissue or not: balanced, singular perturbation, modal and band-limited.

All take a plain `LinearSystem` (dense, or sparse with many states) or a `DiagonalSystem`, whose Gramians come much
faster. `order` counts real states; where further ones are round-off the result has fewer. Each raises ReductionError
for a system that is not stable, unless its unstable part is to be split off, kept as it is, and added again.
A sparse system of more than DENSE_STATES states can't be split, except by modal truncation, which makes it dense.

Bounds are those of exact arithmetic: errors below about 1e-11 of the response are round-off, or below 1e-13 |p| / |Re p|
of it where the least damped pole p makes that more. With poles of |Re p| < 1e-6 |p| the bound is checked at their
resonances, and a reduction that does not keep to it is a ReductionError.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from palpate.lti.block_form import diagonalize
from palpate.lti.errors import ReductionError
from palpate.lti.frequencies import frequencies_near, relative_errors, spectral_norms
from palpate.lti.pole_residue import DiagonalSystem
from palpate.reduction.balancing import Balancing, Gramians, Realization, balance
from palpate.reduction.gramians import (
    band_controllability_factor,
    band_quadrature,
    gramians,
    real_form,
)
from palpate.reduction.hammarling import gramian_factors
from palpate.reduction.linear_system import LinearSystem, parallel, split
from palpate.reduction.low_rank_adi import NotConvergedError, low_rank_factor
from palpate.reduction.search import smallest_order

System = LinearSystem | DiagonalSystem
Unstable = Literal["refuse", "split"]
Array = NDArray[np.float64]

DENSE_STATES = 2500
"""Sparse systems up to this many states are treated as dense: exact Gramians, whatever the damping."""

_GRAMIAN_TOLERANCE = 1e-20

_EQUAL = 1e-6
"""Hankel singular values this near to each other, relatively, are not separated by singular perturbation."""

_LIGHTLY_DAMPED = 1e-6
"""|Re p| / |p| below which round-off moves a pole so far that a bound may fail."""

_AXIS = 1e-12
"""|Re p| / |p| below which a pole of a large sparse system may lie on the imaginary axis, by round-off."""


@dataclass(frozen=True)
class ReducedSystem:
    """A reduced system and what is known about it.

    method                  its name
    system                  dense, E = I
    hankel_singular_values  (k,), of the stable part, largest first (of band-limited truncation: of the Gramians that
                            it balances); empty for modal truncation
    error_bound             upper bound on the largest error over all frequencies, in units of the response; None
                            where the method has none
    """

    method: str
    system: LinearSystem
    hankel_singular_values: Array
    error_bound: float | None

    @property
    def order(self) -> int:
        """Number of real states."""
        return self.system.n_states


def balanced_truncation(
    system: System,
    order: int | None = None,
    tolerance: float | None = None,
    *,
    unstable: Unstable = "refuse",
) -> ReducedSystem:
    """Truncated balanced realization (Moore 1981), bound 2 sum_{i > r} sigma_i (Enns 1984, Glover 1984).

    tolerance  bound over sigma_1; as sigma_1 is at most the largest |G - D|, the relative error is at most this, too
    """
    part = prepare(system, order, tolerance, unstable)
    balancing = balance(part.realization, part.gramians())
    orders = np.arange(balancing.rank + 1)
    r = part.chosen_order(orders, lambda k: balancing.relative_to_largest(2 * balancing.tail(k)))
    reduced = balancing.truncated(part.realization, r)
    return part.result("balanced truncation", reduced, balancing.sigma, 2 * balancing.tail(r))


def singular_perturbation_balancing(
    system: System,
    order: int | None = None,
    tolerance: float | None = None,
    *,
    unstable: Unstable = "refuse",
) -> ReducedSystem:
    """The weak states of the balanced realization follow at once instead of being dropped: exact statics.

    The bound is that of balanced truncation (Liu & Anderson 1989); tolerance as there. Nearly equal Hankel singular values
    are kept or dropped together: half of a lightly damped oscillator that follows at once has no meaning.
    """
    part = prepare(system, order, tolerance, unstable)
    balancing = balance(part.realization, part.gramians())
    full = balancing.truncated(part.realization, balancing.rank)
    orders = balancing.separated_orders(balancing.rank, _EQUAL)
    r = part.chosen_order(orders, lambda k: balancing.relative_to_largest(2 * balancing.tail(k)))
    a, b, c = full.a, full.b, full.c
    fast = np.linalg.solve(a[r:, r:], np.hstack([a[r:, :r], b[r:]]))
    reduced = LinearSystem(
        a[:r, :r] - a[:r, r:] @ fast[:, :r],
        b[:r] - a[:r, r:] @ fast[:, r:],
        c[:, :r] - c[:, r:] @ fast[:, :r],
        full.d - c[:, r:] @ fast[:, r:],
    )
    return part.result("singular perturbation balancing", reduced, balancing.sigma, 2 * balancing.tail(r))


def band_limited_truncation(
    system: System,
    band_hz: tuple[float, float],
    order: int | None = None,
    tolerance: float | None = None,
    *,
    unstable: Unstable = "refuse",
) -> ReducedSystem:
    """One-sided band-limited balanced truncation (Sreeram & Ghafoor 2005); no a-priori bound.

    The controllability Gramian counts the band alone, the observability Gramian everything, which keeps the reduced
    model stable.

    band_hz    (low, high), 0 <= low < high
    tolerance  largest over the band of |G - G_reduced| / |G|, by sampling
    """
    if not 0 <= band_hz[0] < band_hz[1] < math.inf:
        raise ValueError(f"band_hz = {band_hz}: expected (low, high) with 0 <= low < high")
    part = prepare(system, order, tolerance, unstable)
    observe = part.gramians().observe  # first: it fails for a large sparse system that is not stable
    control = _band_factor(part.stable, (2 * math.pi * band_hz[0], 2 * math.pi * band_hz[1]))
    balancing = balance(part.realization, Gramians(control, observe))
    if order is None:
        r = _smallest_in_band(part.stable, part.realization, balancing, band_hz, part.tolerance)
    else:
        r = part.chosen_order(np.arange(balancing.rank + 1), lambda k: math.inf)
    reduced = balancing.truncated(part.realization, r)
    return part.result("band-limited truncation", reduced, balancing.sigma, None)


def modal_truncation(
    system: System,
    order: int | None = None,
    tolerance: float | None = None,
    *,
    keep_statics: bool = False,
    unstable: Unstable = "refuse",
) -> ReducedSystem:
    """The poles of lowest modulus, conjugate pairs whole (Davison 1966; Eq. 46 of BaniHani & De 2009).

    keep_statics  add the static response of the dropped poles to D
    tolerance     bound over the largest |G|, sampled at the resonances and at 0

    The bound is the sum of |c_k b_k^T| / |Re lambda_k| over the dropped poles, with and without their statics.
    Raises ReductionError where A has no well-conditioned basis of eigenvectors.
    """
    if isinstance(system, LinearSystem):
        system = system.explicit  # its eigenvectors are needed all the same, however large it is
    part = prepare(system, order, tolerance, unstable)
    stable = part.stable
    if isinstance(stable, LinearSystem):
        stable = diagonalize(stable.a, stable.b, stable.c, stable.d)
    ascending = np.argsort(np.abs(stable.poles), kind="stable")
    stable = stable.take(ascending)
    sizes = np.where(stable.is_pair, 2, 1)
    share = sizes * np.linalg.norm(stable.b, axis=1) * np.linalg.norm(stable.c, axis=0)
    share /= -stable.poles.real
    states = np.concatenate([[0], np.cumsum(sizes)])
    bounds = np.concatenate([np.cumsum(share[::-1])[::-1], [0.0]])  # of keeping the first k poles

    if order is None:
        sampled = np.concatenate([[0.0], stable.poles.imag])
        scale = float(np.max(spectral_norms(stable.transfer(1j * sampled))))
        kept = int(np.argmax(bounds <= part.tolerance * scale))
    else:
        kept = int(np.searchsorted(states, order - part.n_unstable, side="right")) - 1
    reduced = stable.take(np.arange(kept))
    d = reduced.d + (stable.static_gain() - reduced.static_gain() if keep_statics else 0)
    form = real_form(reduced)
    plain = LinearSystem(form.apply(np.eye(reduced.n_states)), form.b, form.c, d)
    name = "modal truncation with residual statics" if keep_statics else "modal truncation"
    return part.result(name, plain, np.zeros(0), float(bounds[kept]))


@dataclass(frozen=True)
class Prepared:
    """The stable part of a system, the rest of it, and the size that is asked for."""

    stable: System
    rest: LinearSystem | None
    order: int | None
    tolerance: float

    @property
    def realization(self) -> Realization:
        return real_form(self.stable) if isinstance(self.stable, DiagonalSystem) else self.stable

    @property
    def n_unstable(self) -> int:
        return 0 if self.rest is None else self.rest.n_states

    def gramians(self) -> Gramians:
        """Of the stable part: by displacement structure, by Hammarling's method, or low-rank, as it is given."""
        stable = self.stable
        if isinstance(stable, DiagonalSystem):
            return gramians(stable, _GRAMIAN_TOLERANCE)
        if not stable.is_sparse:
            return Gramians(*gramian_factors(stable))
        e = stable.e
        try:
            control = low_rank_factor(stable.a, e, stable.b)
            transposed = None if e is None else e.T
            observe = low_rank_factor(stable.a.T, transposed, np.ascontiguousarray(stable.c.T))
        except NotConvergedError as error:
            raise ReductionError(str(error)) from error
        sigma = np.linalg.svd(observe.T @ stable.mass(control), compute_uv=False)
        # An estimate: the singular values that the iteration has not seen count as the last that it has.
        last = float(sigma[-1]) if len(sigma) else 0.0
        return Gramians(control, observe, (stable.n_states - len(sigma)) * last)

    def chosen_order(self, orders: NDArray[np.intp], relative_bound: Callable[[int], float]) -> int:
        """Order of the stable part, of those given (from 0, ascending): the largest of at most what is asked, or the
        first whose bound is in the tolerance.
        """
        if self.order is not None:
            return int(orders[orders <= self.order - self.n_unstable][-1])
        for r in orders.tolist():
            if relative_bound(r) <= self.tolerance:
                return int(r)
        last = int(orders[-1])
        raise ReductionError(
            f"tolerance = {self.tolerance:g}: {relative_bound(last):.2g} at order {last} is the least above round-off"
        )

    def result(self, method: str, reduced: LinearSystem, sigma: Array, bound: float | None) -> ReducedSystem:
        """The reduced stable part with the rest of the system, checked to be stable."""
        if not reduced.spectral_abscissa < 0:
            raise ReductionError(
                f"{method} to {reduced.n_states} states has a spectral abscissa of {reduced.spectral_abscissa:.3g} 1/s, "
                "expected below 0: choose another order"
            )
        if bound is not None:
            self._check_bound(method, reduced, bound)
        whole = reduced if self.rest is None else parallel(reduced, self.rest)
        return ReducedSystem(method, whole, sigma, bound)

    def _check_bound(self, method: str, reduced: LinearSystem, bound: float) -> None:
        """At the resonances of very lightly damped poles. A large sparse system has none: its Gramians would not do."""
        if isinstance(self.stable, LinearSystem) and self.stable.is_sparse:
            return
        poles = np.concatenate([self.stable.poles, reduced.poles])
        narrow = poles[(poles.imag > 0) & (-poles.real < _LIGHTLY_DAMPED * poles.imag)]
        if not len(narrow):
            return
        full = self.stable.transfer(1j * narrow.imag)
        error = float(np.max(spectral_norms(full - reduced.transfer(1j * narrow.imag))))
        round_off = 1e-13 * float(np.max(narrow.imag / -narrow.real) * np.max(spectral_norms(full)))
        if not error <= bound + round_off:
            raise ReductionError(
                f"{method} to {reduced.n_states} states has an error of {error:.3g} at a resonance, expected at most "
                f"{bound:.3g}: the system is too lightly damped for double precision there, choose another order"
            )


def prepare(system: System, order: int | None, tolerance: float | None, unstable: Unstable) -> Prepared:
    """Check the arguments and set the unstable part aside. Raises ValueError and ReductionError."""
    if (order is None) == (tolerance is None):
        raise ValueError(f"order = {order} and tolerance = {tolerance}: expected exactly one of them")
    if tolerance is not None and not 0 < tolerance < math.inf:
        raise ValueError(f"tolerance = {tolerance}: expected a number above 0")
    if order is not None and not isinstance(order, int | np.integer):
        raise ValueError(f"order = {order!r}: expected a whole number of states")
    if unstable not in ("refuse", "split"):
        raise ValueError(f"unstable = {unstable!r}: expected 'refuse' or 'split'")
    stable, rest = _stable_part(system, unstable)
    least = 0 if rest is None else rest.n_states
    if order is not None and order < max(1, least):
        raise ValueError(f"order = {order}: expected at least {max(1, least)}, {least} of them not stable")
    return Prepared(stable, rest, order, math.inf if tolerance is None else tolerance)


def _stable_part(system: System, unstable: Unstable) -> tuple[System, LinearSystem | None]:
    if isinstance(system, LinearSystem):
        if system.is_sparse and system.n_states > DENSE_STATES:
            return _large(system, unstable), None
        system = system.explicit
    abscissa = system.spectral_abscissa
    if abscissa < (-system.pole_round_off if isinstance(system, LinearSystem) else 0):
        return system, None
    if unstable == "refuse":
        raise ReductionError(
            f"the system is not stable: its spectral abscissa is {abscissa:.3g} 1/s, expected below 0 by more than round-off "
            "(unstable='split' sets the unstable part aside)"
        )
    if isinstance(system, LinearSystem):
        return split(system)
    decaying = system.poles.real < 0
    rest = real_form(system.take(~decaying))
    a = rest.apply(np.eye(len(rest.decay)))
    return system.take(decaying), LinearSystem(a, rest.b, rest.c, np.zeros_like(system.d))


def _large(system: LinearSystem, unstable: Unstable) -> LinearSystem:
    """The sparse system itself, no obvious pole of which is unstable: its low-rank Gramians are the proof."""
    if unstable == "split":
        raise ReductionError(
            f"unstable = 'split' with a sparse system of {system.n_states} states: expected a dense one, or at most "
            f"{DENSE_STATES} states"
        )
    poles = system.outlying_poles
    wrong = poles[~(poles.real < -_AXIS * np.abs(poles))]
    if len(wrong):
        raise ReductionError(
            f"the system is not stable: it has a pole at {wrong[np.argmax(wrong.real)]:.6g} 1/s, expected real parts below "
            "0 by more than round-off"
        )
    return system


def _band_factor(system: System, band: tuple[float, float]) -> Array:
    """(n, k): factor of the controllability Gramian limited to the band (rad/s), by quadrature over the frequency."""
    if isinstance(system, DiagonalSystem):
        return band_controllability_factor(system, band)
    omega, weight = band_quadrature(band, system.outlying_poles if system.is_sparse else system.poles)
    columns = system.solutions(1j * omega) * np.sqrt(weight / np.pi)[:, None, None]
    stacked = np.concatenate([columns.real, columns.imag])
    return stacked.transpose(1, 0, 2).reshape(system.n_states, len(stacked) * system.n_inputs)


def _smallest_in_band(
    system: System,
    realization: Realization,
    balancing: Balancing,
    band_hz: tuple[float, float],
    tolerance: float,
) -> int:
    if balancing.rank == 0:
        return 0  # the response is D in the whole band
    lossless = balancing.truncated(realization, balancing.rank)
    omega = frequencies_near(system.poles if isinstance(system, DiagonalSystem) else lossless.poles, band_hz)
    full = system.transfer(1j * omega)
    best = (math.inf, 0)

    def attempt(order: int) -> bool | None:
        nonlocal best
        reduced = balancing.truncated(realization, order)
        error = float(np.max(relative_errors(full, reduced.transfer(1j * omega))))
        best = min(best, (error, order))
        return True if error <= tolerance and reduced.spectral_abscissa < 0 else None

    found = smallest_order(np.arange(1, balancing.rank + 1), attempt)
    if found is None:
        raise ReductionError(
            f"tolerance = {tolerance:g}: band-limited truncation reaches {best[0]:.2g} in {band_hz[0]:g}-{band_hz[1]:g} Hz "
            f"at best, at order {best[1]}"
        )
    return found[0]
