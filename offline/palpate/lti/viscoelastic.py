"""The exact linear time-invariant system of a viscoelastic body, from its elastic modes and a Prony series.

With h(s) = N(s) / P(s), P = prod_j (1 + s tau_j), the force of `ElasticModes` splits (h/mu - h²/(s² + mu h) is
h s² / (mu (s² + mu h))) into the relaxation of the static stiffness and one small block a mode:

    F(s) = h(s) K_static + sum_k c_k b_k^T / mu_k  N(s) s² / (s² P(s) + mu_k N(s)).

So the poles are -1/tau_j, once a contact channel, and the M + 2 roots of s² P + mu_k N for each of the modes (Eq. 7-9
and 23-29 of BaniHani & De 2009, with the internal variables kept as states); D = h(infinity) K_tt.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.polynomial import polynomial
from numpy.typing import NDArray

from palpate.lti.pole_residue import PoleResidueSystem, phases
from palpate.modes.elastic_modes import ElasticModes
from palpate.scene.material import PronySeries

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]
RealOrComplex = NDArray[Any]

_SYMMETRY_TOLERANCE = 1e-10  # of the largest entry: what a symmetric computation leaves by round-off


def viscoelastic_system(modes: ElasticModes, prony: PronySeries) -> PoleResidueSystem:
    """The system from patch displacement (m) to reaction force (N), with all memory states.

    Group 0 of the poles is the relaxation of the static stiffness, groups 1, 2, ... are the modes by ascending |mu|. Of a
    conjugate pair of complex mu one is kept. Where the body is symmetric (K_tt = K_tt^T, c = b^T), so is
    the realization: C = B^T.

    Raises ValueError where a squared frequency is zero (the body is not held) or not finite, or lacks its conjugate,
    or where two poles of a mode coincide (critical damping).
    """
    mu, b, c = _half_of_conjugates(modes)
    symmetric = (
        np.isrealobj(mu)
        and _nearly_equal(modes.output_coupling, modes.input_coupling.T)
        and _nearly_equal(modes.direct_stiffness, modes.direct_stiffness.T)
    )
    if symmetric:
        c = b.T
    static = modes.static_stiffness
    direct = modes.direct_stiffness
    if symmetric:
        static, direct = (static + static.T) / 2, (direct + direct.T) / 2

    relaxation, stress = _prony_polynomials(prony)
    poles = mode_poles(mu, prony)
    residues = _residues(poles, mu, relaxation, stress)
    if not np.all(np.isfinite(residues)):
        worst = int(np.argmax(~np.all(np.isfinite(residues), axis=1)))
        raise ValueError(
            f"two poles of the mode with squared frequency {mu[worst]:.17g} coincide: change a time constant by 1e-6"
        )
    roots_of_residues = np.sqrt(residues)
    n_modes, per_mode = poles.shape
    poles_b = (roots_of_residues[:, :, None] * b[:, None, :]).reshape(n_modes * per_mode, b.shape[1])
    poles_c = (roots_of_residues[:, :, None] * c.T[:, None, :]).reshape(n_modes * per_mode, b.shape[1])
    poles = poles.reshape(-1)
    group = np.repeat(np.arange(1, n_modes + 1), per_mode)

    # A real mode's roots come with their conjugates: keep the upper ones. A complex mode stands for two, so all of
    # its roots are kept, mirrored to the upper half plane.
    from_real_mode = np.repeat(mu.imag == 0, per_mode)
    kept = ~(from_real_mode & (poles.imag < 0))
    mirrored = poles.imag < 0
    poles = np.where(mirrored, poles.conj(), poles)[kept]
    poles_b = np.where(mirrored[:, None], poles_b.conj(), poles_b)[kept]
    poles_c = np.where(mirrored[:, None], poles_c.conj(), poles_c)[kept]

    static_poles, static_b, static_c = _relaxation(static, symmetric, prony)
    return PoleResidueSystem(
        poles=np.concatenate([static_poles, poles]),
        b=np.concatenate([static_b, poles_b]),
        c=np.ascontiguousarray(np.concatenate([static_c, poles_c]).T),
        d=prony.instant_factor * direct,
        group=np.concatenate([np.zeros(len(static_poles), dtype=np.int64), group[kept]]),
    )


def _relaxation(static: Array, symmetric: bool, prony: PronySeries) -> tuple[Complex, Complex, Complex]:
    """Poles (n,), 1/s, and rows b, c (n, n_channels) of the relaxation of the static stiffness, branch by branch."""
    left, gains, right = _split(static, symmetric)
    gamma_over_tau = np.divide(prony.gamma, prony.tau_s)
    roots = np.sqrt(-gamma_over_tau[:, None] * gains.astype(np.complex128)).ravel()
    poles = np.repeat(-1 / np.asarray(prony.tau_s, dtype=np.complex128), len(gains))
    n_branches = len(prony.tau_s)
    return (
        poles,
        roots[:, None] * np.tile(right, (n_branches, 1)),
        roots[:, None] * np.tile(left.T, (n_branches, 1)),
    )


def _half_of_conjugates(
    modes: ElasticModes,
) -> tuple[RealOrComplex, RealOrComplex, RealOrComplex]:
    """(mu, b, c), ascending in |mu|, one of each conjugate pair; b and c of a real mode are real."""
    mu = modes.squared_frequencies
    if not np.all(np.isfinite(mu)):
        raise ValueError("squared_frequencies holds values that are not finite")
    if np.any(mu == 0):
        raise ValueError(
            f"squared_frequencies[{int(np.argmax(mu == 0))}] = 0: the body moves freely, expected one that "
            "its supports and contact patches hold"
        )
    if np.isrealobj(mu):
        kept = np.argsort(np.abs(mu), kind="stable")
        b, c = np.real(modes.input_coupling)[kept], np.real(modes.output_coupling)[:, kept]
        return mu[kept], b.astype(np.complex128), c.astype(np.complex128)
    upper, lower = mu[mu.imag > 0], mu[mu.imag < 0]
    if len(upper) != len(lower) or not np.allclose(
        np.sort_complex(upper), np.sort_complex(lower.conj()), rtol=1e-8, atol=0
    ):
        raise ValueError(
            f"squared_frequencies has {len(upper)} complex values above and {len(lower)} below the real axis: "
            "expected conjugate pairs"
        )
    kept = np.flatnonzero(mu.imag >= 0)
    kept = kept[np.argsort(np.abs(mu[kept]), kind="stable")]
    mu = mu[kept]
    b = modes.input_coupling[kept].astype(np.complex128)
    c = modes.output_coupling[:, kept].astype(np.complex128)
    # The eigenvectors of a real mode have an arbitrary complex factor, c b^T has none: divide it out.
    real = mu.imag == 0
    phase = np.where(real, phases(np.asarray(b, dtype=np.complex128)), 1)
    b, c = b / phase[:, None], c * phase
    b[real], c[:, real] = b[real].real, c[:, real].real
    return mu, b, c


def _prony_polynomials(prony: PronySeries) -> tuple[Array, Array]:
    """P = prod_j (1 + s tau_j) and N = h P, coefficients by ascending power, each (M + 1,)."""
    relaxation: RealOrComplex = np.ones(1)
    for tau in prony.tau_s:
        relaxation = polynomial.polymul(relaxation, [1.0, tau])
    stress: RealOrComplex = relaxation.copy()
    for j, gamma in enumerate(prony.gamma):
        term: RealOrComplex = np.array([0.0, gamma * prony.tau_s[j]])
        for i, tau in enumerate(prony.tau_s):
            if i != j:
                term = polynomial.polymul(term, [1.0, tau])
        stress = polynomial.polyadd(stress, term)
    return relaxation, stress


def mode_poles(mu: RealOrComplex, prony: PronySeries) -> Complex:
    """(n_modes, M + 2), 1/s: the roots of s² P + mu N for squared frequencies mu (n_modes,), (rad/s)²; mu = 0 is allowed.

    Companion eigenvalues, polished by Newton's method. The roots of a real mu are exactly real or in exact
    conjugate pairs, because all steps are the same for a root's conjugate.
    """
    relaxation, stress = _prony_polynomials(prony)
    degree = len(relaxation) + 1
    roots = np.empty((len(mu), degree), dtype=np.complex128)
    for of_kind in (mu.imag == 0, mu.imag != 0):
        values = mu[of_kind]
        coefficients = _characteristic(
            values.real if np.all(values.imag == 0) else values, relaxation, stress
        )
        companion = np.zeros((len(values), degree, degree), dtype=coefficients.dtype)
        companion[:, np.arange(1, degree), np.arange(degree - 1)] = 1.0
        companion[:, :, -1] = -coefficients[:, :-1] / coefficients[:, -1:]
        roots[of_kind] = _polished(coefficients, np.linalg.eigvals(companion).astype(np.complex128))
    return roots


def _polished(coefficients: RealOrComplex, roots: Complex) -> Complex:
    """Newton's method from the roots (n, degree), where a step makes the polynomial smaller."""
    slopes = coefficients[:, 1:] * np.arange(1, coefficients.shape[1])
    value = _evaluate(coefficients, roots)
    for _ in range(4):
        slope = _evaluate(slopes, roots)
        trial = roots - np.where(slope != 0, value / np.where(slope != 0, slope, 1), 0)
        trial_value = _evaluate(coefficients, trial)
        better = np.abs(trial_value) < np.abs(value)
        roots, value = np.where(better, trial, roots), np.where(better, trial_value, value)
    return roots


def _residues(
    poles: Complex,
    mu: RealOrComplex,
    relaxation: Array,
    stress: Array,
) -> Complex:
    """(n_modes, M + 2): residues of N s² / (mu (s² P + mu N)) at its poles."""
    coefficients = _characteristic(mu, relaxation, stress)
    slope = _evaluate(coefficients[:, 1:] * np.arange(1, coefficients.shape[1]), poles)
    # At a pole mu N = -s² P: the numerator is computed from the side with less cancellation.
    by_stress, by_relaxation = polynomial.polyval(poles, stress), polynomial.polyval(poles, relaxation)
    condition_stress = polynomial.polyval(np.abs(poles), stress) * np.abs(by_relaxation)
    condition_relaxation = polynomial.polyval(np.abs(poles), relaxation) * np.abs(by_stress)
    numerator = np.where(
        condition_stress < condition_relaxation, by_stress, -(poles**2) * by_relaxation / mu[:, None]
    )
    return numerator * poles**2 / (mu[:, None] * slope)


def _characteristic(
    mu: RealOrComplex,
    relaxation: Array,
    stress: Array,
) -> RealOrComplex:
    """(n_modes, M + 3): coefficients of s² P + mu N by ascending power."""
    coefficients = np.zeros((len(mu), len(relaxation) + 2), dtype=mu.dtype)
    coefficients[:, 2:] = relaxation
    coefficients[:, : len(stress)] += mu[:, None] * stress
    return coefficients


def _evaluate(coefficients: RealOrComplex, points: Complex) -> Complex:
    """(n, k): polynomial i (coefficients (n, degree + 1), ascending) at points (n, k), by Horner's rule."""
    value = np.zeros_like(points)
    for power in range(coefficients.shape[1] - 1, -1, -1):
        value = value * points + coefficients[:, power, None]
    return value


def _split(matrix: Array, symmetric: bool) -> tuple[Array, Array, Array]:
    """left, gains, right with matrix = left diag(gains) right; right = left^T where the matrix is symmetric."""
    if symmetric:
        gains, left = np.linalg.eigh(matrix)
        return left, gains, left.T
    left, gains, right = np.linalg.svd(matrix, full_matrices=False)
    return left, gains, right


def _nearly_equal(a: RealOrComplex, b: RealOrComplex) -> bool:
    if a.shape != b.shape:
        return False
    scale = max(float(np.max(np.abs(a), initial=0)), float(np.max(np.abs(b), initial=0)))
    return float(np.max(np.abs(a - b), initial=0)) <= _SYMMETRY_TOLERANCE * scale
