"""Shape functions against what defines them: the polynomials they reproduce and their own differences."""

from itertools import product

import numpy as np
import pytest

from palpate.meshfree import SupportError, shape_functions

EPS = np.finfo(float).eps
SECOND = {1: [(0, 0)], 2: [(0, 0), (1, 1), (0, 1)], 3: [(0, 0), (1, 1), (2, 2), (0, 1), (1, 2), (2, 0)]}


def _nodes(dim, layout):
    """Nodes and radii on the unit cube, the support following the local spacing."""
    n = {1: 15, 2: 11, 3: 8}[dim]
    axis = np.linspace(0, 1, n)
    x = np.stack(np.meshgrid(*[axis] * dim, indexing="ij"), -1).reshape(-1, dim)
    h = 1 / (n - 1)
    if layout == "lattice":
        return x, np.full(len(x), 2.2 * h)
    rng = np.random.default_rng(7)
    x = x + rng.uniform(-0.2, 0.2, x.shape) * h
    if layout == "jittered":
        return x, np.full(len(x), 2.6 * h)
    graded = x * (0.4 + 0.6 * np.abs(x))  # spacing grows from 0.4 h at 0 to 1.6 h at 1
    local = h * (0.4 + 1.2 * np.abs(x)).max(axis=1)
    return graded, 2.6 * local


def _monomials(dim, order):
    return [e for e in product(range(order + 1), repeat=dim) if sum(e) <= order]


def _derivative(exponents, axes, x):
    """Derivative of prod x_a^e_a along the given axes."""
    factor, e = 1.0, list(exponents)
    for a in axes:
        factor *= e[a]
        e[a] = max(e[a] - 1, 0)
    return factor * np.prod(x ** np.array(e), axis=1)


@pytest.mark.parametrize("layout", ["lattice", "jittered", "graded"])
@pytest.mark.parametrize("order", [1, 2])
@pytest.mark.parametrize("dim", [1, 2, 3])
def test_every_monomial_of_the_basis_and_its_derivatives_are_reproduced_to_round_off(dim, order, layout):
    nodes, radii = _nodes(dim, layout)
    points = np.vstack([nodes, np.random.default_rng(1).uniform(0, 1, (50, dim)) * nodes.max(axis=0)])
    h = shape_functions(points, nodes, radii, order=order, derivatives=2)
    axes = [()] + [(a,) for a in range(dim)] + SECOND[dim]
    for matrix, along in zip((h.value, *h.gradient, *h.hessian), axes, strict=True):
        # A sum of terms of size |h_J| over coefficients from a moment matrix with relative pivots above ~1e-4.
        scale = abs(matrix).sum(axis=1) * 1e4 * EPS
        for exponents in _monomials(dim, order):
            error = matrix @ _derivative(exponents, (), nodes) - _derivative(exponents, along, points)
            assert np.all(np.abs(error) <= scale), (along, exponents, np.max(np.abs(error) / scale))


@pytest.mark.parametrize("order", [1, 2])
@pytest.mark.parametrize("dim", [1, 2, 3])
def test_the_values_are_a_partition_of_unity_and_the_derivatives_sum_to_zero(dim, order):
    nodes, radii = _nodes(dim, "jittered")
    h = shape_functions(nodes, nodes, radii, order=order, derivatives=2)
    ones = np.ones(len(nodes))
    np.testing.assert_allclose(h.value @ ones, 1, atol=1e4 * EPS)
    for matrix in (*h.gradient, *h.hessian):
        assert np.all(np.abs(matrix @ ones) <= 1e4 * EPS * abs(matrix).sum(axis=1))


@pytest.mark.parametrize("order", [1, 2])
@pytest.mark.parametrize("dim", [1, 2, 3])
def test_first_and_second_derivatives_converge_as_central_differences_of_the_value_do(dim, order):
    nodes, radii = _nodes(dim, "graded")
    points = np.random.default_rng(3).uniform(0.2, 0.7, (40, dim))
    field = np.cos(3 * nodes.sum(axis=1)) + nodes[:, 0] ** 3

    def value(x):
        return shape_functions(x, nodes, radii, order=order).value @ field

    def difference(along, step):
        e = np.eye(dim) * step
        if len(along) == 1:
            (a,) = along
            return (value(points + e[a]) - value(points - e[a])) / (2 * step)
        a, b = along
        corners = [value(points + p * e[a] + q * e[b]) * p * q for p in (1, -1) for q in (1, -1)]
        return sum(corners) / (4 * step**2)

    h = shape_functions(points, nodes, radii, order=order, derivatives=2)
    for matrix, along in zip(
        (*h.gradient, *h.hessian), [(a,) for a in range(dim)] + SECOND[dim], strict=True
    ):
        exact = matrix @ field
        coarse, fine = (np.linalg.norm(difference(along, s) - exact) for s in (4e-4, 1e-4))
        assert fine < 1e-3 * np.linalg.norm(exact)
        # The third derivative of the weight jumps, so second differences are of first order at some points only.
        assert fine < coarse / (8 if len(along) == 1 else 3)


def test_a_node_far_from_every_point_takes_no_part_and_every_covering_one_does():
    nodes, radii = _nodes(3, "graded")
    h = shape_functions(nodes, nodes, radii)
    distance = np.linalg.norm(nodes[:, None] - nodes[None], axis=-1)
    covered = distance < radii[None, :]
    np.testing.assert_array_equal(h.value.toarray() != 0, covered)


def test_all_matrices_share_one_sparsity_pattern():
    nodes, radii = _nodes(3, "jittered")
    h = shape_functions(nodes, nodes, radii, derivatives=2)
    for matrix in (*h.gradient, *h.hessian):
        assert np.shares_memory(matrix.indices, h.value.indices)
        assert np.shares_memory(matrix.indptr, h.value.indptr)


def test_a_point_with_too_few_neighbors_is_refused_by_name():
    nodes, radii = _nodes(3, "lattice")
    points = np.vstack([nodes[:3], [[3.0, 0.0, 0.0]]])
    with pytest.raises(SupportError, match=r"point 3 at \[3\., 0\., 0\.\] is covered by 0 nodes.*enlarge"):
        shape_functions(points, nodes, radii)


def test_coplanar_neighbors_are_refused_by_name():
    nodes, radii = _nodes(2, "jittered")
    flat = np.column_stack([nodes, np.full(len(nodes), 0.25)])
    with pytest.raises(SupportError, match=r"point 0 .* nearly degenerate .*enlarge"):
        shape_functions(flat, flat, radii)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"order": 3}, "order = 3: expected 1 or 2"),
        ({"derivatives": 4}, "derivatives = 4"),
        ({"radii": np.zeros(512)}, "radii"),
        ({"points": np.zeros((4, 2))}, "points has shape"),
        ({"points": np.full((4, 3), np.nan)}, "points holds numbers that are not finite"),
    ],
)
def test_bad_arguments_are_refused_with_the_argument_named(change, message):
    nodes, radii = _nodes(3, "lattice")
    arguments = {"points": nodes, "nodes": nodes, "radii": radii} | change
    with pytest.raises(ValueError, match=message):
        shape_functions(**arguments)
