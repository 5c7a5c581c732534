"""The passive reduction: what its form promises, on bodies whose every mode is known."""

import dataclasses

import numpy as np
import pytest

from palpate.discretization import conservative
from palpate.geometry.shapes import box_lattice
from palpate.lti.block_form import to_block_form
from palpate.lti.frequencies import band_frequencies, relative_errors, spectral_norms
from palpate.lti.pole_residue import PoleResidueSystem
from palpate.lti.sampling import Sampling
from palpate.lti.stepping import step_through
from palpate.lti.viscoelastic import viscoelastic_system
from palpate.modes.dense import elastic_modes
from palpate.reduction import ReductionError, passive
from palpate.reduction.accuracy import gain_above_band
from palpate.reduction.passive import RitzSubspace, with_fitted_terms
from palpate.scene.material import Material, PronySeries

TISSUE = Material(5400.0, 0.45, 1060.0, PronySeries((0.5, 0.3), (0.58, 0.004)))
SAMPLING = Sampling(1e-3, "bilinear", (0.0, 30.0))


def block(n, n_tips):
    """A block of tissue of 8 cm, bottom held, one or two tips of five nodes on top."""
    cloud = box_lattice((0, 0, 0), (0.08, 0.08, 0.08), (n, n, n))
    bottom = np.flatnonzero(cloud.points[:, 2] < 1e-9)
    places = np.array([[0.03, 0.04, 0.08], [0.06, 0.05, 0.08]])[:n_tips]
    tips = [np.argsort(np.linalg.norm(cloud.points - place, axis=1))[:5] for place in places]
    modes = elastic_modes(conservative.assemble(cloud, TISSUE, bottom, tips))
    return modes, viscoelastic_system(modes, TISSUE.prony)


@pytest.fixture(scope="module", params=[1, 2])
def body(request):
    return block(6, request.param)


@pytest.fixture(scope="module")
def reduced(body):
    modes, full = body
    return passive(full, RitzSubspace.of(modes), TISSUE.prony, SAMPLING, tolerance=0.01).system


def dissipation(responses):
    """(n,): smallest eigenvalue of (F - F^H) / 2j over the largest |F|."""
    smallest = np.linalg.eigvalsh((responses - responses.conj().transpose(0, 2, 1)) / 2j)[:, 0]
    return smallest / np.max(spectral_norms(responses))


def dense_frequencies(system, highest):
    """(n,), rad/s: 4,000 points and the resonances with their flanks."""
    resonances, widths = system.poles.imag[system.is_pair], -system.poles.real[system.is_pair]
    around = np.concatenate([resonances + k * widths for k in (-1.0, 0.0, 1.0)])
    omega = np.concatenate([np.geomspace(1e-3, highest, 2000), np.linspace(1e-3, highest, 2000), around])
    return np.unique(omega[(omega > 0) & (omega <= highest)])


def test_the_tolerance_holds_for_the_model_that_runs_and_the_statics_are_exact(body, reduced):
    _, full = body
    omega = band_frequencies((full, reduced), SAMPLING.band_hz)
    assert np.max(relative_errors(full.transfer(1j * omega), SAMPLING.response(reduced, omega))) <= 0.0101
    np.testing.assert_allclose(
        reduced.static_gain(), full.static_gain(), rtol=0, atol=1e-10 * np.max(full.static_gain())
    )
    assert reduced.n_states < full.n_states / 3


def test_no_frequency_gets_energy_out_of_the_continuous_model(reduced):
    omega = dense_frequencies(reduced, 1e6)
    assert np.min(dissipation(reduced.transfer(1j * omega))) > -1e-13


def test_no_frequency_gets_energy_out_of_the_model_that_runs(reduced):
    omega = dense_frequencies(reduced, 0.9999 * np.pi / SAMPLING.period_s)
    assert np.min(dissipation(SAMPLING.response(reduced, omega))) > -1e-13


def test_no_random_closed_poke_gets_energy_out(reduced):
    """The work of every poke that starts from rest and comes back to where it began, in the server's own recursion."""
    running = to_block_form(SAMPLING.sample(reduced))
    rng = np.random.default_rng(4)
    for smooth in (1, 3, 30):
        path = rng.standard_normal((3000, running.b.shape[1]))
        path = np.apply_along_axis(np.convolve, 0, path, np.ones(smooth) / smooth, mode="same")
        path[0] = path[-1] = 0
        force, _ = step_through(running, path)
        power = np.sum((force[1:] + force[:-1]) / 2 * np.diff(path, axis=0), axis=1)
        assert np.min(np.cumsum(power)) > -1e-12 * np.sum(np.abs(power))  # never below what was put in before


def test_above_the_band_it_is_hardly_stiffer_than_the_body(body, reduced):
    _, full = body
    gain = gain_above_band(full, SAMPLING.sample(reduced), SAMPLING.period_s, SAMPLING.band_hz[1])
    assert gain < 1.5
    # The few modes alone, whose error in the band is as small, stand out there.
    modes, _ = body
    alone = viscoelastic_system(RitzSubspace.of(modes).ritz_modes(20), TISSUE.prony)
    assert gain_above_band(full, SAMPLING.sample(alone), SAMPLING.period_s, SAMPLING.band_hz[1]) > 2 * gain


def test_whatever_the_fit_is_asked_for_the_model_stays_passive(body):
    """A target that gives out energy: the fit comes as near as a passive model can."""
    modes, full = body
    active = PoleResidueSystem(full.poles, full.b, -full.c, -full.d, full.group)
    kept = viscoelastic_system(RitzSubspace.of(modes).ritz_modes(4, 2 * np.pi * 40), TISSUE.prony)
    reduced = with_fitted_terms(active, kept, 2 * np.pi * 40, SAMPLING)
    assert np.min(dissipation(reduced.transfer(1j * dense_frequencies(reduced, 1e5)))) > -1e-13


def test_the_ritz_modes_match_the_moments_of_the_force(body):
    """Block Krylov vectors of q blocks match 2 q moments of b^T (mu - sigma)^-1 b at sigma = 0: Gauss quadrature."""
    modes, _ = body
    mu, b = modes.squared_frequencies / modes.squared_frequencies[0], modes.input_coupling
    ritz = RitzSubspace.of(modes).ritz_modes(4)
    theta = ritz.squared_frequencies / modes.squared_frequencies[0]
    for power in range(1, 9):
        exact = b.T @ (b / mu[:, None] ** power)
        found = ritz.input_coupling.T @ (ritz.input_coupling / theta[:, None] ** power)
        np.testing.assert_allclose(found, exact, rtol=0, atol=1e-9 * np.max(np.abs(exact)))
    exact = b.T @ (b / mu[:, None] ** 9)
    found = ritz.input_coupling.T @ (ritz.input_coupling / theta[:, None] ** 9)
    assert np.max(np.abs(found - exact)) > 1e-7 * np.max(np.abs(exact))


def test_an_order_is_not_exceeded_and_more_states_bring_it_nearer(body):
    modes, full = body
    if full.n_inputs > 3:
        pytest.skip("one tip is enough")
    omega = band_frequencies((full,), SAMPLING.band_hz)
    errors = []
    for order in (130, 400):
        system = passive(full, RitzSubspace.of(modes), TISSUE.prony, SAMPLING, order=order).system
        assert system.n_states <= order
        errors.append(np.max(relative_errors(full.transfer(1j * omega), SAMPLING.response(system, omega))))
    assert errors[1] < errors[0] / 2


def test_what_can_not_be_done_is_said(body):
    modes, full = body
    with pytest.raises(ReductionError, match=r"order = 2: passive needs at least [0-9]+ states"):
        passive(full, RitzSubspace.of(modes), TISSUE.prony, SAMPLING, order=2)
    with pytest.raises(ReductionError, match=r"tolerance = 1e-12: passive reaches .* in 0-30 Hz at best"):
        passive(full, RitzSubspace.of(modes), TISSUE.prony, SAMPLING, tolerance=1e-12)
    skewed = dataclasses.replace(modes, output_coupling=2 * modes.output_coupling)
    with pytest.raises(ReductionError, match="symmetric body"):
        RitzSubspace.of(skewed)
