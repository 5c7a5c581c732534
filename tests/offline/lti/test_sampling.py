"""The two sampling rules against scipy's, and what each keeps of the continuous model."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.signal

from palpate.lti.block_form import from_block_form, to_block_form
from palpate.lti.pole_residue import DiagonalSystem
from palpate.lti.sampling import SamplingRule, discretize, sample, sampled_response
from palpate.lti.viscoelastic import viscoelastic_system
from palpate.modes.elastic_modes import ElasticModes
from palpate.reduction.passivity import passivity_margin
from palpate.scene.material import PronySeries

PERIOD_S = 1e-3


def stiff_contact(seed: int = 0) -> DiagonalSystem:
    """A tip on a body with modes from 2 Hz to 3 kHz, far beyond half the sampling rate: passive by construction."""
    rng = np.random.default_rng(seed)
    mu = (2 * np.pi * np.geomspace(2, 3000, 40)) ** 2
    b = rng.normal(size=(40, 3)) * np.sqrt(mu)[:, None]
    direct = b.T @ (b / mu[:, None]) + 5 * np.eye(3)
    modes = ElasticModes(mu, b, b.T, direct, np.zeros((3, 40)), np.zeros((3, 3)))
    return viscoelastic_system(modes, PronySeries((0.5, 0.3), (0.58, 0.004)))


@pytest.mark.parametrize("rule", ["bilinear", "first-order-hold"])
def test_the_sampled_model_has_scipys_response(rule: SamplingRule) -> None:
    blocks = to_block_form(stiff_contact())
    method = {"bilinear": "bilinear", "first-order-hold": "foh"}[rule]
    matrices = (blocks.dense_a(), blocks.b, blocks.c, blocks.d)
    a, b, c, d, _ = scipy.signal.cont2discrete(matrices, PERIOD_S, method=method)
    found = from_block_form(discretize(blocks, PERIOD_S, rule))
    z = np.exp(1j * np.array([0.01, 0.3, 1.0, 3.0]))
    for point, value in zip(z, found.transfer(z), strict=True):
        expected = d + c @ np.linalg.solve(point * np.eye(len(a)) - a, b)
        np.testing.assert_allclose(value, expected, rtol=1e-7, atol=1e-7 * np.abs(expected).max())


def test_the_trapezoidal_rule_is_the_continuous_response_at_warped_frequencies() -> None:
    system = stiff_contact()
    omega = 2 * np.pi * np.array([0.5, 10.0, 30.0, 200.0, 499.0])
    warped = 2 / PERIOD_S * np.tan(omega * PERIOD_S / 2)
    np.testing.assert_allclose(
        sampled_response(system, omega, PERIOD_S, "bilinear"), system.transfer(1j * warped), rtol=1e-8
    )


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
    found = sampled_response(system, omega, PERIOD_S, "first-order-hold")
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
        sampled = sampled_response(system, omega, PERIOD_S, "bilinear", band_hz)
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
