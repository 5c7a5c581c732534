"""The two sampling rules against scipy's, and what each keeps of the continuous model."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import scipy.signal

from dense_form import dense_a
from palpate.build import build_full_model
from palpate.lti.block_form import to_block_form
from palpate.lti.pole_residue import PoleResidueSystem
from palpate.lti.sampling import Sampling, SamplingRule, damping, sample
from palpate.lti.stepping import step_through
from palpate.lti.viscoelastic import viscoelastic_system
from palpate.modes.elastic_modes import ElasticModes
from palpate.reduction.accuracy import step_error
from palpate.reduction.passivity import passivity_margin
from palpate.scene.material import PronySeries
from palpate.scene.schema import check_config

PERIOD_S = 1e-3


def stiff_contact(seed: int = 0) -> PoleResidueSystem:
    """A tip on a body with modes from 2 Hz to 3 kHz, far beyond half the sampling rate: passive by construction."""
    rng = np.random.default_rng(seed)
    mu = (2 * np.pi * np.geomspace(2, 3000, 40)) ** 2
    b = rng.normal(size=(40, 3)) * np.sqrt(mu)[:, None]
    direct = b.T @ (b / mu[:, None]) + 5 * np.eye(3)
    modes = ElasticModes(mu, b, b.T, direct, np.zeros((3, 40)), np.zeros((3, 3)))
    return viscoelastic_system(modes, PronySeries((0.5, 0.3), (0.58, 0.004)))


def relaxing_body() -> PoleResidueSystem:
    """Poles that the trapezoidal rule lets decay as fast as in continuous time: real ones slower than the sampling."""
    rng = np.random.default_rng(3)
    poles = -np.geomspace(0.5, 1500, 9) + 0j
    b = rng.normal(size=(9, 3)) + 0j
    return PoleResidueSystem(poles, b, -poles * b.T, 5 * np.eye(3))


@pytest.mark.parametrize("rule", ["bilinear", "first-order-hold"])
def test_the_sampled_model_has_scipys_response(rule: SamplingRule) -> None:
    system = relaxing_body() if rule == "bilinear" else stiff_contact()
    blocks = to_block_form(system)
    method = {"bilinear": "bilinear", "first-order-hold": "foh"}[rule]
    matrices = (dense_a(blocks), blocks.b, blocks.c, blocks.d)
    a, b, c, d, _ = scipy.signal.cont2discrete(matrices, PERIOD_S, method=method)
    found = sample(system, PERIOD_S, rule)
    z = np.exp(1j * np.array([0.01, 0.3, 1.0, 3.0]))
    for point, value in zip(z, found.transfer(z), strict=True):
        expected = d + c @ np.linalg.solve(point * np.eye(len(a)) - a, b)
        np.testing.assert_allclose(value, expected, rtol=1e-7, atol=1e-7 * np.abs(expected).max())


def test_the_damped_trapezoidal_rule_is_the_continuous_response_at_warped_frequencies() -> None:
    """Pole by pole, s = (1 + theta)/T (z - 1)/(z + theta)."""
    system = stiff_contact()
    omega = 2 * np.pi * np.array([0.5, 10.0, 30.0, 200.0, 499.0])
    z = np.exp(1j * omega * PERIOD_S)
    theta = damping(system.poles * PERIOD_S, np.exp(system.poles.real * PERIOD_S))
    assert np.min(theta) < 0.9 < np.max(theta)
    expected = np.repeat(system.d[None].astype(complex), len(z), axis=0)
    for k, t in enumerate(theta):
        s = (1 + t) / PERIOD_S * (z - 1) / (z + t)
        alone = PoleResidueSystem(
            system.poles[k : k + 1], system.b[k : k + 1], system.c[:, k : k + 1], 0 * system.d
        )
        assert np.all(s.real > -1e-9 * np.abs(s))  # the unit circle comes to lie in the right half plane
        expected += alone.transfer(s)
    np.testing.assert_allclose(
        Sampling(PERIOD_S, band_hz=(0.0, 0.0)).response(system, omega), expected, rtol=1e-8
    )


def test_each_pole_decays_as_in_continuous_time_and_beyond_half_the_sampling_rate_quickly() -> None:
    rng = np.random.default_rng(5)
    z = -np.geomspace(1e-9, 1e3, 400)[:, None] + 1j * np.concatenate([[0.0], np.geomspace(1e-9, 1e4, 400)])
    z = rng.permutation(z.ravel())
    own = np.exp(z.real)
    theta = damping(z, own)
    decay = np.abs((1 + theta + theta * z) / (1 + theta - z))
    limit = np.where(np.abs(z) > np.pi, 0.8, np.maximum(own, 0.8))
    assert np.all((theta >= 0) & (theta <= 1))
    oscillating = np.abs(z.imag) >= 2 * np.abs(z.real)  # the others the plain rule damps enough
    assert np.all(decay[oscillating] <= limit[oscillating] + 1e-9)
    assert np.all(decay[np.abs(z) > np.pi] <= 0.8 + 1e-9)
    np.testing.assert_allclose(decay[theta < 1], limit[theta < 1], rtol=1e-9)  # no more than needed


def light_body(
    density_kg_per_m3: float, youngs_modulus_pa: float, gamma: float, tau_s: float
) -> PoleResidueSystem:
    """A block of 6 cm, bottom fixed, pressed at its top: a small scene."""
    scene = {
        "name": "light",
        "geometry": {"shape": "box", "upper_m": [0.06, 0.06, 0.06], "counts": [5, 5, 5]},
        "material": {
            "youngs_modulus_pa": youngs_modulus_pa,
            "poissons_ratio": 0.45,
            "density_kg_per_m3": density_kg_per_m3,
            "gamma": [0.5, gamma],
            "tau_s": [0.58, tau_s],
        },
        "fixed": [{"region": "plane", "point_m": [0, 0, 1e-4], "normal": [0, 0, -1.0]}],
        "contact": [{"name": "tip", "point_m": [0.03, 0.03, 0.06], "radius_m": 0.01}],
        "reduction": {"method": "tbr-band", "order": 40},
    }
    return build_full_model(check_config(scene, "light"), Path()).system


@pytest.mark.parametrize(
    ("density", "modulus"), [(1.0, 5400.0), (10.0, 5400.0), (10.0, 5e5)], ids=["light", "less light", "stiff"]
)
def test_a_light_or_stiff_body_comes_to_rest_after_a_jump_of_the_tip(density: float, modulus: float) -> None:
    """The trapezoidal rule's undamped corner: poles far beyond the sampling rate at z near -1."""
    full = light_body(density, modulus, 0.3, 0.004)
    assert np.max(np.abs(full.poles)) > 3 * np.pi / PERIOD_S
    running = sample(full, PERIOD_S, "bilinear", 30.0)
    jump = np.zeros((500, 3))
    jump[:, 2] = 1e-3
    stepped, _ = step_through(to_block_form(running), jump)
    times = PERIOD_S * np.arange(500)
    static = 1e-3 * np.linalg.norm(full.static_gain()[:, 2])
    # The exact response rings as well, at rates above 20/s (gamma/tau over 2 (1 + sum of gamma)): gone after 0.4 s.
    exact = 1e-3 * full.step_response(times)[:, :, 2]
    late = slice(400, None)
    assert np.max(np.linalg.norm(stepped[late] - exact[late], axis=1)) < 0.01 * static
    alternating = np.max(np.abs(np.diff(stepped, axis=0)[50:]))
    assert alternating < 0.6 * static  # by the plain rule 1.4 to 2.4 times the static force, for seconds
    assert step_error(full, running, PERIOD_S) < 0.05
    assert passivity_margin(running) >= -1e-9


@pytest.mark.parametrize("seed", range(5))
def test_a_passive_body_stays_passive_by_the_trapezoidal_rule_and_not_by_the_hold(seed: int) -> None:
    system = stiff_contact(seed)
    assert passivity_margin(sample(system, PERIOD_S, "bilinear")) >= -1e-9
    # The reason why the trapezoidal rule is the default, so that nobody changes it without seeing this.
    assert passivity_margin(sample(system, PERIOD_S, "first-order-hold")) < -0.1


def test_the_hold_answers_the_images_of_a_sampled_sine_as_well() -> None:
    """Poisson summation: F at omega and at its images, each weighted by the hold's (sin(omega T/2)/(omega_k T/2))²."""
    system = stiff_contact()
    omega = 2 * np.pi * np.array([3.0, 17.0, 30.0])
    images = omega[:, None] + 2 * np.pi * np.arange(-20000, 20001) / PERIOD_S
    weights = (np.sin(omega * PERIOD_S / 2)[:, None] / (images * PERIOD_S / 2)) ** 2
    # What all images would weigh with D alone; the rest of F dies out well below the last image.
    dynamic = system.transfer(1j * images.ravel()).reshape(*images.shape, 3, 3) - system.d
    expected = system.d + np.einsum("wk,wkpm->wpm", weights, dynamic)
    found = Sampling(PERIOD_S, "first-order-hold").response(system, omega)
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-5 * np.abs(expected).max())


def test_prewarping_puts_the_poles_of_the_band_where_the_hold_has_them() -> None:
    system = stiff_contact()
    near = np.abs(system.poles) <= 1.5 * 2 * np.pi * 30
    assert 10 < np.count_nonzero(near) < len(near)
    warped = sample(system, PERIOD_S, "bilinear", 30.0).poles[near]
    np.testing.assert_allclose(warped, np.exp(system.poles[near] * PERIOD_S), rtol=1e-12)


@pytest.mark.parametrize("seed", range(5))
def test_prewarping_takes_the_error_of_sharp_resonances_away_and_leaves_the_body_passive(seed: int) -> None:
    system = stiff_contact(seed)
    omega = 2 * np.pi * np.linspace(0.1, 30, 600)
    exact = system.transfer(1j * omega)

    def error(band_hz: float) -> float:
        sampled = Sampling(PERIOD_S, band_hz=(0.0, band_hz)).response(system, omega)
        return float(np.max(np.linalg.norm(sampled - exact, 2, (1, 2)) / np.linalg.norm(exact, 2, (1, 2))))

    assert error(30.0) < 0.25 * error(0.0)
    assert passivity_margin(sample(system, PERIOD_S, "bilinear", 30.0)) >= -1e-9


def test_both_rules_keep_the_statics() -> None:
    system = stiff_contact()
    for rule in ("bilinear", "first-order-hold"):
        static = sample(system, PERIOD_S, rule, 30.0).transfer(np.ones(1, dtype=complex))[0].real
        np.testing.assert_allclose(static, system.static_gain(), rtol=1e-7, atol=1e-7)


def test_an_unknown_rule_or_period_is_refused() -> None:
    with pytest.raises(ValueError, match="'zoh': expected one of bilinear, first-order-hold"):
        sample(stiff_contact(), PERIOD_S, "zoh")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="period_s = 0"):
        sample(stiff_contact(), 0.0, "bilinear")
