"""The accuracy report measured in other ways: Hamiltonian eigenvalues, simulated pokes, held-out surface frequencies."""

import dataclasses
import itertools

import numpy as np
import pytest

from dense_form import dense_a
from palpate.lti.block_form import to_block_form
from palpate.lti.frequencies import maximum
from palpate.lti.pole_residue import PoleResidueSystem
from palpate.lti.sampling import sample
from palpate.lti.stepping import step_through
from palpate.lti.viscoelastic import viscoelastic_system
from palpate.model_file import AccuracyReport
from palpate.modes.elastic_modes import ElasticModes
from palpate.reduction import METHODS, ReductionError, fit_surface_output, measure, reduce
from palpate.reduction.accuracy import (
    hinf_error,
    poke,
    refuse_meaningless,
    step_error,
    time_domain_error,
)
from palpate.reduction.gramians import real_form
from palpate.reduction.passivity import largest_energy_out, passive_up_to, passivity_margin
from palpate.scene.material import PronySeries

LIVER_LIKE = PronySeries((0.5, 0.3), (0.58, 0.004))
PERIOD_S = 1e-3


def lattice_body(n=4, spring=300.0, mass=1e-3):
    """A cube of n³ masses joined by springs along edges and diagonals, bottom fixed, four top nodes one patch."""
    points = np.array(list(itertools.product(range(n), repeat=3)))
    number = {tuple(p): i for i, p in enumerate(points)}
    stiffness = np.zeros((3 * n**3, 3 * n**3))
    for p, step in itertools.product(points, itertools.product((-1, 0, 1), repeat=3)):
        other = number.get(tuple(p + step))
        if step > (0, 0, 0) and other is not None:
            direction = np.array(step) / np.linalg.norm(step)
            ends = np.add.outer(3 * np.array([number[tuple(p)], other]), np.arange(3)).ravel()
            stiffness[np.ix_(ends, ends)] += spring * np.kron(
                [[1, -1], [-1, 1]], np.outer(direction, direction)
            )
    patch = [number[n // 2 - 1 + i, n // 2 - 1 + j, n - 1] for i in (0, 1) for j in (0, 1)]
    free = [i for i, p in enumerate(points) if p[2] > 0 and i not in patch]
    f, t = (np.add.outer(3 * np.array(nodes), np.arange(3)).ravel() for nodes in (free, patch))
    rigid = np.tile(np.eye(3), (4, 1))
    mu, vectors = np.linalg.eigh(stiffness[np.ix_(f, f)] / mass)
    vectors /= np.sqrt(mass)
    shapes, patch_shapes = np.zeros((3 * n**3, len(mu))), np.zeros((3 * n**3, 3))
    shapes[f], patch_shapes[t] = vectors, rigid
    b = vectors.T @ stiffness[np.ix_(f, t)] @ rigid
    return ElasticModes(mu, b, b.T.copy(), rigid.T @ stiffness[np.ix_(t, t)] @ rigid, shapes, patch_shapes)


@pytest.fixture(scope="module")
def modes():
    return lattice_body()


@pytest.fixture(scope="module")
def full(modes):
    return viscoelastic_system(modes, LIVER_LIKE)


def held(system):
    return sample(system, PERIOD_S, "first-order-hold")


def accuracy_of(full, method, order):
    reduction = reduce(full, method, order=order)
    return reduction, measure(
        full,
        reduction,
        held(reduction.system),
        period_s=PERIOD_S,
        band_hz=(0.0, 30.0),
        error_surface_in_band=0.25,
        resolved_frequency_hz=12.0,
    )


@pytest.mark.parametrize("method", METHODS)
def test_every_figure_of_the_report_agrees_with_plain_sampling(full, method):
    reduction, accuracy = accuracy_of(full, method, 60)
    reduced = reduction.system
    error = lambda w: np.linalg.norm(full.transfer(1j * w) - reduced.transfer(1j * w), 2, axis=(1, 2))  # noqa: E731
    gain = lambda w: np.linalg.norm(full.transfer(1j * w), 2, axis=(1, 2))  # noqa: E731
    band = 2 * np.pi * np.linspace(0, 30, 3001)
    everywhere = np.concatenate([[0.0], np.geomspace(1e-2, 1e6, 6000)])
    assert accuracy.error_in_band_continuous == pytest.approx(np.max(error(band) / gain(band)), rel=0.02)
    assert accuracy.error_in_band_continuous >= np.max(error(band) / gain(band)) * (1 - 1e-9)
    running = held(reduction.system)
    sampled = np.linalg.norm(
        full.transfer(1j * band) - running.transfer(np.exp(1j * band * PERIOD_S)), 2, (1, 2)
    )
    assert accuracy.error_in_band == pytest.approx(np.max(sampled / gain(band)), rel=0.02)
    assert accuracy.error_static == pytest.approx((error(np.zeros(1)) / gain(np.zeros(1)))[0], abs=1e-12)
    assert accuracy.error_hinf >= np.max(error(everywhere)) / np.max(gain(everywhere)) * (1 - 1e-3)
    assert accuracy.spectral_abscissa == np.max(reduced.poles.real)
    assert accuracy.spectral_abscissa_full == full.spectral_abscissa
    assert (accuracy.error_surface_in_band, accuracy.resolved_frequency_hz) == (0.25, 12.0)
    assert (accuracy.error_bound is None) == (method == "tbr-band")
    if accuracy.error_bound is not None:
        assert accuracy.error_hinf <= accuracy.error_bound


def test_the_hinf_error_is_where_the_hamiltonian_touches_the_imaginary_axis(full):
    """Boyd, Balakrishnan & Kabamba 1989: gamma is above the norm when the Hamiltonian has no imaginary eigenvalues."""
    reduced = reduce(full, "tbr", order=40).system
    omega = np.concatenate([np.geomspace(1e-2, 1e6, 4000), full.poles.imag])
    largest = np.max(np.linalg.norm(full.transfer(1j * omega), 2, axis=(1, 2)))
    found = hinf_error(full, reduced) * largest
    forms = real_form(full), real_form(reduced)
    n = full.n_states + reduced.n_states
    a = np.zeros((n, n))
    a[: full.n_states, : full.n_states] = forms[0].apply(np.eye(full.n_states))
    a[full.n_states :, full.n_states :] = forms[1].apply(np.eye(reduced.n_states))
    b, c = np.vstack([forms[0].b, forms[1].b]), np.hstack([forms[0].c, -forms[1].c])

    def crosses(gamma):
        hamiltonian = np.block([[a, b @ b.T / gamma], [-c.T @ c / gamma, -a.T]])
        eigenvalues = np.linalg.eigvals(hamiltonian)
        return np.any(np.abs(eigenvalues.real) < 1e-7 * np.abs(eigenvalues))

    assert crosses(found * 0.99)
    assert not crosses(found * 1.01)


def test_the_peak_search_finds_a_resonance_between_its_samples():
    peak = 12.345
    omega, value = maximum(lambda w: 1 / np.hypot(w - peak, 1e-2), np.linspace(0, 30, 40))
    assert omega == pytest.approx(peak, abs=1e-2)
    assert value == pytest.approx(100, rel=0.05)


def test_the_time_domain_error_is_that_of_stepping_both_models(full):
    reduction = reduce(full, "tbr-band", order=40)
    inputs = poke(3, PERIOD_S, (0.0, 30.0))
    assert inputs.shape == (5001, 3)
    assert np.max(np.abs(inputs)) == pytest.approx(1.05e-3, rel=0.01)
    assert np.all(inputs[0] == 0)
    assert np.all(inputs[-1] == 0)
    exact, _ = step_through(to_block_form(held(full)), inputs)
    running = held(reduction.system)
    expected = np.max(np.linalg.norm(step_through(to_block_form(running), inputs)[0] - exact, axis=1))
    expected /= np.max(np.linalg.norm(exact, axis=1))
    assert time_domain_error(full, running, inputs, PERIOD_S) == pytest.approx(expected, rel=1e-3, abs=1e-12)


def worked_out(running, theta, amplitudes, n_cycles=400):
    """Work of the last of many closed pokes u_k = Re(a e^{j theta k}), by the trapezoidal sum over samples, J."""
    per_cycle = round(2 * np.pi / theta)
    k = np.arange(n_cycles * per_cycle + 1)
    u = np.real(np.exp(1j * theta * k)[:, None] * amplitudes)
    force = step_through(to_block_form(running), u)[0][-per_cycle - 1 :]
    u = u[-per_cycle - 1 :]
    return np.sum((force[1:] + force[:-1]) / 2 * np.diff(u, axis=0))


@pytest.mark.parametrize("per_cycle", [7, 40, 200])
def test_the_work_of_a_closed_poke_is_what_the_formula_says(full, per_cycle):
    running = held(reduce(full, "tbr", order=20).system)
    theta = 2 * np.pi / per_cycle
    a = np.array([1.0, 0.3 - 0.8j, -0.2j]) * 1e-3
    g = running.transfer(np.array([np.exp(1j * theta)]))[0]
    formula = np.pi * np.sin(theta) / theta * np.real(a.conj() @ (g - g.conj().T) / 2j @ a)
    assert worked_out(running, theta, a) == pytest.approx(formula, rel=1e-6)


def test_a_model_that_is_not_passive_gives_out_the_stated_energy_and_no_more():
    """A stiffness that grows with a lag: one pole with a residue of the wrong sign."""
    poles = np.array([-20.0 + 0j, -3 + 60j])
    b = np.array([[1.0 + 0j, 0], [0.5, 1.0]])
    active = PoleResidueSystem(poles, b, (b * np.array([[400.0], [300.0]])).T.copy(), 10 * np.eye(2))
    running = held(active)
    assert passivity_margin(running) < 0
    most = largest_energy_out(running, 1e-3)
    # The poke that gets most out, by sampling the formula above.
    angles = np.linspace(1e-3, np.pi, 20001)
    g = running.transfer(np.exp(1j * angles))
    values, vectors = np.linalg.eigh((g - g.conj().transpose(0, 2, 1)) / 2j)
    worst = np.argmin(np.sinc(angles / np.pi) * values[:, 0])
    theta, a = angles[worst], vectors[worst, :, 0]
    nearest = 2 * np.pi / round(2 * np.pi / theta)
    assert -worked_out(running, nearest, 1e-3 * a) == pytest.approx(most, rel=1e-2)
    rng = np.random.default_rng(0)
    for per_cycle in (5, 31, 100, 300):
        other = rng.standard_normal(2) + 1j * rng.standard_normal(2)
        out = -worked_out(running, 2 * np.pi / per_cycle, 1e-3 * other / np.linalg.norm(other))
        assert out <= most * (1 + 1e-6)


def test_a_circular_poke_on_a_nonsymmetric_stiffness_gets_energy_out():
    curl = np.array([[100.0, 20.0], [-20.0, 100.0]])
    none = np.zeros(0, dtype=complex)
    spring = PoleResidueSystem(none, none.reshape(0, 2), none.reshape(2, 0), curl)
    assert passivity_margin(spring) == pytest.approx(-20 / np.linalg.norm(curl, 2), rel=1e-6)
    assert largest_energy_out(spring, 1e-3) == pytest.approx(np.pi * 20e-6, rel=1e-6)


def test_the_full_symmetric_body_dissipates(full):
    # Positive everywhere, but the sampled-data hold and round-off leave their own small amounts.
    assert passivity_margin(held(full)) > -1e-9


@pytest.mark.parametrize(("method", "order"), [("tbr-band", 50), ("modal-static", 200)])
def test_surface_displacements_follow_the_full_model_between_the_fitted_frequencies(
    modes, full, method, order
):
    running = to_block_form(held(reduce(full, method, order=order).system))
    rows = np.arange(60)
    surface = fit_surface_output(
        modes,
        LIVER_LIKE,
        modes.parameters[rows],
        modes.patch_parameters[rows],
        running,
        period_s=PERIOD_S,
        band_hz=(0.0, 30.0),
    )
    assert surface.output.dtype == surface.feedthrough.dtype == np.float32
    assert surface.error_in_band < 1e-2
    for frequency in (0.0, 1.7, 13.3, 28.1):
        s = 2j * np.pi * frequency
        h = LIVER_LIKE.transfer_factor(np.array([s]))[0]
        gain = -h / (s**2 + modes.squared_frequencies * h)
        exact = (modes.parameters * gain)[rows] @ modes.input_coupling + modes.patch_parameters[rows]
        xi = np.linalg.solve(np.exp(s * PERIOD_S) * np.eye(running.order) - dense_a(running), running.b)
        error = np.linalg.norm(surface.output @ xi + surface.feedthrough - exact, 2) / np.linalg.norm(
            exact, 2
        )
        assert error <= (1e-4 if frequency == 0 else 1.5 * surface.error_in_band + 1e-6)


def test_surface_shapes_that_do_not_match_the_modes_are_named(modes, full):
    running = to_block_form(held(reduce(full, "tbr-band", order=20).system))
    with pytest.raises(ValueError, match="surface_shapes"):
        fit_surface_output(
            modes,
            LIVER_LIKE,
            modes.parameters[:9, :-1],
            modes.patch_parameters[:9],
            running,
            period_s=PERIOD_S,
            band_hz=(0.0, 30.0),
        )


def test_a_system_that_turns_active_says_from_which_frequency_on(full):
    pair = PoleResidueSystem(
        np.array([-3 + 40j, -60 + 900j]),
        np.array([[4.0 + 0j], [30.0 + 0j]]),
        np.array([[4.0j, -30.0j]]),
        np.array([[500.0]]),
    )
    running = held(pair)
    theta = np.linspace(1e-4, np.pi, 200001)
    imaginary = running.transfer(np.exp(1j * theta))[:, 0, 0].imag
    first = theta[np.argmax(imaginary < -1e-3 * abs(running.transfer(np.ones(1, dtype=complex))[0, 0, 0]))]
    assert 0 < first < np.pi
    assert passive_up_to(running) == pytest.approx(first, abs=1e-4)
    assert passive_up_to(held(full)) == np.pi


def test_the_step_error_is_that_of_stepping_a_jump(full):
    """Against the step response by modes; this body's poles all lie within half the sampling rate or decay at once."""
    running = sample(reduce(full, "tbr-band", order=40).system, PERIOD_S, "bilinear", 30.0)
    samples = np.arange(1200)
    slow = np.abs(full.poles) < np.pi / PERIOD_S
    settled = full.static_gain() - full.take(slow).static_gain()
    errors = []
    for channel in range(3):
        jump = np.zeros((1200, 3))
        jump[:, channel] = 1.0
        stepped, _ = step_through(to_block_form(running), jump)
        exact = full.take(slow).step_response(PERIOD_S * samples)[:, :, channel] + settled[:, channel]
        errors.append(stepped - exact)
    late = np.linalg.norm(np.stack(errors, axis=2)[200:], 2, (1, 2))
    expected = np.max(late) / np.linalg.norm(full.static_gain(), 2)
    assert step_error(full, running, PERIOD_S) == pytest.approx(expected, rel=1e-6, abs=1e-12)


def report_with(**changes):
    figures = {field.name: 0.0 for field in dataclasses.fields(AccuracyReport)}
    return AccuracyReport(
        **figures | {"band_hz": (0.0, 30.0), "hankel_singular_values": np.zeros(0)} | changes
    )


@pytest.mark.parametrize("field", ["error_in_band", "error_static"])
@pytest.mark.parametrize("error", [101.0, 5e14, np.inf, np.nan])
def test_a_model_whose_force_is_round_off_is_refused(field, error):
    refuse_meaningless(report_with(**{field: 13.0}), "tbr")
    with pytest.raises(ReductionError, match=r"force is wrong by .* %.*expected at most 10000 %") as refusal:
        refuse_meaningless(report_with(**{field: error}), "tbr-band")
    assert "tbr-band" not in str(refusal.value)  # advice never names what is in use
