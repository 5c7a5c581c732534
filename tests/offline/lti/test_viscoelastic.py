"""The diagonal form of the viscoelastic system against its formula and against plain first-order matrices."""

import numpy as np
import pytest
import scipy.linalg
import scipy.signal

from palpate.lti.pole_residue import first_order_hold
from palpate.lti.viscoelastic import viscoelastic_system
from palpate.modes.elastic_modes import ElasticModes
from palpate.scene.material import PronySeries

ONE_TERM = PronySeries((1.0,), (1.0,))
LIVER_LIKE = PronySeries((0.5, 0.3), (0.58, 0.004))
THREE_TERMS = PronySeries((0.4, 0.2, 0.7), (2.0, 0.1, 0.003))
ELASTIC = PronySeries()


def random_stiffness(seed, n_free, n_inputs, skew=0.0):
    """A stiffness matrix with unit mass, symmetric positive definite plus `skew` times a random skew matrix."""
    rng = np.random.default_rng(seed)
    root = rng.standard_normal((n_free + n_inputs, n_free + n_inputs))
    other = rng.standard_normal(root.shape)
    return 30 * (root @ root.T + 0.3 * np.eye(len(root)) + skew * (other - other.T))


def modes_of(stiffness, n_inputs):
    n = len(stiffness) - n_inputs
    k_ff, k_ft, k_tf = stiffness[:n, :n], stiffness[:n, n:], stiffness[n:, :n]
    if np.array_equal(stiffness, stiffness.T):
        mu, shapes = np.linalg.eigh(k_ff)
        inverse = shapes.T
    else:
        mu, shapes = np.linalg.eig(k_ff)
        inverse = np.linalg.inv(shapes)
    return ElasticModes(mu, inverse @ k_ft, k_tf @ shapes, stiffness[n:, n:], shapes, np.zeros((n, n_inputs)))


def formula(modes, prony, s):
    """F(s) as `ElasticModes` defines it, point by point."""
    out = []
    for point, h in zip(s, prony.transfer_factor(s), strict=True):
        gain = h / (point**2 + modes.squared_frequencies * h)
        out.append(h * (modes.direct_stiffness - (modes.output_coupling * gain) @ modes.input_coupling))
    return np.array(out)


def first_order_matrices(stiffness, n_inputs, prony):
    """A, B, C, D with states u, v, the memories z_j of the free nodes, and z_j - u of the patch (Eq. 9, 34)."""
    n, m, terms = len(stiffness) - n_inputs, n_inputs, len(prony.gamma)
    size = 2 * n + terms * (n + m)
    k_ff, k_ft = stiffness[:n, :n], stiffness[:n, n:]
    k_tf, k_tt = stiffness[n:, :n], stiffness[n:, n:]
    w_free, w_patch = np.zeros((n, size)), np.zeros((m, size))
    w_free[:, :n] = np.eye(n)
    a, b = np.zeros((size, size)), np.zeros((size, m))
    a[:n, n : 2 * n] = np.eye(n)
    for j, (gamma, tau) in enumerate(zip(prony.gamma, prony.tau_s, strict=True)):
        free = slice(2 * n + j * (n + m), 2 * n + j * (n + m) + n)
        patch = slice(free.stop, free.stop + m)
        w_free[:, free], w_patch[:, patch] = gamma * np.eye(n), gamma * np.eye(m)
        a[free, free], a[free, n : 2 * n] = -np.eye(n) / tau, np.eye(n)
        a[patch, patch], b[patch] = -np.eye(m) / tau, -np.eye(m) / tau
    a[n : 2 * n] -= k_ff @ w_free + k_ft @ w_patch
    b[n : 2 * n] -= k_ft * prony.instant_factor
    return a, b, k_tf @ w_free + k_tt @ w_patch, prony.instant_factor * k_tt


@pytest.mark.parametrize("prony", [ELASTIC, ONE_TERM, LIVER_LIKE, THREE_TERMS])
@pytest.mark.parametrize("skew", [0.0, 0.3])
def test_partial_fractions_equal_the_formula_at_every_frequency(prony, skew):
    modes = modes_of(random_stiffness(1, 20, 3, skew), 3)
    assert np.any(modes.squared_frequencies.imag != 0) == (skew > 0)
    system = viscoelastic_system(modes, prony)
    s = 0.05 + 1j * np.concatenate([[0.0], np.geomspace(1e-4, 1e5, 60)])
    expected = formula(modes, prony, s)
    error = np.linalg.norm(system.transfer(s) - expected, axis=(1, 2)) / np.linalg.norm(expected, axis=(1, 2))
    assert np.max(error) < 1e-10


@pytest.mark.parametrize("skew", [0.0, 0.3])
@pytest.mark.parametrize("prony", [ONE_TERM, LIVER_LIKE])
def test_states_poles_and_response_are_those_of_the_plain_first_order_system(prony, skew):
    stiffness = random_stiffness(2, 8, 2, skew)
    system = viscoelastic_system(modes_of(stiffness, 2), prony)
    a, b, c, d = first_order_matrices(stiffness, 2, prony)
    assert system.n_states == len(a) == 8 * (len(prony.gamma) + 2) + 2 * len(prony.gamma)

    poles = np.concatenate([system.poles, system.poles[system.is_pair].conj()])
    for pole in scipy.linalg.eigvals(a):
        assert np.min(np.abs(poles - pole)) < 1e-6 * abs(pole)
    assert system.spectral_abscissa == pytest.approx(np.max(scipy.linalg.eigvals(a).real), rel=1e-6)

    times = np.arange(400) * 2e-3
    inputs = np.column_stack([np.sin(40 * times), times * np.cos(90 * times)])
    _, expected, _ = scipy.signal.lsim((a, b, c, d), inputs, times, interp=True)
    found = system.response(inputs, 2e-3)
    assert np.max(np.abs(found - expected)) < 1e-9 * np.max(np.abs(expected))

    rise = np.array([0.0, 1e-3, 0.02, 0.5, 3.0])
    exact = [d + c @ np.linalg.solve(a, (scipy.linalg.expm(a * t) - np.eye(len(a))) @ b) for t in rise]
    assert system.step_response(rise) == pytest.approx(
        np.array(exact), rel=1e-9, abs=1e-9 * np.max(np.abs(d))
    )


@pytest.mark.parametrize("skew", [0.0, 0.3])
def test_a_hand_at_rest_feels_the_static_stiffness_and_at_an_instant_the_instant_one(skew):
    modes = modes_of(random_stiffness(3, 15, 3, skew), 3)
    system = viscoelastic_system(modes, LIVER_LIKE)
    scale = np.max(np.abs(modes.static_stiffness))
    assert system.static_gain() == pytest.approx(modes.static_stiffness, abs=1e-9 * scale)
    assert system.d == pytest.approx(1.8 * modes.direct_stiffness, rel=1e-12)


def test_a_symmetric_body_has_a_symmetric_realization_and_another_has_not():
    assert viscoelastic_system(modes_of(random_stiffness(4, 10, 3), 3), LIVER_LIKE).is_symmetric
    assert not viscoelastic_system(modes_of(random_stiffness(4, 10, 3, 0.3), 3), LIVER_LIKE).is_symmetric


def test_frequencies_over_twelve_decades_keep_their_digits():
    mu = np.geomspace(1e-4, 1e12, 40)
    b = np.sqrt(mu)[:, None] * np.random.default_rng(5).standard_normal((40, 2)) / 10
    modes = ElasticModes(mu, b, b.T, b.T @ (b / mu[:, None]) + np.eye(2), np.zeros((3, 40)), np.zeros((3, 2)))
    system = viscoelastic_system(modes, THREE_TERMS)
    s = 1j * np.geomspace(1e-5, 1e8, 200)
    expected = formula(modes, THREE_TERMS, s)
    error = np.linalg.norm(system.transfer(s) - expected, axis=(1, 2)) / np.linalg.norm(expected, axis=(1, 2))
    assert np.max(error) < 1e-9


def test_the_purely_elastic_body_has_all_poles_on_the_imaginary_axis():
    modes = modes_of(random_stiffness(6, 12, 3), 3)
    system = viscoelastic_system(modes, ELASTIC)
    assert np.all(system.poles.real == 0)
    assert np.sort(system.poles.imag) == pytest.approx(np.sqrt(modes.squared_frequencies), rel=1e-12)


def test_a_body_that_nothing_holds_is_refused():
    modes = modes_of(random_stiffness(7, 6, 3), 3)
    free = ElasticModes(
        np.append(0.0, modes.squared_frequencies[1:]),
        modes.input_coupling,
        modes.output_coupling,
        modes.direct_stiffness,
        modes.parameters,
        modes.patch_parameters,
    )
    with pytest.raises(ValueError, match=r"squared_frequencies\[0\] = 0"):
        viscoelastic_system(free, ONE_TERM)


def test_complex_frequencies_without_their_conjugates_are_refused():
    modes = modes_of(random_stiffness(1, 20, 3, 0.3), 3)
    kept = np.flatnonzero(modes.squared_frequencies.imag >= 0)
    half = ElasticModes(
        modes.squared_frequencies[kept],
        modes.input_coupling[kept],
        modes.output_coupling[:, kept],
        modes.direct_stiffness,
        modes.parameters,
        modes.patch_parameters,
    )
    with pytest.raises(ValueError, match="conjugate pairs"):
        viscoelastic_system(half, ONE_TERM)


def test_first_order_hold_weights_join_smoothly_where_series_and_formula_meet():
    # By their integrals: phi_2 is that of t e^{z (1 - t)} over 0..1, phi_1 - phi_2 that of (1 - t) e^{z (1 - t)}.
    t, w = np.polynomial.legendre.leggauss(60)
    t, w = (t + 1) / 2, w / 2
    z = np.array([0, 1e-8, -0.499999, -0.500001, 0.3 + 0.4j, -3 + 4j, -1e-3j])
    decay, old, new = first_order_hold(z)
    for i in range(len(z)):
        assert new[i] == pytest.approx(np.sum(w * t * np.exp(z[i] * (1 - t))), rel=1e-13)
        assert old[i] == pytest.approx(np.sum(w * (1 - t) * np.exp(z[i] * (1 - t))), rel=1e-13)
        assert decay[i] == pytest.approx(np.exp(z[i]), rel=1e-15)
