"""The multifrontal factor of matrices whose unknowns lie scattered in space."""

import numpy as np
import pytest
from scipy.sparse import csr_array, eye_array, kron

from palpate.factorization.multifrontal import MultifrontalCholesky, dissect


def _scattered(n, reach, seed):
    """Points in a box of 3 x 2 x 1 and a definite matrix that couples those nearer than `reach`, three unknowns each."""
    random = np.random.default_rng(seed)
    points = random.random((n, 3)) * [3, 2, 1]
    distance = np.linalg.norm(points[:, None] - points, axis=2)
    coupling = np.where(distance < reach, np.exp(-distance), 0.0)
    blocks = random.standard_normal((3 * n, 3 * n))
    dense = np.kron(coupling, np.ones((3, 3))) * (blocks + blocks.T)
    dense += np.diag(np.abs(dense).sum(axis=1) + 1)
    return points, csr_array(dense)


@pytest.mark.parametrize("reach", [0.2, 0.6, 5.0])  # few neighbors, many, and a full matrix
@pytest.mark.parametrize("n", [1, 149, 700])
def test_solutions_are_right_to_round_off(n, reach):
    points, matrix = _scattered(n, reach, seed=n)
    expected = np.random.default_rng(1).standard_normal((3 * n, 4))
    factor = MultifrontalCholesky((matrix,), points)
    np.testing.assert_allclose(factor.solve(matrix @ expected), expected, atol=1e-11)


def test_the_dissection_orders_every_node_once_and_couples_no_two_halves():
    points, matrix = _scattered(1200, 0.25, seed=5)
    graph = csr_array(matrix[::3][:, ::3] != 0).astype(float)
    found = dissect(graph, points)
    np.testing.assert_array_equal(np.sort(found.order), np.arange(1200))
    subtrees = []
    for start, stop, children in zip(found.starts[:-1], found.starts[1:], found.children, strict=True):
        halves = [subtrees[child] for child in children]
        if len(halves) == 2:
            assert graph[halves[0]][:, halves[1]].nnz == 0
        subtrees.append(np.concatenate([found.order[start:stop], *halves]))
    assert len(found.children) > 7
    assert len(subtrees[-1]) == 1200


def test_the_factor_is_much_smaller_than_the_dense_one():
    """Neighbors on a long bar: the factor grows with its length."""
    line = np.arange(2000.0)
    neighbors = csr_array(np.abs(line[:, None] - line) < 3).astype(float)
    matrix = csr_array(kron(neighbors, np.ones((2, 2)))) + 20 * eye_array(4000)
    factor = MultifrontalCholesky((csr_array(matrix),), line[:, None])
    assert factor.nnz < 0.2 * 4000**2 / 2  # of leaves of 250 unknowns
    right = np.ones((4000, 1))
    np.testing.assert_allclose(matrix @ factor.solve(right), right, atol=1e-12)


def test_a_matrix_that_is_not_definite_is_refused():
    points, matrix = _scattered(400, 0.4, seed=2)
    with pytest.raises(np.linalg.LinAlgError, match="not definite"):
        MultifrontalCholesky((matrix, csr_array(-200 * eye_array(1200))), points)
