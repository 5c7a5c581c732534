"""The direct solvers against numpy: solutions, inertia, refusals; MKL PARDISO where the package `mkl` is installed."""

import numpy as np
import pytest
from scipy.sparse import csr_array, diags_array, eye_array, kron

from palpate.factorization import factorize, pardiso, solver_name

EPS = np.finfo(float).eps


@pytest.fixture(params=["SuperLU", "multifrontal Cholesky", "MKL PARDISO"])
def solver(request, monkeypatch):
    if request.param != "MKL PARDISO":
        monkeypatch.setattr(pardiso, "library", lambda: None)
    elif pardiso.library() is None:
        pytest.skip("the package mkl is not installed")
    return request.param


def _points(solver, n):
    """Places of the n³ points; SuperLU is what is used where nothing is known of them."""
    return None if solver == "SuperLU" else np.argwhere(np.ones((n, n, n))).astype(float)


def _laplacian(n, shift=0.0):
    """Of a cube of n³ points held outside; its eigenvalues are sums of three 4 sin²(k pi / 2 (n + 1)), less the shift."""
    line = diags_array([-np.ones(n - 1), 2 * np.ones(n), -np.ones(n - 1)], offsets=[-1, 0, 1])
    one = eye_array(n)
    matrix = kron(kron(line, one), one) + kron(kron(one, line), one) + kron(kron(one, one), line)
    return csr_array(matrix - shift * eye_array(n**3))


def _eigenvalues(n):
    line = 4 * np.sin(np.arange(1, n + 1) * np.pi / (2 * (n + 1))) ** 2
    return np.add.outer(np.add.outer(line, line), line).ravel()


def test_the_solver_that_is_installed_is_named(solver):
    assert factorize(_laplacian(4), points=_points(solver, 4)).solver == solver
    if solver != "SuperLU":
        assert solver_name() == solver


@pytest.mark.parametrize("shift", [0.0, 3.3])
def test_solutions_are_right_to_round_off_for_one_and_many_right_hand_sides(solver, shift):
    matrix = _laplacian(8, shift)
    factor = factorize(matrix, definite=shift == 0, points=_points(solver, 8))
    expected = np.random.default_rng(1).standard_normal((512, 5))
    right = matrix @ expected
    before = right.copy()
    condition = np.abs(_eigenvalues(8) - shift).max() / np.abs(_eigenvalues(8) - shift).min()
    np.testing.assert_allclose(factor.solve(right), expected, atol=100 * EPS * condition)
    np.testing.assert_allclose(factor.solve(right[:, 2]), expected[:, 2], atol=100 * EPS * condition)
    np.testing.assert_array_equal(right, before)
    assert factor.solve(right[:, 2]).shape == (512,)


@pytest.mark.parametrize("definite", [True, False])
def test_a_sum_of_matrices_is_factorized_as_their_sum_and_in_blocks_as_without(solver, definite):
    """The second matrix has entries where the first has none, and blocks that are not full."""
    cube, three = _laplacian(5), csr_array(np.array([[4.0, 1.0, 0.5], [1.0, 3.0, 0.2], [0.5, 0.2, 2.0]]))
    matrix = csr_array(kron(cube, three))
    change = csr_array(kron(diags_array([np.ones(120), np.ones(120)], offsets=[-5, 5]), eye_array(3)))
    right = np.random.default_rng(2).standard_normal((375, 4))
    factor = factorize(matrix, 0.1 * change, definite=definite, points=_points(solver, 5))
    expected = np.linalg.solve((matrix + 0.1 * change).toarray(), right)
    np.testing.assert_allclose(factor.solve(right), expected, rtol=1e-11, atol=1e-13)
    assert factor.n_negative == 0
    assert factor.nnz > matrix.nnz / 2


@pytest.mark.parametrize("shift", [0.0, 1.0, 3.3, 7.7])
def test_negative_pivots_count_the_eigenvalues_below_the_shift(solver, shift):
    factor = factorize(_laplacian(7, shift), definite=False)
    assert factor.n_negative == np.count_nonzero(_eigenvalues(7) < shift)


def test_a_matrix_that_is_not_definite_is_noticed_where_one_is_expected(solver):
    if solver == "SuperLU":  # it needs no definite matrix, and tells
        assert factorize(_laplacian(6, 1.0)).n_negative == np.count_nonzero(_eigenvalues(6) < 1)
        return
    with pytest.raises(np.linalg.LinAlgError, match="pivot"):
        factorize(_laplacian(6, 1.0), points=_points(solver, 6))


def test_a_nearly_singular_matrix_gives_a_solution_with_a_small_residual(solver):
    """Graded over 12 powers of ten, as penalties make it: the error may be large, the backward error is not."""
    scale = diags_array(np.logspace(0, 6, 216))
    matrix = csr_array(scale @ _laplacian(6) @ scale)
    right = np.random.default_rng(3).standard_normal((216, 2))
    solution = factorize(matrix, points=_points(solver, 6)).solve(right)
    residual = np.abs(matrix @ solution - right).sum(axis=0)
    norm = abs(matrix).sum(axis=0).max()
    assert np.all(residual <= 1e-13 * (norm * np.abs(solution).sum(axis=0) + np.abs(right).sum(axis=0)))


def _solutions_times(scale, factor, monkeypatch):
    """The factor with a solver whose solutions are wrong by a constant."""
    exact = factor._backend

    class Wrong:
        nnz, n_negative = exact.nnz, exact.n_negative

        def solve(self, right):
            return scale * exact.solve(right)

    monkeypatch.setattr(factor, "_backend", Wrong())
    return factor


def test_a_solution_that_refinement_cannot_save_is_an_error_with_the_number(monkeypatch):
    factor = _solutions_times(3, factorize(_laplacian(5)), monkeypatch)  # each step doubles the error
    with pytest.raises(np.linalg.LinAlgError, match=r"backward error of a solution is \d"):
        factor.solve(np.ones(125))


def test_an_inexact_factor_is_refined(monkeypatch):
    matrix = _laplacian(5)
    factor = _solutions_times(1 + 1e-6, factorize(matrix), monkeypatch)
    right = np.random.default_rng(4).standard_normal((125, 3))
    np.testing.assert_allclose(factor.solve(right), np.linalg.solve(matrix.toarray(), right), atol=1e-13)
