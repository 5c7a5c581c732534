"""Reductions against dense Lyapunov solutions, pyMOR and SLICOT, and against their own guarantees."""

import ctrlsys
import numpy as np
import pytest
import scipy.linalg
from pymor.models.iosys import LTIModel
from pymor.reductors.bt import BTReductor

from palpate.lti.frequencies import band_frequencies
from palpate.lti.pole_residue import PoleResidueSystem
from palpate.lti.viscoelastic import viscoelastic_system
from palpate.modes.elastic_modes import ElasticModes
from palpate.reduction import METHODS, ReductionError, reduce
from palpate.reduction.accuracy import hinf_error, in_band_error
from palpate.reduction.gramians import (
    band_controllability_factor,
    band_quadrature,
    gramian_factor,
    gramians,
    real_form,
)
from palpate.scene.material import PronySeries

LIVER_LIKE = PronySeries((0.5, 0.3), (0.58, 0.004))
BAND_HZ = (0.0, 2.0)


def body(seed, n_modes=12, n_inputs=3, skew=0.0, prony=LIVER_LIKE):
    """The system of a body with a random stiffness; nonsymmetric, with some complex modes, where skew > 0."""
    rng = np.random.default_rng(seed)
    n = n_modes + n_inputs
    root, other = rng.standard_normal((n, n)), rng.standard_normal((n, n))
    stiffness = 30 * (root @ root.T + 0.3 * np.eye(n) + skew * (other - other.T))
    k_ff, k_ft, k_tf = (
        stiffness[:n_modes, :n_modes],
        stiffness[:n_modes, n_modes:],
        stiffness[n_modes:, :n_modes],
    )
    if skew == 0:
        mu, shapes = np.linalg.eigh(k_ff)
        inverse = shapes.T
    else:
        mu, shapes = np.linalg.eig(k_ff)
        inverse = np.linalg.inv(shapes)
    nowhere = np.zeros((3, n_modes)), np.zeros((3, n_inputs))
    direct = stiffness[n_modes:, n_modes:]
    return viscoelastic_system(ElasticModes(mu, inverse @ k_ft, k_tf @ shapes, direct, *nowhere), prony)


def dense(system):
    """A, B, C, D of the system in real coordinates."""
    form = real_form(system)
    return form.apply(np.eye(system.n_states)), form.b, form.c, system.d


CASES = [
    pytest.param({"seed": 0}, id="symmetric"),
    pytest.param({"seed": 1, "skew": 0.1}, id="nonsymmetric"),
    pytest.param({"seed": 2, "n_inputs": 1}, id="one channel"),
    pytest.param({"seed": 3, "n_inputs": 6, "skew": 0.1}, id="two contacts, nonsymmetric"),
    pytest.param({"seed": 4, "n_modes": 20, "prony": PronySeries((1.0,), (1.0,))}, id="one Prony term"),
]


@pytest.mark.parametrize("case", CASES)
def test_real_coordinates_give_the_same_transfer_function(case):
    system = body(**case)
    a, b, c, d = dense(system)
    for w in (0.0, 0.3, 40.0, 3e3):
        expected = d + c @ np.linalg.solve(1j * w * np.eye(len(a)) - a, b)
        found = system.transfer(np.array([1j * w]))[0]
        assert found == pytest.approx(expected, abs=1e-10 * np.max(np.abs(expected)))


@pytest.mark.parametrize("case", CASES)
def test_gramian_factors_solve_their_lyapunov_equations(case):
    system = body(**case)
    a, b, c, _ = dense(system)
    control_gramian = scipy.linalg.solve_continuous_lyapunov(a, -b @ b.T)
    observe_gramian = scipy.linalg.solve_continuous_lyapunov(a.T, -c.T @ c)
    found = gramians(system)
    for exact, factor in ((control_gramian, found.control), (observe_gramian, found.observe)):
        assert np.linalg.norm(factor @ factor.T - exact) < 1e-10 * np.linalg.norm(exact)
    control = gramian_factor(system, system.b)
    assert control.trace == pytest.approx(np.trace(control_gramian), rel=1e-10)
    assert control.residual <= 1e-20 * control.trace


@pytest.mark.parametrize("tolerance", [1e-2, 1e-5, 1e-8])
def test_what_a_truncated_gramian_factor_misses_is_positive_and_has_the_stated_trace(tolerance):
    system = body(5, n_modes=20)
    a, b, _, _ = dense(system)
    exact = scipy.linalg.solve_continuous_lyapunov(a, -b @ b.T)
    found = gramian_factor(system, system.b, tolerance)
    rest = exact - found.factor @ found.factor.T
    noise = 1e-11 * found.trace
    assert np.trace(rest) == pytest.approx(found.residual, abs=noise)
    assert np.min(np.linalg.eigvalsh(rest)) > -noise
    assert found.residual <= tolerance * found.trace
    assert found.factor.shape[1] < system.n_states


def test_band_limited_gramian_equals_that_of_the_matrix_logarithm():
    """Gawronski & Juang 1990: P_band = P S + S P with S = Re(j/pi log(...)) for the band 0..w."""
    system = body(6, n_modes=5, n_inputs=2)
    a, b, _, _ = dense(system)
    w = 25.0
    s = np.real(1j / np.pi * scipy.linalg.logm(-1j * w * np.eye(len(a)) - a))
    s_low = np.real(1j / np.pi * scipy.linalg.logm(-a.astype(complex)))
    s = s - s_low
    gramian = scipy.linalg.solve_continuous_lyapunov(a, -b @ b.T)
    exact = s @ gramian + gramian @ s.T
    exact = exact if np.trace(exact) > 0 else -exact
    errors = []
    for n in (120, 1000, 4000):
        factor = band_controllability_factor(system, (0.0, w), n)
        errors.append(np.linalg.norm(factor @ factor.T - exact) / np.linalg.norm(exact))
    assert errors[2] < 1e-8
    assert errors[1] < 1e-3 * errors[0]


@pytest.mark.parametrize("band", [(0.0, 7.0), (0.0, 1e-3), (2.0, 7.0), (0.05, 7.0)])
def test_band_quadrature_integrates_a_constant_and_a_relaxation(band):
    points, weights = band_quadrature(band, np.array([-0.5 + 0j]), 120)
    assert np.all((points > band[0]) & (points < band[1]))
    assert np.sum(weights) == pytest.approx(band[1] - band[0], rel=1e-13)
    relaxation = np.sum(weights / (points**2 + 0.25))
    assert relaxation == pytest.approx(2 * (np.arctan(2 * band[1]) - np.arctan(2 * band[0])), rel=1e-9)


@pytest.mark.parametrize("band", [(0.0, 7.0), (2.9, 3.1), (0.0, 3.0), (3.0001, 7.0)])
@pytest.mark.parametrize("half_width", [1e-2, 1e-4, 1e-6, 1e-9])
def test_band_quadrature_integrates_a_narrow_resonance(half_width, band):
    """1 / ((w - 3)² + a²), closed form by the arc tangent; 4 Gauss points on 1 / x² from 1 to 5 err by 0.504 %."""
    poles = np.array([-0.5, -half_width + 3j])
    points, weights = band_quadrature(band, poles)
    assert np.sum(weights) == pytest.approx(band[1] - band[0], rel=1e-12)
    found = np.sum(weights / ((points - 3) ** 2 + half_width**2))
    exact = np.diff(np.arctan((np.array(band) - 3) / half_width))[0] / half_width
    if band[0] > 3:  # off the resonance: a difference of arc tangents would cancel
        exact = (
            np.arctan2((band[1] - band[0]) * half_width, half_width**2 + (band[1] - 3) * (band[0] - 3))
            / half_width
        )
    assert found == pytest.approx(exact, rel=5.05e-3)


def test_narrow_resonances_get_a_limited_number_of_points_and_damped_ones_none():
    band, plain = (0.0, 100.0), len(band_quadrature((0.0, 100.0), np.array([-1.0 + 0j]))[0])
    imaginary = 1j * np.linspace(1, 99, 500)
    damped, narrow = (band_quadrature(band, imaginary * (1 + ratio * 1j))[0] for ratio in (0.03, 1e-6))
    assert len(damped) == plain == 120
    assert 120 < len(narrow) < 120 + 60 * 80


@pytest.mark.parametrize("case", CASES)
def test_hankel_singular_values_agree_with_pymor_and_slicot(case):
    system = body(**case)
    a, b, c, d = dense(system)
    found = reduce(system, "tbr", order=4).hankel_singular_values
    n, m, p = len(a), b.shape[1], len(c)
    by_slicot = ctrlsys.ab09ad(
        "C", "B", "S", "F", n, m, p, 4, *(np.array(x, order="F") for x in (a, b, c)), 0.0
    )[3]
    for other in (LTIModel.from_matrices(a, b, c, d).hsv(), by_slicot):
        kept = other[: len(found)] > 1e-10 * other[0]
        assert found[kept] == pytest.approx(other[: len(found)][kept], rel=1e-6)
        assert np.all(other[len(found) :] < 1e-10 * other[0])


@pytest.mark.parametrize("case", CASES)
def test_truncated_balanced_realization_equals_pymors(case):
    system = body(**case)
    order = 9
    other = BTReductor(LTIModel.from_matrices(*dense(system))).reduce(order, projection="sr")
    reduced = reduce(system, "tbr", order=order).system
    for w in (0.0, 1.0, 30.0, 1e3):
        assert reduced.transfer(np.array([1j * w]))[0] == pytest.approx(
            other.transfer_function.eval_tf(1j * w), rel=1e-7, abs=1e-7 * np.max(np.abs(system.d))
        )


@pytest.mark.parametrize("case", CASES)
def test_error_of_balanced_truncation_is_inside_the_bound_at_every_order(case):
    system = body(**case)
    largest = np.linalg.norm(system.d, 2)
    order, rank = 1, 2
    while order < rank:
        reduction = reduce(system, "tbr", order=order)
        rank = np.count_nonzero(
            reduction.hankel_singular_values > 1e-10 * reduction.hankel_singular_values[0]
        )
        error = _largest_error(system, reduction.system)
        assert error <= reduction.error_bound * (1 + 1e-6) + 1e-9 * largest
        order += 3


def _largest_error(system, reduced):
    omega = np.concatenate([[0.0], np.geomspace(1e-4, 1e6, 2000), system.poles.imag, reduced.poles.imag])
    difference = system.transfer(1j * omega) - reduced.transfer(1j * omega)
    return np.max(np.linalg.norm(difference, 2, axis=(1, 2)))


@pytest.mark.parametrize("skew", [0.0, 0.02])
def test_every_reduced_model_is_stable(skew):
    for seed in range(12):
        system = body(100 + seed, n_modes=10 + seed, n_inputs=1 + seed % 4, skew=skew)
        assert system.spectral_abscissa < 0
        for method in METHODS:
            for order in (9, 16, 25):
                reduced = reduce(system, method, order=order, band_hz=BAND_HZ).system
                assert reduced.spectral_abscissa < 0
                assert reduced.n_states <= order


@pytest.mark.parametrize("case", CASES)
def test_band_limited_truncation_spends_its_order_in_the_band(case):
    system = body(**case)
    omega = band_frequencies((system,), BAND_HZ)
    order = 26
    in_band = {
        method: in_band_error(system, reduce(system, method, order=order, band_hz=BAND_HZ).system, omega)
        for method in ("tbr", "tbr-band", "modal-static")
    }
    assert in_band["tbr-band"] < in_band["tbr"]
    assert in_band["tbr-band"] < in_band["modal-static"]


def test_doubling_the_quadrature_of_the_band_leaves_the_singular_values_that_count():
    system = body(7, n_modes=30)
    band = (0.0, 2 * np.pi * BAND_HZ[1])
    observe = gramians(system).observe
    sigma = [
        np.linalg.svd(observe.T @ band_controllability_factor(system, band, n), compute_uv=False)
        for n in (120, 240)
    ]
    kept = sigma[1][:20] > 1e-6 * sigma[1][0]
    assert np.count_nonzero(kept) > 8
    assert sigma[0][:20][kept] == pytest.approx(sigma[1][:20][kept], rel=1e-2)


def test_modal_truncation_keeps_whole_modes_and_the_instant_stiffness():
    system = body(8, n_modes=15)
    reduction = reduce(system, "modal", order=25)
    assert reduction.order == 6 + 4 * 4  # the relaxation of three channels, then modes of four states
    assert reduction.system.d == pytest.approx(system.d)
    kept = np.isin(system.poles, reduction.system.poles)
    assert np.array_equal(np.unique(system.group[kept]), np.arange(5))
    omega = np.geomspace(1e-3, 1e4, 2000)
    error = np.linalg.norm(system.transfer(1j * omega) - reduction.system.transfer(1j * omega), 2, (1, 2))
    assert np.max(error) <= reduction.error_bound
    assert len(reduction.hankel_singular_values) == 0


@pytest.mark.parametrize("case", CASES)
def test_residual_stiffness_makes_the_statics_of_modal_truncation_exact(case):
    system = body(**case)
    static = system.static_gain()
    with_residual = reduce(system, "modal-static", order=30).system.static_gain()
    without = reduce(system, "modal", order=30).system.static_gain()
    assert with_residual == pytest.approx(static, abs=1e-10 * np.max(np.abs(static)))
    assert np.max(np.abs(without - static)) > 1e-3 * np.max(np.abs(static))


@pytest.mark.parametrize("method", METHODS)
def test_a_tolerance_is_kept_and_the_next_smaller_order_misses_it(method):
    system = body(9, n_modes=15)
    tolerance = 0.05
    reduction = reduce(system, method, tolerance=tolerance, band_hz=BAND_HZ)
    omega = band_frequencies((system, reduction.system), BAND_HZ)
    assert in_band_error(system, reduction.system, omega) <= tolerance * 1.01
    smaller = reduce(system, method, order=reduction.order - 1, band_hz=BAND_HZ)
    assert in_band_error(system, smaller.system, omega) > tolerance


def test_a_lossless_order_reproduces_the_system():
    system = body(10)
    assert reduce(system, "tbr", order=10_000).order <= system.n_states
    assert hinf_error(system, reduce(system, "tbr", order=10_000).system) < 1e-10


def test_a_tolerance_out_of_reach_is_an_error_that_says_what_is_reached():
    with pytest.raises(ReductionError, match=r"tolerance = 1e-16: tbr-band reaches .* at order"):
        reduce(body(11), "tbr-band", tolerance=1e-16, band_hz=BAND_HZ)


def test_a_purely_elastic_body_is_refused_with_that_reason():
    for method in METHODS:
        with pytest.raises(ReductionError, match=r"purely elastic.*Prony"):
            reduce(body(12, prony=PronySeries()), method, order=4)


def test_an_unstable_body_is_refused_with_its_spectral_abscissa():
    stable = body(13)
    poles = stable.poles.copy()
    poles[-1] = 0.125 + 1j * poles[-1].imag
    unstable = PoleResidueSystem(poles, stable.b, stable.c, stable.d, stable.group)
    for method in METHODS:
        with pytest.raises(ReductionError, match=r"1 of its .* spectral abscissa 0\.125 1/s"):
            reduce(unstable, method, order=4)
    with pytest.raises(ValueError, match="spectral abscissa"):
        gramian_factor(unstable, unstable.b)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            {"method": "balanced", "order": 4},
            "method = 'balanced': expected one of tbr, tbr-band, hankel-optimal, modal",
        ),
        ({"method": "tbr"}, "expected exactly one"),
        ({"method": "tbr", "order": 4, "tolerance": 0.1}, "expected exactly one"),
        ({"method": "tbr", "order": 0}, "order = 0"),
        ({"method": "tbr", "tolerance": -0.1}, r"tolerance = -0\.1"),
        ({"method": "tbr", "order": 4, "band_hz": (30.0, 30.0)}, "band_hz"),
        ({"method": "modal", "order": 3}, "modal needs at least 6 states"),
    ],
)
def test_arguments_out_of_range_are_named(arguments, message):
    with pytest.raises(ValueError, match=message):
        reduce(body(14), **arguments)
