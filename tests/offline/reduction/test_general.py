"""Reductions of systems that are no body, against SLICOT and pyMOR, their bounds, and systems awkward in one way each."""

import ctrlsys
import numpy as np
import pytest
from pymor.models.iosys import LTIModel
from pymor.reductors.bt import BTReductor

from palpate.lti.block_form import diagonalize
from palpate.lti.errors import ReductionError
from palpate.lti.pole_residue import PoleResidueSystem
from palpate.reduction import METHODS, reduce
from palpate.reduction.balancing import balance
from palpate.reduction.gramians import gramians, real_form

BALANCING = ["tbr", "hankel-optimal"]
WITH_BOUND = [*BALANCING, "modal", "modal-static"]


def random_system(seed, n, n_inputs, n_outputs, damping=1.0):
    rng = np.random.default_rng(seed)
    a = rng.standard_normal((n, n))
    a -= (np.max(np.linalg.eigvals(a).real) + damping) * np.eye(n)
    shapes = (n, n_inputs), (n_outputs, n), (n_outputs, n_inputs)
    return a, *(rng.standard_normal(shape) for shape in shapes)


def chain(n, damping):
    """n masses in a row, tied to each other and to a wall, pushed and seen at the last: 2 n states."""
    stiffness = 2 * np.eye(n) - np.eye(n, k=1) - np.eye(n, k=-1)
    zero, one = np.zeros((n, n)), np.eye(n)
    a = np.block([[zero, one], [-stiffness, -damping * stiffness - 0.01 * damping * one]])
    b = np.zeros((2 * n, 1))
    b[-1] = 1
    c = np.zeros((1, 2 * n))
    c[0, n - 1] = 1
    return a, b, c, np.zeros((1, 1))


MATRICES = {
    "single channel": random_system(0, 12, 1, 1),
    "two by two": random_system(1, 20, 2, 2),
    "more inputs": random_system(2, 25, 4, 1, damping=0.5),
    "more outputs": random_system(3, 25, 2, 3),
    "lightly damped": random_system(4, 30, 2, 2, damping=0.01),
    "chain of masses": chain(15, 0.05),
}
SYSTEMS = {name: diagonalize(*matrices) for name, matrices in MATRICES.items()}


def fortran(name):
    """A, B, C, D; SLICOT overwrites its arguments."""
    return [np.array(x, order="F") for x in MATRICES[name]]


def difference(first, second):
    return PoleResidueSystem(
        np.concatenate([first.poles, second.poles]),
        np.vstack([first.b, second.b]),
        np.hstack([first.c, -second.c]),
        first.d - second.d,
    )


def dense(system):
    form = real_form(system)
    return [np.array(x, order="F") for x in (form.apply(np.eye(system.n_states)), form.b, form.c, form.d)]


def hankel_norm(system):
    """By SLICOT's AB13AD."""
    a, b, c, _ = dense(system)
    return ctrlsys.ab13ad("C", "S", len(a), b.shape[1], len(c), 0.0, a, b, c)[0]


def largest_gain(system):
    s = 1j * np.concatenate([[0.0], np.geomspace(1e-4, 1e4, 500), np.abs(system.poles.imag)])
    return np.max(np.linalg.norm(system.transfer(s), 2, axis=(1, 2)))


def transfer(a, b, c, d, s):
    return np.array([d + c @ np.linalg.solve(point * np.eye(len(a)) - a, b) for point in s])


@pytest.mark.parametrize("name", SYSTEMS)
def test_hankel_singular_values_agree_with_slicot_and_pymor(name):
    found = reduce(SYSTEMS[name], "tbr", order=3).hankel_singular_values
    a, b, c, _ = fortran(name)
    by_pymor = LTIModel.from_matrices(*MATRICES[name]).hsv()
    by_slicot = ctrlsys.ab09ad("C", "B", "S", "F", len(a), b.shape[1], len(c), 3, a, b, c, 0.0)[3]
    # pyMOR's dense route factorizes rounded Gramians, which costs half of the digits.
    for other, least in ((by_slicot, 1e-10), (by_pymor, 1e-4)):
        kept = other > least * other[0]
        assert found[: len(kept)][kept[: len(found)]] == pytest.approx(other[kept], rel=1e-6)


@pytest.mark.parametrize("name", SYSTEMS)
def test_the_balanced_truncation_agrees_with_pymors(name):
    order, s = 4, 1j * np.array([0.0, 0.1, 1.0, 10.0])
    found = reduce(SYSTEMS[name], "tbr", order=order).system.transfer(s)
    other = BTReductor(LTIModel.from_matrices(*MATRICES[name])).reduce(order, projection="sr")
    expected = np.array([other.transfer_function.eval_tf(point) for point in s])
    assert found == pytest.approx(expected, rel=1e-6, abs=1e-6 * largest_gain(SYSTEMS[name]))


@pytest.mark.parametrize("method", WITH_BOUND)
@pytest.mark.parametrize("name", SYSTEMS)
def test_every_error_is_inside_its_bound_at_every_order(name, method):
    system = SYSTEMS[name]
    gain = largest_gain(system)
    for order in range(2, system.n_states):
        reduced = reduce(system, method, order=order)
        assert reduced.order <= order
        assert reduced.system.spectral_abscissa < 0
        assert largest_gain(difference(system, reduced.system)) <= reduced.error_bound + 1e-10 * gain


def hankel_optimal_errors(system):
    """(ratio sigma_{r+1} / sigma_1, relative difference of the error's Hankel norm from sigma_{r+1}) for every order r."""
    found = []
    for order in range(1, system.n_states):
        reduced = reduce(system, "hankel-optimal", order=order)
        sigma = reduced.hankel_singular_values
        if reduced.order < order or order >= len(sigma) or sigma[order] < 1e-9 * sigma[0]:
            break
        error = hankel_norm(difference(system, reduced.system))
        found.append((sigma[order] / sigma[0], abs(error / sigma[order] - 1)))
    return np.array(found)


@pytest.mark.parametrize("name", SYSTEMS)
def test_glovers_equality_holds_as_far_as_the_docstring_says(name):
    ratio, deviation = hankel_optimal_errors(SYSTEMS[name]).T
    assert np.count_nonzero(ratio > 1e-5) >= 3
    assert np.max(deviation[ratio > 1e-5]) < 1e-6
    assert np.max(deviation[ratio > 1e-7], initial=0.0) < 1e-2


@pytest.mark.parametrize("name", ["single channel", "chain of masses"])
def test_the_hankel_optimal_system_of_one_channel_is_slicots(name):
    order, s = 4, 1j * np.array([0.0, 0.1, 1.0, 10.0])
    n = len(MATRICES[name][0])
    ar, br, cr, *_ = ctrlsys.ab09cd("C", "N", "F", n, 1, 1, order, *fortran(name), 0.0, 0.0)
    found = reduce(SYSTEMS[name], "hankel-optimal", order=order).system
    expected = transfer(ar[:order, :order], br[:order], cr[:, :order], 0.0, s)
    strictly_proper = found.transfer(s) - found.d  # D is free: the Hankel norm does not see it
    assert strictly_proper == pytest.approx(expected, rel=1e-6, abs=1e-6 * np.max(np.abs(expected)))


def test_hankel_optimal_beats_balanced_truncation_in_the_hankel_norm():
    system = SYSTEMS["two by two"]
    for order in (2, 5, 8):
        optimal, truncated = (
            hankel_norm(difference(system, reduce(system, method, order=order).system))
            for method in ("hankel-optimal", "tbr")
        )
        assert optimal < 0.999 * truncated


def test_an_order_between_equal_singular_values_goes_down_to_where_they_differ():
    single = SYSTEMS["single channel"]
    zero_b, zero_c = np.zeros_like(single.b), np.zeros_like(single.c)
    twin = PoleResidueSystem(
        np.tile(single.poles, 2),
        np.block([[single.b, zero_b], [zero_b, single.b]]),
        np.block([[single.c, zero_c], [zero_c, single.c]]),
        np.zeros((2, 2)),
    )
    # Balancing in doubles: the two copies of a singular value differ by round-off.
    sigma = balance(real_form(twin), gramians(twin)).sigma
    assert sigma[4] == pytest.approx(sigma[5], rel=1e-9)
    reduced = reduce(twin, "hankel-optimal", order=5)
    assert reduced.order == 4
    assert hankel_norm(difference(twin, reduced.system)) == pytest.approx(sigma[4], rel=1e-6)


@pytest.mark.parametrize("method", BALANCING)
def test_an_order_down_in_the_round_off_goes_down_to_what_is_left(method):
    system = SYSTEMS["two by two"]
    more = -np.arange(1.0, 11.0) + 0j
    padded = PoleResidueSystem(  # ten states that no input reaches
        np.concatenate([system.poles, more]),
        np.vstack([system.b, np.zeros((10, 2))]),
        np.hstack([system.c, np.ones((2, 10))]),
        system.d,
    )
    reduced = reduce(padded, method, order=29)
    assert reduced.order <= 20
    assert largest_gain(difference(system, reduced.system)) < 1e-8 * largest_gain(system)


@pytest.mark.parametrize("coupling", [1e-4, 1e-8])
@pytest.mark.parametrize("method", BALANCING)
def test_a_nearly_uncontrollable_state_is_dropped_and_the_bound_still_holds(coupling, method):
    system = SYSTEMS["two by two"]
    near = PoleResidueSystem(
        np.append(system.poles, -0.01),
        np.vstack([system.b, coupling * np.ones((1, 2))]),
        np.hstack([system.c, np.ones((2, 1))]),
        system.d,
    )
    reduced = reduce(near, method, order=12)
    error = largest_gain(difference(near, reduced.system))
    assert error <= reduced.error_bound + 1e-10 * largest_gain(near)


def test_modal_truncation_without_modes_keeps_the_slowest_poles_and_whole_pairs():
    system = SYSTEMS["chain of masses"]
    reduced = reduce(system, "modal", order=7)
    assert reduced.order == 6
    assert np.sort(np.abs(reduced.system.poles)) == pytest.approx(np.sort(np.abs(system.poles))[:3], rel=1e-8)


@pytest.mark.parametrize("size", [{"order": 3}, {"tolerance": 1e-3}], ids=["order", "tolerance"])
@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize(
    ("n", "m", "p", "gain"),
    [(2, 2, 3, 0.0), (0, 2, 3, 1.0), (2, 0, 3, 1.0), (2, 2, 0, 1.0)],
    ids=["zero B", "no states", "no inputs", "no outputs"],
)
def test_a_system_that_passes_nothing_on_reduces_to_its_d(n, m, p, gain, method, size):
    system = PoleResidueSystem(
        np.array([-1, -2 + 3j])[:n],
        np.full((n, m), gain, dtype=complex),
        np.ones((p, n), dtype=complex),
        np.ones((p, m)),
    )
    reduced = reduce(system, method, **size, band_hz=(0.0, 1.0))
    assert reduced.order == 0 or method.startswith("modal")
    assert np.array_equal(reduced.system.d, system.d)
    assert reduced.error_bound in (0.0, None)


@pytest.mark.parametrize("method", METHODS)
def test_an_order_that_is_no_whole_number_is_refused(method):
    with pytest.raises(ValueError, match=r"order = 2\.5: expected a whole number"):
        reduce(SYSTEMS["two by two"], method, order=2.5)


def oscillators(damping_ratio):
    """Ten of 1, 2, ..., 10 rad/s, pushed and seen together: (system, its transfer function in closed form)."""
    w = np.arange(1.0, 11.0)
    damped = w * np.sqrt(1 - damping_ratio**2)
    poles = -damping_ratio * w + 1j * damped
    root = np.sqrt(w / (2j * damped))[:, None]
    system = PoleResidueSystem(poles, root, root.T.copy(), np.zeros((1, 1)))

    def closed_form(s):
        s = s[:, None]
        return np.sum(w / (s**2 + 2 * damping_ratio * w * s + w**2), axis=1)

    return system, closed_form


def around_the_resonances(damping_ratio, reduced):
    """Frequencies, rad/s."""
    near = 1 + damping_ratio * np.linspace(-5, 5, 41)
    own = np.abs(reduced.system.poles.imag)
    return np.concatenate([[0.0], np.linspace(0.01, 12, 400), np.outer(np.arange(1, 11), near).ravel(), own])


@pytest.mark.parametrize("method", WITH_BOUND)
@pytest.mark.parametrize("damping_ratio", [1e-2, 1e-4, 1e-6, 1e-8, 1e-9])
def test_lightly_damped_oscillators_keep_to_the_bound_or_are_refused(damping_ratio, method):
    system, closed_form = oscillators(damping_ratio)
    refused = 0
    for order in range(2, 21):
        try:
            reduced = reduce(system, method, order=order)
        except ReductionError as error:
            assert "too lightly damped" in str(error) or "spectral abscissa" in str(error)
            refused += 1
            continue
        omega = around_the_resonances(damping_ratio, reduced)
        exact = closed_form(1j * omega)
        error = np.max(np.abs(reduced.system.transfer(1j * omega)[:, 0, 0] - exact))
        # Round-off moves a pole p by about 1e-16 |p|, times the algorithm's constant, and so its peak by that over |Re p|.
        round_off = 1e-13 / damping_ratio * np.max(np.abs(exact))
        assert error <= reduced.error_bound + round_off, order
    assert refused == 0 or (damping_ratio == 1e-9 and refused <= 3)


@pytest.mark.parametrize("damping_ratio", [1e-4, 1e-6, 1e-8])
def test_band_limited_truncation_does_not_step_over_narrow_resonances(damping_ratio):
    system, closed_form = oscillators(damping_ratio)
    # the six oscillators below 2 pi rad/s
    reduced = reduce(system, "tbr-band", order=12, band_hz=(0.0, 1.0))
    omega = around_the_resonances(damping_ratio, reduced)
    omega = omega[omega < 2 * np.pi]
    exact = closed_form(1j * omega)
    largest = np.max(np.abs(exact))
    error = np.max(np.abs(reduced.system.transfer(1j * omega)[:, 0, 0] - exact))
    # The other four answer with 1.2 up there, off their resonance; the highest peak is 1 / (2 damping ratio).
    assert error < 4 * 2.4 * damping_ratio * largest + 1e-13 / damping_ratio * largest


def test_band_limited_truncation_is_better_in_its_band_than_balanced_truncation():
    system = diagonalize(*chain(40, 0.02))
    band_hz = (0.0, 0.05)
    s = 2j * np.pi * np.linspace(*band_hz, 400)
    exact = system.transfer(s)

    def error(reduced):
        return np.max(np.abs(reduced.system.transfer(s) - exact) / np.abs(exact))

    limited = reduce(system, "tbr-band", order=16, band_hz=band_hz)
    assert error(limited) < 0.1 * error(reduce(system, "tbr", order=16))
