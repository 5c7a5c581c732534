"""Singular perturbation balancing, which only the paper's figures use, against SLICOT, its bound and its exact statics."""

import ctrlsys
import numpy as np
import pytest

from palpate.lti.block_form import diagonalize
from palpate.lti.pole_residue import PoleResidueSystem
from palpate_paper.methods import singular_perturbation_balancing


def random_matrices(seed, n, n_inputs, n_outputs, damping):
    rng = np.random.default_rng(seed)
    a = rng.standard_normal((n, n))
    a -= (np.max(np.linalg.eigvals(a).real) + damping) * np.eye(n)
    shapes = (n, n_inputs), (n_outputs, n), (n_outputs, n_inputs)
    return a, *(rng.standard_normal(shape) for shape in shapes)


CASES = [(0, 12, 1, 1, 1.0), (1, 20, 2, 2, 1.0), (2, 25, 4, 1, 0.5), (3, 25, 2, 3, 1.0), (4, 30, 2, 2, 0.01)]


def largest_error(full, reduced):
    poles = np.concatenate([full.poles, reduced.poles])
    s = 1j * np.concatenate([[0.0], np.geomspace(1e-4, 1e4, 500), np.abs(poles.imag)])
    return np.max(np.linalg.norm(full.transfer(s) - reduced.transfer(s), 2, axis=(1, 2)))


@pytest.mark.parametrize("case", CASES)
def test_it_agrees_with_slicot(case):
    matrices = random_matrices(*case)
    a, b, c, d = (np.array(x, order="F") for x in matrices)
    n, m, p, order = len(a), b.shape[1], len(c), 4
    ar, br, cr, dr, *_ = ctrlsys.ab09bd("C", "B", "N", "F", n, m, p, order, a, b, c, d, 0.0, 0.0)
    found = singular_perturbation_balancing(diagonalize(*matrices), order).system
    for s in 1j * np.array([0.0, 0.1, 1.0, 10.0]):
        expected = dr + cr[:, :order] @ np.linalg.solve(s * np.eye(order) - ar[:order, :order], br[:order])
        assert found.transfer(np.array([s]))[0] == pytest.approx(expected, rel=1e-6, abs=1e-6)


@pytest.mark.parametrize("case", CASES)
def test_the_error_is_inside_the_bound_and_the_statics_are_exact(case):
    full = diagonalize(*random_matrices(*case))
    for order in range(2, full.n_states, 3):
        reduced = singular_perturbation_balancing(full, order)
        assert largest_error(full, reduced.system) <= reduced.error_bound * (1 + 1e-9) + 1e-9
        assert reduced.system.static_gain() == pytest.approx(full.static_gain(), rel=1e-7, abs=1e-7)


@pytest.mark.parametrize("damping_ratio", [1e-4, 1e-6, 1e-8])
def test_both_states_of_an_oscillator_are_kept_or_none(damping_ratio):
    w = np.arange(1.0, 11.0)
    damped = w * np.sqrt(1 - damping_ratio**2)
    root = np.sqrt(w / (2j * damped))[:, None]
    oscillators = PoleResidueSystem(-damping_ratio * w + 1j * damped, root, root.T.copy(), np.zeros((1, 1)))
    sigma = singular_perturbation_balancing(oscillators, 20).hankel_singular_values
    equal = np.abs(sigma[10] / sigma[11] - 1) < 1e-6
    assert singular_perturbation_balancing(oscillators, 11).order == (10 if equal else 11)
