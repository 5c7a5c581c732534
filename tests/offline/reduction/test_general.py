"""The general reductions against SLICOT and pyMOR, their bounds, and systems that are awkward in one way each."""

import ctrlsys
import numpy as np
import pytest
import scipy.linalg
import scipy.sparse
from pymor.models.iosys import LTIModel
from pymor.reductors.bt import BTReductor

from palpate.lti.errors import ReductionError
from palpate.lti.pole_residue import DiagonalSystem
from palpate.reduction.gramians import real_form
from palpate.reduction.hammarling import gramian_factors
from palpate.reduction.hankel_optimal import hankel_optimal
from palpate.reduction.linear_system import LinearSystem, parallel, split
from palpate.reduction.low_rank_adi import NotConvergedError, low_rank_factor
from palpate.reduction.truncation import (
    balanced_truncation,
    band_limited_truncation,
    modal_truncation,
    singular_perturbation_balancing,
)

WITH_BOUND = [balanced_truncation, singular_perturbation_balancing, hankel_optimal, modal_truncation]
BALANCING = [balanced_truncation, singular_perturbation_balancing, hankel_optimal]


def random_system(seed, n, n_inputs, n_outputs, damping=1.0):
    rng = np.random.default_rng(seed)
    a = rng.standard_normal((n, n))
    a -= (np.max(np.linalg.eigvals(a).real) + damping) * np.eye(n)
    shapes = (n, n_inputs), (n_outputs, n), (n_outputs, n_inputs)
    return LinearSystem(a, *(rng.standard_normal(shape) for shape in shapes))


def chain(n, damping):
    """n masses in a row, tied to each other and to a wall, pushed and seen at the last: 2 n states."""
    stiffness = 2 * np.eye(n) - np.eye(n, k=1) - np.eye(n, k=-1)
    zero, one = np.zeros((n, n)), np.eye(n)
    a = np.block([[zero, one], [-stiffness, -damping * stiffness - 0.01 * damping * one]])
    b = np.zeros((2 * n, 1))
    b[-1] = 1
    c = np.zeros((1, 2 * n))
    c[0, n - 1] = 1
    return LinearSystem(a, b, c, np.zeros((1, 1)))


def jordan(n):
    """One pole at -1, n times, with a single eigenvector."""
    b, c = np.zeros((n, 1)), np.zeros((1, n))
    b[-1], c[0, 0] = 1, 1
    return LinearSystem(-np.eye(n) + np.eye(n, k=1), b, c, np.ones((1, 1)))


SYSTEMS = {
    "single channel": random_system(0, 12, 1, 1),
    "two by two": random_system(1, 20, 2, 2),
    "more inputs": random_system(2, 25, 4, 1, damping=0.5),
    "more outputs": random_system(3, 25, 2, 3),
    "lightly damped": random_system(4, 30, 2, 2, damping=0.01),
    "chain of masses": chain(15, 0.05),
    "defective": jordan(6),
}


def matrices(system):
    return [np.array(x, order="F") for x in (system.a, system.b, system.c, system.d)]


def hankel_norm(system):
    """By SLICOT's AB13AD."""
    a, b, c, _ = matrices(system)
    return ctrlsys.ab13ad("C", "S", len(a), b.shape[1], len(c), 0.0, a, b, c)[0]


def difference(first, second):
    return parallel(first, LinearSystem(second.a, second.b, -second.c, -second.d))


def largest_gain(system):
    s = 1j * np.concatenate([[0.0], np.geomspace(1e-4, 1e4, 500), np.abs(system.poles.imag)])
    return np.max(np.linalg.norm(system.transfer(s), 2, axis=(1, 2)))


@pytest.mark.parametrize("name", SYSTEMS)
def test_hammarlings_factors_solve_the_lyapunov_equations(name):
    a, b, c, _ = matrices(SYSTEMS[name])
    control, observe = gramian_factors(SYSTEMS[name])
    for factor, matrix, rhs in ((control, a, b @ b.T), (observe, a.T, c.T @ c)):
        gramian = factor @ factor.T
        residual = matrix @ gramian + gramian @ matrix.T + rhs
        scale = 2 * np.linalg.norm(matrix) * np.linalg.norm(gramian) + np.linalg.norm(rhs)
        assert np.linalg.norm(residual) < 1e-13 * scale


@pytest.mark.parametrize("name", SYSTEMS)
def test_hankel_singular_values_agree_with_slicot_and_pymor(name):
    system = SYSTEMS[name]
    found = balanced_truncation(system, 3).hankel_singular_values
    a, b, c, _ = matrices(system)  # SLICOT overwrites its arguments
    by_pymor = LTIModel.from_matrices(system.a, system.b, system.c, system.d).hsv()
    by_slicot = ctrlsys.ab09ad("C", "B", "S", "F", len(a), b.shape[1], len(c), 3, a, b, c, 0.0)[3]
    # pyMOR's dense route factorizes rounded Gramians, which costs half of the digits.
    for other, least in ((by_slicot, 1e-10), (by_pymor, 1e-4)):
        kept = other > least * other[0]
        assert found[: len(kept)][kept[: len(found)]] == pytest.approx(other[kept], rel=1e-6)


@pytest.mark.parametrize("name", SYSTEMS)
def test_transfer_functions_of_the_reduced_systems_agree_with_slicots_and_pymors(name):
    system = SYSTEMS[name]
    order = 4
    n, m, p = system.n_states, system.n_inputs, system.n_outputs
    s = 1j * np.array([0.0, 0.1, 1.0, 10.0])
    tolerance = {"rel": 1e-6, "abs": 1e-6 * largest_gain(system)}

    found = balanced_truncation(system, order).system.transfer(s)
    other = BTReductor(LTIModel.from_matrices(system.a, system.b, system.c, system.d)).reduce(
        order, projection="sr"
    )
    expected = np.array([other.transfer_function.eval_tf(point) for point in s])
    assert found == pytest.approx(expected, **tolerance)

    a, b, c, d = matrices(system)
    ar, br, cr, dr, *_ = ctrlsys.ab09bd("C", "B", "N", "F", n, m, p, order, a, b, c, d, 0.0, 0.0)
    expected = LinearSystem(ar[:order, :order], br[:order], cr[:, :order], dr).transfer(s)
    found = singular_perturbation_balancing(system, order).system.transfer(s)
    assert found == pytest.approx(expected, **tolerance)


@pytest.mark.parametrize("name", SYSTEMS)
def test_every_error_is_inside_its_bound_at_every_order(name):
    system = SYSTEMS[name]
    gain = largest_gain(system)
    for method in WITH_BOUND:
        if name == "defective" and method is modal_truncation:
            continue
        for order in range(2, system.n_states):
            reduced = method(system, order)
            assert reduced.order <= order
            assert reduced.system.spectral_abscissa < 0
            assert largest_gain(difference(system, reduced.system)) <= reduced.error_bound + 1e-10 * gain


@pytest.mark.parametrize("name", SYSTEMS)
def test_the_hankel_norm_of_the_hankel_optimal_error_is_the_next_singular_value(name):
    system = SYSTEMS[name]
    checked = 0
    for order in range(1, system.n_states):
        reduced = hankel_optimal(system, order)
        sigma = reduced.hankel_singular_values
        if reduced.order < order or sigma[order] < 1e-5 * sigma[0]:
            break  # round-off, about 1e-12 sigma_1, is no longer a millionth of the error
        error = hankel_norm(difference(system, reduced.system))
        assert error == pytest.approx(sigma[order], rel=1e-6)
        checked += 1
    assert checked >= 3


@pytest.mark.parametrize("name", ["single channel", "chain of masses", "defective"])
def test_the_hankel_optimal_system_of_one_channel_is_slicots(name):
    system = SYSTEMS[name]
    order = 4
    ar, br, cr, *_ = ctrlsys.ab09cd("C", "N", "F", system.n_states, 1, 1, order, *matrices(system), 0.0, 0.0)
    found = hankel_optimal(system, order).system
    s = 1j * np.array([0.0, 0.1, 1.0, 10.0])
    zero = np.zeros((1, 1))  # D is free: the Hankel norm does not see it
    expected = LinearSystem(ar[:order, :order], br[:order], cr[:, :order], zero).transfer(s)
    strictly_proper = LinearSystem(found.a, found.b, found.c, zero).transfer(s)
    assert strictly_proper == pytest.approx(expected, rel=1e-6, abs=1e-6 * np.max(np.abs(expected)))


def test_hankel_optimal_beats_balanced_truncation_in_the_hankel_norm():
    system = SYSTEMS["two by two"]
    for order in (2, 5, 8):
        optimal = hankel_norm(difference(system, hankel_optimal(system, order).system))
        truncated = hankel_norm(difference(system, balanced_truncation(system, order).system))
        assert optimal < 0.999 * truncated


def test_an_order_between_equal_singular_values_goes_down_to_where_they_differ():
    single = SYSTEMS["single channel"]
    twice = parallel(single, single)
    twin = LinearSystem(
        twice.a,
        scipy.linalg.block_diag(single.b, single.b),
        scipy.linalg.block_diag(single.c, single.c),
        np.zeros((2, 2)),
    )
    reduced = hankel_optimal(twin, 5)
    assert reduced.order == 4
    sigma = reduced.hankel_singular_values
    assert sigma[4] == pytest.approx(sigma[5], rel=1e-9)
    assert hankel_norm(difference(twin, reduced.system)) == pytest.approx(sigma[4], rel=1e-6)


@pytest.mark.parametrize("method", BALANCING)
def test_an_order_down_in_the_round_off_goes_down_to_what_is_left(method):
    system = SYSTEMS["two by two"]
    b = np.vstack([system.b, np.zeros((10, 2))])  # ten states that no input reaches
    a = scipy.linalg.block_diag(system.a, -np.diag(np.arange(1.0, 11.0)))
    a[:20, 20:] = np.random.default_rng(5).standard_normal((20, 10))
    c = np.hstack([system.c, np.ones((2, 10))])
    padded = LinearSystem(a, b, c, system.d)
    reduced = method(padded, 29)
    assert reduced.order <= 20
    assert largest_gain(difference(system, reduced.system)) < 1e-8 * largest_gain(system)


@pytest.mark.parametrize("coupling", [1e-4, 1e-8])
def test_a_nearly_uncontrollable_state_is_dropped_and_the_bound_still_holds(coupling):
    system = SYSTEMS["two by two"]
    a = scipy.linalg.block_diag(system.a, [[-0.01]])
    near = LinearSystem(
        a, np.vstack([system.b, coupling * np.ones((1, 2))]), np.hstack([system.c, np.ones((2, 1))]), system.d
    )
    for method in BALANCING:
        reduced = method(near, 12)
        error = largest_gain(difference(near, reduced.system))
        assert error <= reduced.error_bound + 1e-10 * largest_gain(near)


@pytest.mark.parametrize("name", SYSTEMS)
def test_singular_perturbation_and_residual_statics_are_exact_at_zero(name):
    system = SYSTEMS[name]
    zero = np.zeros(1, dtype=complex)
    exact = system.transfer(zero)
    close = {"abs": 1e-9 * np.max(np.abs(exact))}
    assert singular_perturbation_balancing(system, 4).system.transfer(zero) == pytest.approx(exact, **close)
    if name != "defective":
        reduced = modal_truncation(system, 4, keep_statics=True)
        assert reduced.system.transfer(zero) == pytest.approx(exact, **close)
        assert largest_gain(difference(system, reduced.system)) <= reduced.error_bound * (1 + 1e-9)


def test_modal_truncation_keeps_the_slowest_poles_and_whole_pairs():
    system = SYSTEMS["chain of masses"]
    reduced = modal_truncation(system, 7)
    ascending = np.sort(np.abs(system.poles))
    assert reduced.order == 6
    assert np.sort(np.abs(reduced.system.poles)) == pytest.approx(ascending[:6], rel=1e-8)


def test_modal_truncation_of_a_defective_matrix_is_refused():
    with pytest.raises(ValueError, match="condition number"):
        modal_truncation(SYSTEMS["defective"], 3)


@pytest.mark.parametrize("method", WITH_BOUND)
def test_a_tolerance_bounds_the_relative_error(method):
    system = SYSTEMS["chain of masses"]
    for tolerance in (0.3, 0.01):
        reduced = method(system, tolerance=tolerance)
        error = largest_gain(difference(system, reduced.system)) / largest_gain(system)
        limit = tolerance if method is not hankel_optimal else reduced.error_bound / largest_gain(system)
        assert error <= limit * (1 + 1e-9)
    assert reduced.order < system.n_states


def test_band_limited_truncation_is_better_in_its_band_than_balanced_truncation():
    system = chain(40, 0.02)
    band_hz = (0.0, 0.05)
    s = 2j * np.pi * np.linspace(*band_hz, 400)
    exact = system.transfer(s)

    def error(reduced):
        return np.max(np.abs(reduced.system.transfer(s) - exact) / np.abs(exact))

    limited = band_limited_truncation(system, band_hz, 16)
    assert error(limited) < 0.1 * error(balanced_truncation(system, 16))
    assert limited.error_bound is None
    by_tolerance = band_limited_truncation(system, band_hz, tolerance=0.02)
    assert error(by_tolerance) <= 0.02 * 1.01
    assert error(band_limited_truncation(system, band_hz, by_tolerance.order - 1)) > 0.02


def test_a_diagonal_system_reduces_to_the_same_as_its_matrices():
    rng = np.random.default_rng(6)
    poles = np.concatenate(
        [-rng.uniform(0.1, 5, 4) + 0j, -rng.uniform(0.1, 1, 8) + 1j * rng.uniform(1, 20, 8)]
    )
    b = rng.standard_normal((12, 2)) + 1j * rng.standard_normal((12, 2))
    c = rng.standard_normal((3, 12)) + 1j * rng.standard_normal((3, 12))
    b[:4].imag, c[:, :4].imag = 0, 0
    diagonal = DiagonalSystem(poles, b, c, rng.standard_normal((3, 2)), np.arange(12))
    form = real_form(diagonal)
    plain = LinearSystem(form.apply(np.eye(20)), form.b, form.c, form.d)
    s = 1j * np.array([0.0, 1.0, 7.0, 50.0])
    for method in WITH_BOUND:
        one, other = method(diagonal, 8), method(plain, 8)
        assert one.system.transfer(s) == pytest.approx(other.system.transfer(s), rel=1e-7, abs=1e-7)
        assert one.error_bound == pytest.approx(other.error_bound, rel=1e-6)
    one, other = (band_limited_truncation(x, (0.0, 1.0), 8) for x in (diagonal, plain))
    assert one.system.transfer(s) == pytest.approx(other.system.transfer(s), rel=1e-6, abs=1e-6)


@pytest.mark.parametrize(
    "method", [*WITH_BOUND, lambda s, r, **k: band_limited_truncation(s, (0.0, 1.0), r, **k)]
)
def test_an_unstable_system_is_refused_or_split_as_the_caller_says(method):
    stable = SYSTEMS["two by two"]
    growing = LinearSystem(
        np.array([[0.3, 2.0], [-2.0, 0.3]]), np.ones((2, 2)), np.ones((2, 2)), np.zeros((2, 2))
    )
    mixed = parallel(stable, growing)
    basis = np.linalg.qr(np.random.default_rng(7).standard_normal((22, 22)))[0]
    mixed = LinearSystem(basis @ mixed.a @ basis.T, basis @ mixed.b, mixed.c @ basis.T, mixed.d)
    with pytest.raises(ReductionError, match=r"spectral abscissa is 0\.3 1/s"):
        method(mixed, 10)
    reduced = method(mixed, 10, unstable="split")
    assert reduced.order <= 10
    kept = reduced.system.poles[reduced.system.poles.real > 0]
    assert np.sort_complex(kept) == pytest.approx(np.array([0.3 - 2j, 0.3 + 2j]), rel=1e-8)
    s = 1j * np.array([0.0, 0.5, 3.0])
    alone = method(stable, reduced.order - 2).system.transfer(s) + growing.transfer(s)
    assert reduced.system.transfer(s) == pytest.approx(alone, rel=1e-6, abs=1e-6)


def test_an_undamped_system_is_refused_even_where_round_off_moves_its_poles_to_the_left():
    undamped = chain(20, 0.0)
    assert np.any(undamped.poles.real < 0)
    for method in WITH_BOUND:
        with pytest.raises(ReductionError, match="not stable"):
            method(undamped, 6)


def test_splitting_and_adding_gives_the_system_back():
    system = random_system(8, 15, 2, 3, damping=-2.0)
    stable, rest = split(system)
    assert stable.spectral_abscissa < 0 <= np.min(rest.poles.real)
    assert stable.n_states + rest.n_states == 15
    s = 1j * np.array([0.0, 1.0, 30.0])
    assert parallel(stable, rest).transfer(s) == pytest.approx(system.transfer(s), rel=1e-9)


def test_a_mass_matrix_gives_the_same_reduction_as_its_inverse_multiplied():
    plain = SYSTEMS["two by two"]
    e = np.eye(20) + 0.3 * np.random.default_rng(9).standard_normal((20, 20)) / np.sqrt(20)
    with_mass = LinearSystem(e @ plain.a, e @ plain.b, plain.c, plain.d, e)
    s = 1j * np.array([0.0, 1.0, 10.0])
    assert with_mass.transfer(s) == pytest.approx(plain.transfer(s), rel=1e-9)
    for method in WITH_BOUND:
        assert method(with_mass, 7).system.transfer(s) == pytest.approx(
            method(plain, 7).system.transfer(s), rel=1e-6
        )
    singular = e.copy()
    singular[:, 0] = singular[:, 1]
    with pytest.raises(ValueError, match="e is singular"):
        balanced_truncation(LinearSystem(plain.a, plain.b, plain.c, plain.d, singular), 7)


def heat_in_a_box(n):
    """Finite differences of the heat equation on n³ points with a mass matrix; heated and seen at two places."""
    line = scipy.sparse.diags_array([1.0, -2.0, 1.0], offsets=(-1, 0, 1), shape=(n, n)) * (n + 1) ** 2
    one = scipy.sparse.eye_array(n)
    a = (
        scipy.sparse.kron(scipy.sparse.kron(line, one), one)
        + scipy.sparse.kron(scipy.sparse.kron(one, line), one)
        + scipy.sparse.kron(scipy.sparse.kron(one, one), line)
    )
    e = scipy.sparse.diags_array(np.linspace(1, 2, n**3))
    b = np.zeros((n**3, 2))
    b[n**3 // 3, 0], b[n**3 // 2, 1] = 1, 1
    c = np.zeros((1, n**3))
    c[0, n**3 // 2 + 1] = 1
    return LinearSystem(scipy.sparse.csc_array(a), b, c, np.zeros((1, 2)), scipy.sparse.csc_array(e))


def test_a_sparse_system_reduces_by_low_rank_factors_as_by_dense_ones():
    from palpate.reduction import truncation

    system = heat_in_a_box(8)
    dense = balanced_truncation(system, 6)
    factor = low_rank_factor(system.a, system.e, system.b)
    gramian = factor @ factor.T
    a, e = system.a.toarray(), system.e.toarray()
    residual = a @ gramian @ e.T + e @ gramian @ a.T + system.b @ system.b.T
    assert np.linalg.norm(residual) < 1e-8 * np.linalg.norm(system.b @ system.b.T)
    before = truncation.DENSE_STATES
    try:
        truncation.DENSE_STATES = 100
        low_rank = balanced_truncation(system, 6)
    finally:
        truncation.DENSE_STATES = before
    kept = dense.hankel_singular_values > 1e-5 * dense.hankel_singular_values[0]
    assert low_rank.hankel_singular_values[: len(kept)][kept[: len(low_rank.hankel_singular_values)]] == (
        pytest.approx(dense.hankel_singular_values[kept], rel=1e-5)
    )
    s = 1j * np.array([0.0, 1.0, 100.0])
    assert low_rank.system.transfer(s) == pytest.approx(dense.system.transfer(s), rel=1e-5, abs=1e-9)
    assert np.max(np.abs(low_rank.system.transfer(s) - system.transfer(s))) <= low_rank.error_bound


def test_a_low_rank_iteration_that_does_not_converge_is_an_error():
    wave = chain(150, 1e-7)
    with pytest.raises(NotConvergedError, match="lightly damped"):
        low_rank_factor(scipy.sparse.csc_array(wave.a), None, wave.b, max_columns=60)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"order": 3, "tolerance": 0.1}, "exactly one"),
        ({}, "exactly one"),
        ({"order": 0}, "order = 0"),
        ({"tolerance": 0.0}, r"tolerance = 0\.0"),
        ({"order": 3, "unstable": "drop"}, "unstable = 'drop'"),
    ],
)
def test_arguments_out_of_range_are_named(change, message):
    with pytest.raises(ValueError, match=message):
        balanced_truncation(SYSTEMS["two by two"], **change)


def test_a_tolerance_below_what_round_off_leaves_is_an_error():
    system = SYSTEMS["more inputs"]
    sigma = balanced_truncation(system, 1).hankel_singular_values
    assert sigma[-1] < 1e-14 * sigma[0]
    with pytest.raises(ReductionError, match="least above round-off"):
        balanced_truncation(system, tolerance=1e-17)


def test_matrices_that_do_not_fit_are_named():
    with pytest.raises(ValueError, match=r"c has shape \(1, 3\): expected \(1, 2\)"):
        LinearSystem(-np.eye(2), np.ones((2, 1)), np.ones((1, 3)), np.ones((1, 1)))
    with pytest.raises(ValueError, match="a holds values that are not finite"):
        LinearSystem(np.full((2, 2), np.nan), np.ones((2, 1)), np.ones((1, 2)), np.ones((1, 1)))


def empty(n_states, n_inputs, n_outputs):
    """A system that does nothing: no input, no output, or nothing in B or C, by its shape."""
    shapes = (n_states, n_inputs), (n_outputs, n_states), (n_outputs, n_inputs)
    return LinearSystem(-np.diag(np.arange(1.0, n_states + 1)), *(np.zeros(shape) for shape in shapes))


def with_fields(system, **fields):
    return LinearSystem(**({name: getattr(system, name) for name in "abcde"} | fields))


PASSING_NOTHING = {
    "zero B": with_fields(SYSTEMS["two by two"], b=np.zeros((20, 2))),
    "zero C": with_fields(SYSTEMS["two by two"], c=np.zeros((2, 20))),
    "no states": LinearSystem(np.zeros((0, 0)), np.zeros((0, 2)), np.zeros((3, 0)), np.ones((3, 2))),
    "no inputs": empty(4, 0, 2),
    "no outputs": empty(4, 2, 0),
    "zero D as well": empty(4, 2, 2),
}


def band_limited(system, order=None, tolerance=None, **options):
    return band_limited_truncation(system, (0.0, 1.0), order, tolerance, **options)


@pytest.mark.parametrize("size", [{"order": 3}, {"tolerance": 1e-3}], ids=["order", "tolerance"])
@pytest.mark.parametrize("method", [*BALANCING, band_limited])
@pytest.mark.parametrize("name", PASSING_NOTHING)
def test_a_system_whose_states_pass_nothing_on_reduces_to_its_d(name, method, size):
    system = PASSING_NOTHING[name]
    reduced = method(system, **size)
    assert reduced.order == 0
    assert np.array_equal(reduced.system.d, system.d)
    assert reduced.error_bound in (0.0, None)


@pytest.mark.parametrize("size", [{"order": 3}, {"tolerance": 1e-3}], ids=["order", "tolerance"])
@pytest.mark.parametrize("method", [*WITH_BOUND, band_limited])
def test_a_wholly_unstable_system_is_its_own_reduction_when_split(method, size):
    growing = LinearSystem(np.diag([1.0, 2.0, 3.0]), np.ones((3, 1)), np.ones((1, 3)), np.ones((1, 1)))
    reduced = method(growing, **size, unstable="split")
    s = 1j * np.array([0.0, 1.0, 10.0])
    assert reduced.order == 3
    assert reduced.system.transfer(s) == pytest.approx(growing.transfer(s), rel=1e-12)


@pytest.mark.parametrize("method", [*WITH_BOUND, band_limited])
def test_an_order_that_is_no_whole_number_is_refused(method):
    with pytest.raises(ValueError, match=r"order = 2\.5: expected a whole number"):
        method(SYSTEMS["two by two"], 2.5)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"a": -1j * np.eye(20)}, "a holds values of type complex128: expected real"),
        ({"a": scipy.sparse.csc_array(-1j * np.eye(20))}, "a holds values of type complex128: expected real"),
        ({"e": np.eye(20, dtype=complex)}, "e holds values of type complex128"),
        ({"d": np.zeros((2, 2), dtype=bool)}, "d holds values of type bool"),
        ({"b": scipy.sparse.csc_array(np.ones((20, 2)))}, "b is a csc_array: expected a NumPy array"),
        ({"c": [[1.0] * 20] * 2}, "c is a list: expected a NumPy array"),
        ({"a": [[1.0]]}, "a is a list: expected a NumPy array or a SciPy sparse array"),
        ({"a": None}, "a is a NoneType"),
        ({"b": np.ones(20)}, r"b has shape \(20,\): expected a matrix"),
        ({"c": np.ones((2, 20, 1))}, r"c has shape \(2, 20, 1\): expected a matrix"),
        ({"a": scipy.sparse.lil_array(np.full((20, 20), np.inf))}, "a holds values that are not finite"),
    ],
)
def test_a_field_that_is_no_real_matrix_of_the_right_kind_is_named(fields, message):
    with pytest.raises(ValueError, match=message):
        with_fields(SYSTEMS["two by two"], **fields)


@pytest.fixture
def low_rank_above_twenty_states(monkeypatch):
    monkeypatch.setattr("palpate.reduction.truncation.DENSE_STATES", 20)


def heated_rod_beside(block):
    """Sparse: the heat equation on 60 points, poles -10 to -15,000 1/s, and beside it a block of its own."""
    rod = scipy.sparse.diags_array([1.0, -2.0, 1.0], offsets=(-1, 0, 1), shape=(60, 60)) * 61**2
    a = scipy.sparse.csc_array(scipy.sparse.block_diag([rod, np.array(block)]))
    b = np.zeros((a.shape[0], 1))
    b[20], b[60:] = 1, 1
    return LinearSystem(a, b, np.ascontiguousarray(b.T), np.zeros((1, 1)))


UNSTABLE_BLOCKS = {
    "among the fast poles": [[500.0]],
    "faster than all": [[1e6]],
    "slow": [[1e-3]],
    "an integrator": [[0.0]],
    "undamped": [[0.0, 50.0], [-50.0, 0.0]],
    "a growing oscillation": [[30.0, 2000.0], [-2000.0, 30.0]],
}


@pytest.mark.usefixtures("low_rank_above_twenty_states")
@pytest.mark.parametrize("method", [*WITH_BOUND, band_limited])
@pytest.mark.parametrize("name", UNSTABLE_BLOCKS)
def test_a_large_sparse_system_that_is_not_stable_is_refused(name, method):
    system = heated_rod_beside(UNSTABLE_BLOCKS[name])
    with pytest.raises(ReductionError, match="not stable"):
        method(system, 5)
    if method is modal_truncation:  # dense all the same
        s = 1j * np.array([1.0, 100.0])
        reduced = method(system, 50, unstable="split")
        error = np.max(np.abs(reduced.system.transfer(s) - system.transfer(s)))
        assert error <= reduced.error_bound
    else:
        with pytest.raises(ReductionError, match="expected a dense one, or at most 20 states"):
            method(system, 5, unstable="split")


@pytest.mark.parametrize("pole", [500.0, 1e-3, 1e6])
def test_the_low_rank_iteration_itself_does_not_converge_for_an_unstable_system(pole):
    system = heated_rod_beside([[pole]])
    with pytest.raises(NotConvergedError, match="not stable"):
        low_rank_factor(system.a, None, system.b)


@pytest.mark.usefixtures("low_rank_above_twenty_states")
@pytest.mark.parametrize("method", [*BALANCING, band_limited])
@pytest.mark.parametrize("size", [{"order": 3}, {"tolerance": 1e-3}], ids=["order", "tolerance"])
@pytest.mark.parametrize(
    "fields",
    [
        {"b": np.zeros((61, 1))},
        {"c": np.zeros((1, 61))},
        {"b": np.zeros((61, 0)), "d": np.zeros((1, 0))},
        {"c": np.zeros((0, 61)), "d": np.zeros((0, 1))},
    ],
    ids=["zero B", "zero C", "no inputs", "no outputs"],
)
def test_a_large_sparse_system_that_passes_nothing_on_reduces_to_its_d(fields, size, method):
    system = with_fields(heated_rod_beside([[-1.0]]), **fields)
    reduced = method(system, **size)
    assert reduced.order == 0
    assert reduced.error_bound in (0.0, None)


def oscillators(damping_ratio):
    """Ten of 1, 2, ..., 10 rad/s, pushed and seen together: (system, its transfer function in closed form)."""
    frequencies = np.arange(1.0, 11.0)
    blocks = [np.array([[0, w], [-w, -2 * damping_ratio * w]]) for w in frequencies]
    b, c = np.tile([0.0, 1.0], 10)[:, None], np.tile([1.0, 0.0], 10)[None]

    def closed_form(s):
        s = s[:, None]
        return np.sum(frequencies / (s**2 + 2 * damping_ratio * frequencies * s + frequencies**2), axis=1)

    return LinearSystem(scipy.linalg.block_diag(*blocks), b, c, np.zeros((1, 1))), closed_form


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
            reduced = method(system, order)
        except ReductionError as error:
            assert "too lightly damped" in str(error)
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
def test_singular_perturbation_keeps_both_states_of_an_oscillator_or_none(damping_ratio):
    system, _ = oscillators(damping_ratio)
    sigma = balanced_truncation(system, 20).hankel_singular_values
    equal = np.abs(sigma[10] / sigma[11] - 1) < 1e-6
    assert singular_perturbation_balancing(system, 11).order == (10 if equal else 11)
    reduced = singular_perturbation_balancing(system, tolerance=0.9)
    assert reduced.error_bound <= 0.9 * sigma[0]


@pytest.mark.parametrize("damping_ratio", [1e-4, 1e-6, 1e-8])
def test_band_limited_truncation_does_not_step_over_narrow_resonances(damping_ratio):
    system, closed_form = oscillators(damping_ratio)
    reduced = band_limited_truncation(system, (0.0, 1.0), 12)  # the six oscillators below 2 pi rad/s
    omega = around_the_resonances(damping_ratio, reduced)
    omega = omega[omega < 2 * np.pi]
    exact = closed_form(1j * omega)
    error = np.max(np.abs(reduced.system.transfer(1j * omega)[:, 0, 0] - exact))
    # The other four answer with 1.2 up there, off their resonance; the highest peak is 1 / (2 damping ratio).
    assert error < 4 * 2.4 * damping_ratio * np.max(np.abs(exact)) + 1e-13 / damping_ratio * np.max(
        np.abs(exact)
    )


@pytest.mark.parametrize("size", [{"order": 3}, {"tolerance": 1e-3}], ids=["order", "tolerance"])
@pytest.mark.parametrize("method", [*BALANCING, band_limited])
@pytest.mark.parametrize(("poles", "b"), [([-1, -2 + 3j], 0.0), ([], 1.0)], ids=["zero B", "no states"])
def test_a_diagonal_system_that_passes_nothing_on_reduces_to_its_d(poles, b, method, size):
    n = len(poles)
    system = DiagonalSystem(
        np.array(poles, dtype=complex),
        np.full((n, 2), b, dtype=complex),
        np.ones((3, n), dtype=complex),
        np.ones((3, 2)),
        np.arange(n),
    )
    reduced = method(system, **size)
    assert reduced.order == 0
    assert np.array_equal(reduced.system.d, system.d)
