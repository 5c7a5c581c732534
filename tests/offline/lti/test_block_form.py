"""The real block form and its first-order hold against scipy's simulations."""

import numpy as np
import pytest
import scipy.linalg
import scipy.signal

from dense_form import dense_a
from palpate.lti.block_form import diagonalize, to_block_form
from palpate.lti.pole_residue import PoleResidueSystem
from palpate.lti.sampling import sample
from palpate.lti.stepping import step_through


def random_system(seed, n_real, n_pairs, n_inputs=3, n_outputs=3, speed=50.0):
    rng = np.random.default_rng(seed)
    poles = np.concatenate(
        [
            -speed * rng.uniform(0.01, 3, n_real) + 0j,
            -speed * rng.uniform(0.01, 1, n_pairs) + 1j * speed * rng.uniform(0.1, 10, n_pairs),
        ]
    )
    b = rng.standard_normal((len(poles), n_inputs)) + 1j * rng.standard_normal((len(poles), n_inputs))
    c = rng.standard_normal((n_outputs, len(poles))) + 1j * rng.standard_normal((n_outputs, len(poles)))
    b[:n_real].imag, c[:, :n_real].imag = 0, 0
    return PoleResidueSystem(poles, b, c, rng.standard_normal((n_outputs, n_inputs)))


def matrices(state_space):
    return dense_a(state_space), state_space.b, state_space.c, state_space.d


def held(system, period_s):
    """In block form, sampled by the first-order hold."""
    return to_block_form(sample(system, period_s, "first-order-hold"))


def transfer(state_space, s):
    a, b, c, d = matrices(state_space)
    return np.array([d + c @ np.linalg.solve(point * np.eye(len(a)) - a, b) for point in s])


SHAPES = [(0, 6), (4, 5), (5, 3), (3, 0), (1, 1)]


@pytest.mark.parametrize(("n_real", "n_pairs"), SHAPES)
def test_the_block_form_is_real_even_and_has_the_same_transfer_function(n_real, n_pairs):
    system = random_system(0, n_real, n_pairs)
    blocks = to_block_form(system)
    assert blocks.order == n_real + n_real % 2 + 2 * n_pairs
    s = np.array([0.3 + 0j, 7j, 400j, 1e4j])
    assert transfer(blocks, s) == pytest.approx(system.transfer(s), rel=1e-9)
    assert blocks.n_padding == n_real % 2


def test_real_poles_with_imaginary_rows_become_real_blocks():
    system = random_system(1, 4, 2)
    turned = PoleResidueSystem(system.poles, 1j * system.b, system.c / 1j, system.d)
    s = np.array([3j, 90j])
    assert transfer(to_block_form(turned), s) == pytest.approx(system.transfer(s), rel=1e-9)


@pytest.mark.parametrize(("n_real", "n_pairs"), SHAPES)
def test_diagonalizing_a_dense_system_keeps_its_transfer_function(n_real, n_pairs):
    system = random_system(2, n_real, n_pairs)
    a, b, c, d = matrices(to_block_form(system))
    if n_real % 2:
        a, b, c = (
            np.delete(np.delete(a, n_real, 0), n_real, 1),
            np.delete(b, n_real, 0),
            np.delete(c, n_real, 1),
        )
    basis = np.linalg.qr(np.random.default_rng(3).standard_normal(a.shape))[0]
    found = diagonalize(basis @ a @ basis.T, basis @ b, c @ basis.T, d)
    assert found.n_states == len(a)
    s = np.array([0j, 7j, 400j, 1e4j])
    assert found.transfer(s) == pytest.approx(system.transfer(s), rel=1e-8, abs=1e-8)


def test_a_matrix_without_a_basis_of_eigenvectors_is_refused():
    jordan = np.array([[-1.0, 1.0], [0.0, -1.0]])
    with pytest.raises(ValueError, match="condition number"):
        diagonalize(jordan, np.ones((2, 1)), np.ones((1, 2)), np.zeros((1, 1)))


@pytest.mark.parametrize(("n_real", "n_pairs"), SHAPES)
@pytest.mark.parametrize("period_s", [1e-3, 0.02])
def test_the_discrete_model_follows_piecewise_linear_inputs_exactly(n_real, n_pairs, period_s):
    system = random_system(4, n_real, n_pairs)
    blocks = to_block_form(system)
    samples = np.random.default_rng(5).standard_normal((300, 3))
    samples[0] = 0
    _, expected, _ = scipy.signal.lsim(matrices(blocks), samples, np.arange(300) * period_s, interp=True)
    running = held(system, period_s)
    found, state = step_through(running, samples)
    assert found == pytest.approx(expected, abs=1e-9 * np.max(np.abs(expected)))
    a, b, _, _ = matrices(running)
    xi = np.zeros(len(a))
    for sample_ in samples:
        xi = a @ xi + b @ sample_
    assert state == pytest.approx(xi, abs=1e-12 * np.max(np.abs(xi)))


def test_the_discrete_model_agrees_with_scipys_first_order_hold():
    system = random_system(6, 3, 4)
    a, b, c, d, _ = scipy.signal.cont2discrete(matrices(to_block_form(system)), 2e-3, method="foh")
    z = np.exp(1j * np.array([0.0, 0.01, 0.5, 3.0]))
    for point, value in zip(z, sample(system, 2e-3, "first-order-hold").transfer(z), strict=True):
        assert value == pytest.approx(d + c @ np.linalg.solve(point * np.eye(len(a)) - a, b), rel=1e-8)


@pytest.mark.parametrize("slowness", [1e-6, 1e-9, 1e-12])
def test_poles_slower_than_round_off_keep_their_static_gain(slowness):
    rate = slowness / 1e-3
    system = PoleResidueSystem(
        np.array([-rate + 0j, -rate + 1j * rate]),
        np.array([[rate + 0j], [(1 + 2j) * rate]]),
        np.ones((1, 2), dtype=complex),
        np.ones((1, 1)),
    )
    one = np.ones(1, dtype=complex)
    discrete = sample(system, 1e-3, "first-order-hold")
    # 1 - z keeps the digits of a double near 1
    assert discrete.transfer(one)[0] == pytest.approx(system.static_gain(), rel=1e-14 / slowness + 1e-12)
    assert discrete.b == pytest.approx(1e-3 * system.b, rel=10 * slowness)
    assert discrete.d == pytest.approx(1 + 0.5e-3 * (rate + 2 * rate), rel=slowness)


def test_smooth_motions_lose_little_to_the_hold():
    """Force error of sampled sines at 1, 10 and 50 Hz and 1 kHz: the hold's own, about (omega T)²/12 a channel."""
    system = random_system(7, 4, 8, speed=30.0)
    running = sample(system, 1e-3, "first-order-hold")
    for frequency, limit in ((1.0, 2e-5), (10.0, 1.5e-3), (50.0, 3e-2)):
        w = 2 * np.pi * frequency
        exact = system.transfer(np.array([1j * w]))[0]
        found = running.transfer(np.exp(np.array([1j * w * 1e-3])))[0]
        assert np.linalg.norm(found - exact, 2) < limit * np.linalg.norm(exact, 2)


def test_the_hold_has_a_zero_order_holds_pole_and_no_delay():
    system = random_system(8, 2, 2)
    blocks, discrete = to_block_form(system), held(system, 1e-3)
    assert np.sort_complex(np.linalg.eigvals(dense_a(discrete))) == pytest.approx(
        np.sort_complex(np.exp(1e-3 * np.linalg.eigvals(dense_a(blocks)))), rel=1e-10
    )
    jump = np.zeros((3, 3))
    jump[0, 0] = 1.0
    first = step_through(discrete, jump)[0][0]
    assert first == pytest.approx(blocks.d[:, 0] + (blocks.c @ blocks.b)[:, 0] * 5e-4, rel=0.1)


@pytest.mark.parametrize("shape", [(0, 2, 3), (4, 0, 2), (4, 2, 0), (0, 0, 0)])
def test_systems_without_states_inputs_or_outputs_have_their_forms_and_responses(shape):
    n, m, p = shape
    system = PoleResidueSystem(
        np.resize(np.array([-1 + 0j, -2 + 3j]), n),
        np.ones((n, m), dtype=complex),
        np.ones((p, n), dtype=complex),
        np.ones((p, m)),
    )
    assert system.transfer(np.array([0j, 1j])).shape == (2, p, m)
    assert system.transfer(np.zeros(0, dtype=complex)).shape == (0, p, m)
    assert system.step_response(np.array([0.0, 1.0])).shape == (2, p, m)
    assert system.response(np.zeros((5, m)), 1e-3).shape == (5, p)
    assert system.response(np.zeros((0, m)), 1e-3).shape == (0, p)
    running = sample(system, 1e-3, "bilinear", 30.0)
    blocks = to_block_form(running)
    assert step_through(blocks, np.zeros((5, m)))[0].shape == (5, p)
    assert diagonalize(*matrices(to_block_form(system.take(system.is_pair)))).d.shape == (p, m)


@pytest.mark.parametrize("period_s", [0.0, -1e-3, np.inf, np.nan])
def test_a_period_out_of_range_is_named(period_s):
    with pytest.raises(ValueError, match="period_s"):
        sample(random_system(9, 2, 2), period_s, "first-order-hold")
