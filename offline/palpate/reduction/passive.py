"""Passive reduction of a patch model: Ritz modes in the band, damped second-order terms fitted above it.

With the static stiffness K_s the force of a symmetric body is

    F(s) = h K_s + sum_k b_k b_k^T / mu_k  h s² / (s² + mu_k h),

a sum of terms each of which is a spring and a mass in series: F(s)/s is positive real. The reduced model keeps this form.

1. The modes are those of a block Krylov subspace at zero frequency (load-dependent Ritz vectors: Wilson, Yuan & Dickens
   1982; block Lanczos), the fewest that are true in the band. The ones up to a little above the band are kept whole.
2. Above them a body has thousands of overlapping modes and the subspace has a few, whose resonances stand out. They are
   replaced by damped terms R_k s² w_k² / (s² + 2 zeta_k w_k s + w_k²) with prescribed poles and R_k symmetric positive
   semidefinite: a spring, a mass and a dashpot in series, again positive real. In the band it is the mass that counts.
   The R_k are fitted to the full model, smoothed above the band (`smoothed_response`), by nonnegative least squares
   from 0 Hz to half the sampling rate: with a prescribed denominator the fit is convex (Coelho, Phillips & Silveira 2004). Directions are added where they lower
   the residual most (column generation).

So the model is passive whatever the fit gives, and its statics are exact. The fit is made to the model as it runs, each
term sampled, and the sampling rule keeps a passive term passive.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cholesky, solve_triangular
from scipy.optimize import nnls

from palpate.lti.errors import ReductionError
from palpate.lti.frequencies import band_frequencies, relative_errors, smoothed_response, spectral_norms
from palpate.lti.pole_residue import PoleResidueSystem
from palpate.lti.sampling import Sampling
from palpate.lti.viscoelastic import viscoelastic_system
from palpate.modes.elastic_modes import ElasticModes
from palpate.reduction.methods import Reduction, check_stability
from palpate.scene.material import PronySeries

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

_KEPT_UP_TO = (1.4, 2.0, 2.8)
"""Elastic frequency of the last mode kept, over the band's end: the first that keeps to the tolerance."""

_MOST_BLOCKS = 120
"""Krylov blocks, a vector for each input: 40 carry the liver's band."""

_SHARE_OF_THE_MODES = 0.4
"""Of the tolerance, for the error of the Ritz modes before anything is fitted."""

_DAMPING, _MOST_DAMPING, _FULLY_DAMPED = 0.05, 0.25, 5.0
"""Damping ratio of the fitted terms at the last kept mode, at `_FULLY_DAMPED` times its frequency, and beyond."""

_LIGHTER = 0.4
"""Every fitted frequency has a second term, of so much of the damping: tissue loses less in the band than the first."""

_ERROR_IN_BAND, _ERROR_ABOVE = 0.001, 0.3
"""Relative errors that weigh alike in the fit."""

_STIFFER_COUNTS = 5
"""Above the band a relative error counts with this power of |F_fit| / |F|: too soft is harmless, too stiff is not."""

_ROUNDS = 16


@dataclass(frozen=True)
class _Target:
    """What the fit is to reach: F = fixed + sum_k R_k term_k at frequencies omega.

    full, fixed (n, m, m), terms (n, n_terms); in_band (n,)
    """

    full: Complex
    fixed: Complex
    terms: Complex
    in_band: NDArray[np.bool_]


def passive(
    full: PoleResidueSystem,
    subspace: RitzSubspace,
    prony: PronySeries,
    sampling: Sampling,
    *,
    order: int | None = None,
    tolerance: float | None = None,
) -> Reduction:
    """The passive model of at most `order` states, or one that keeps the error in the band; see the module's text.

    full       the viscoelastic system of the modes that the subspace is made of
    subspace   of the body; the same for every order and tolerance
    tolerance  largest over the band of |F - F_reduced| / |F|, F_reduced once sampled, a fraction
    Exactly one of order and tolerance is given.

    Raises ReductionError where the order is too small for the static stiffness, or where the tolerance is not reached.
    """
    if (order is None) == (tolerance is None):
        raise ValueError(f"order = {order} and tolerance = {tolerance}: expected exactly one of them")
    check_stability(full)
    if order is not None:
        system = _of_order(order, full, subspace, prony, sampling)
    else:
        assert tolerance is not None
        system = _within(tolerance, full, subspace, prony, sampling)
    return Reduction("passive", system, np.zeros(0), None)


@dataclass(frozen=True)
class RitzSubspace:
    """Nested block Krylov subspaces of (K, M) at zero frequency, in the coordinates of the modes.

    modes      of the whole body
    stiffness  (n, n), projected on M-orthonormal vectors: the leading part is that of fewer vectors
    coupling   (n, n_inputs), the same of the input coupling
    """

    modes: ElasticModes
    stiffness: Array
    coupling: Array

    @classmethod
    def of(cls, modes: ElasticModes, most_blocks: int = _MOST_BLOCKS) -> RitzSubspace:
        """Blocks until the space is exhausted, at most `most_blocks`.

        modes  all modes of a symmetric body, or so many that they are true to half the sampling rate

        Raises ReductionError where the body is not symmetric.
        """
        if not (
            np.isrealobj(modes.squared_frequencies)
            and np.array_equal(modes.output_coupling, modes.input_coupling.T)
        ):
            raise ReductionError(
                "passive needs a symmetric body: discretize by conservative, or use tbr-band"
            )
        mu, b = np.real(modes.squared_frequencies), np.real(modes.input_coupling)
        basis = np.zeros((len(mu), 0))
        block = b / mu[:, None]
        for _ in range(most_blocks):
            new = _orthonormal(block, basis)
            if not new.shape[1]:
                break
            basis = np.hstack([basis, new])
            block = new / mu[:, None]
        stiffness = basis.T @ (mu[:, None] * basis)
        return cls(modes, (stiffness + stiffness.T) / 2, basis.T @ b)

    @property
    def n_blocks(self) -> int:
        return math.ceil(len(self.stiffness) / self.coupling.shape[1])

    def ritz_modes(self, n_blocks: int, below: float = math.inf) -> ElasticModes:
        """Ritz modes of the first blocks, those with frequencies below `below`, rad/s; without shapes.

        The static stiffness is the body's own: that of the modes left out is not in the direct stiffness.
        """
        n = min(n_blocks * self.coupling.shape[1], len(self.stiffness))
        mu, vectors = np.linalg.eigh(self.stiffness[:n, :n])
        b = vectors.T @ self.coupling[:n]
        mu, b = mu[mu < below**2], b[mu < below**2]
        direct = self.modes.static_stiffness + b.T @ (b / mu[:, None])
        nowhere = np.zeros((0, len(mu))), np.zeros((0, b.shape[1]))
        return ElasticModes(mu, b, b.T, (direct + direct.T) / 2, *nowhere)


def _orthonormal(block: Array, basis: Array) -> Array:
    """An orthonormal basis of what the block (n, k) adds to the orthonormal basis; directions below 1e-10 are dropped."""
    block = block / np.maximum(np.linalg.norm(block, axis=0), np.finfo(np.float64).tiny)
    for _ in range(2):  # twice is enough (Parlett 1980)
        block = block - basis @ (basis.T @ block)
    left, sigma, _ = np.linalg.svd(block, full_matrices=False)
    left = left[:, sigma > 1e-10]
    left = left - basis @ (basis.T @ left)
    return np.asarray(np.linalg.qr(left)[0])


def _of_order(
    order: int, full: PoleResidueSystem, subspace: RitzSubspace, prony: PronySeries, sampling: Sampling
) -> PoleResidueSystem:
    """The model of about the most blocks that has at most `order` states."""
    below = 2 * np.pi * sampling.band_hz[1] * _KEPT_UP_TO[0]

    def kept(n_blocks: int) -> PoleResidueSystem:
        return viscoelastic_system(subspace.ritz_modes(n_blocks, below), prony)

    n_terms = 0  # states of the fitted terms: known after a fit, and much the same for other blocks
    while True:
        possible = range(subspace.n_blocks + 1)
        n_blocks = bisect_right(possible, order - n_terms, key=lambda n: kept(n).n_states) - 1
        if n_blocks < 0:
            raise ReductionError(
                f"order = {order}: passive needs at least {kept(0).n_states + n_terms} states here for the static "
                "stiffness and what lies above the band"
            )
        chosen = kept(n_blocks)
        system = with_fitted_terms(full, chosen, below, sampling)
        if system.n_states <= order:
            return system
        n_terms = max(system.n_states - chosen.n_states, n_terms + 1)


def _within(
    tolerance: float, full: PoleResidueSystem, subspace: RitzSubspace, prony: PronySeries, sampling: Sampling
) -> PoleResidueSystem:
    """The model of the fewest blocks whose modes are true enough, with the fewest modes kept that keep to the tolerance."""
    omega = band_frequencies((full,), sampling.band_hz)
    exact = full.transfer(1j * omega)
    n_blocks = 1
    while n_blocks < subspace.n_blocks:
        ritz = viscoelastic_system(subspace.ritz_modes(n_blocks), prony)
        if np.max(relative_errors(exact, ritz.transfer(1j * omega))) <= _SHARE_OF_THE_MODES * tolerance:
            break
        n_blocks += max(1, n_blocks // 12)
    best = math.inf
    for factor in _KEPT_UP_TO:
        below = 2 * np.pi * sampling.band_hz[1] * factor
        kept = viscoelastic_system(subspace.ritz_modes(n_blocks, below), prony)
        system = with_fitted_terms(full, kept, below, sampling)
        # Between the samples only the reduced model's own resonances can stand out.
        own = band_frequencies((system,), sampling.band_hz)
        error = max(
            float(np.max(relative_errors(exact, sampling.response(system, omega)))),
            float(np.max(relative_errors(full.transfer(1j * own), sampling.response(system, own)))),
        )
        if error <= tolerance:
            return system
        best = min(best, error)
    low, high = sampling.band_hz
    raise ReductionError(
        f"tolerance = {tolerance:g}: passive reaches {best:.2g} in {low:g}-{high:g} Hz at best"
    )


def with_fitted_terms(
    full: PoleResidueSystem, kept: PoleResidueSystem, above: float, sampling: Sampling
) -> PoleResidueSystem:
    """The kept modes and damped terms from `above`, rad/s, on, fitted to the full system.

    Poles of the full system beyond the sampling rate are out of reach: no term stands for them.
    """
    fastest = float(np.max(np.abs(full.poles)))
    poles = _candidates(above, min(1.3 * np.pi / sampling.period_s, 1.3 * fastest))
    if not len(poles):
        return kept
    omega = _fit_frequencies(full, sampling)
    terms = np.stack([sampling.response(_term(pole, np.eye(1)), omega)[:, 0, 0] for pole in poles], axis=1)
    band_end = 2 * np.pi * sampling.band_hz[1]
    target = _Target(
        smoothed_response(full, omega, band_end),
        sampling.response(kept, omega),
        terms,
        omega <= band_end,
    )
    systems = [kept, *(_term(p, r) for p, r in zip(poles, _fitted(target), strict=True) if np.any(r))]
    return PoleResidueSystem(
        np.concatenate([s.poles for s in systems]),
        np.concatenate([s.b for s in systems]),
        np.concatenate([s.c for s in systems], axis=1),
        np.sum([s.d for s in systems], axis=0),
    )


def _candidates(start: float, stop: float) -> Complex:
    """(n,), 1/s: poles as far apart as they are damped, so that neighbors overlap; and lighter ones at the same places."""
    frequency, places, ratios = start, [], []
    while frequency < stop:
        share = min(1.0, math.log(frequency / start) / math.log(_FULLY_DAMPED))
        ratio = _DAMPING * (_MOST_DAMPING / _DAMPING) ** share
        places.append(frequency)
        ratios.append(ratio)
        frequency *= math.exp(ratio)
    w, zeta = np.tile(places, 2), np.concatenate([ratios, _LIGHTER * np.array(ratios)])
    return np.asarray(w * (-zeta + 1j * np.sqrt(1 - zeta**2)), dtype=np.complex128)


def _term(pole: complex, residue: Array) -> PoleResidueSystem:
    """R s² w² / (s² + 2 zeta w s + w²), over w²: poles w (-zeta +- j sqrt(1 - zeta²)), R (m, m) positive semidefinite."""
    values, vectors = np.linalg.eigh(residue)
    large = values > 1e-6 * values[-1]
    b = np.sqrt(pole**2 / (2j * pole.imag) * values[large])[:, None] * vectors[:, large].T
    return PoleResidueSystem(
        np.full(len(b), pole),
        b,
        np.ascontiguousarray(b.T),
        (vectors[:, large] * values[large]) @ vectors[:, large].T,
    )


def _fit_frequencies(full: PoleResidueSystem, sampling: Sampling) -> Array:
    """(n,), rad/s, ascending: even and logarithmic in the band, and above to half the sampling rate or the fastest pole."""
    end = 2 * np.pi * sampling.band_hz[1]
    top = min(0.998 * np.pi / sampling.period_s, max(3 * float(np.max(np.abs(full.poles))), 4 * end))
    slowest = min(float(np.min(full.poles.imag[full.is_pair], initial=end)), end)
    in_band = [np.linspace(0, end, 151)[1:], np.geomspace(slowest / 3, end, 50)]
    above = [np.linspace(end, top, 900), np.geomspace(end, top, 125)]
    return np.unique(np.concatenate([*in_band, *above]))


def _fitted(target: _Target) -> Array:
    """(n_terms, m, m): symmetric positive semidefinite R_k by nonnegative least squares over directions R = x d d^T.

    Each round fits, adds to every term the direction in which the residual falls most, drops those at zero and sets the
    weights anew. With D the directions, <term_k d d^T, term_l e e^T> = Re(term_k^* term_l) (d . e)², so that no matrix
    has more rows than there are directions.
    """
    gain = spectral_norms(target.full)
    wanted = target.full - target.fixed
    base = (
        np.where(
            target.in_band,
            1 / _ERROR_IN_BAND**2 / np.sum(target.in_band),
            1 / _ERROR_ABOVE**2 / np.sum(~target.in_band),
        )
        / gain**2
    )
    n_terms, m = target.terms.shape[1], wanted.shape[1]
    which = np.repeat(np.arange(n_terms), m)
    axes = np.linalg.eigh(np.real(wanted[-1] + wanted[-1].T))[1]
    directions = np.tile(axes.T, (n_terms, 1))
    weight = base
    for _ in range(_ROUNDS):
        gram = np.real((target.terms.conj() * weight[:, None]).T @ target.terms)
        moments = np.real(np.tensordot(target.terms.conj() * weight[:, None], wanted, axes=(0, 0)))
        moments = (moments + moments.transpose(0, 2, 1)) / 2
        x = _nonnegative(gram, moments, which, directions)
        used = x > 0
        which, directions, x = which[used], directions[used], x[used]
        residues = np.zeros((n_terms, m, m))
        np.add.at(residues, which, x[:, None, None] * directions[:, :, None] * directions[:, None, :])
        stiffer = spectral_norms(target.fixed + np.tensordot(target.terms, residues, axes=(1, 0))) / gain
        # The geometric mean with the last weights damps an alternation between two sets of terms.
        wish = base * np.where(target.in_band, 1.0, np.clip(stiffer, 0.5, 2.0) ** (2 * _STIFFER_COUNTS))
        weight = np.sqrt(weight * wish)
        values, vectors = np.linalg.eigh(moments - np.tensordot(gram, residues, axes=(1, 0)))
        falls = values[:, -1] > 1e-4 * np.sqrt(np.diag(gram) * np.sum(base * gain**2))
        which = np.concatenate([which, np.flatnonzero(falls)])
        directions = np.vstack([directions, vectors[falls, :, -1]])
    return residues


def _nonnegative(gram: Array, moments: Array, which: NDArray[np.intp], directions: Array) -> Array:
    """(n,): x >= 0 that minimizes the weighted squared residual, by the normal equations of the directions."""
    matrix = gram[np.ix_(which, which)] * (directions @ directions.T) ** 2
    right = np.einsum("na,nab,nb->n", directions, moments[which], directions)
    scale = 1 / np.sqrt(np.diag(matrix))
    matrix = matrix * scale[:, None] * scale
    matrix[np.diag_indices_from(matrix)] += 1e-12 * len(matrix)  # of directions that nearly coincide
    upper = cholesky(matrix)
    x, _ = nnls(upper, solve_triangular(upper, right * scale, trans="T"), maxiter=30 * len(matrix))
    return np.asarray(x * scale)
