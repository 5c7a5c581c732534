"""Which node a sample is nearest to, and the cells that follow, against a k-d tree and a lattice."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from palpate.geometry.sampling import depth_inside, sample_inside
from palpate.geometry.shapes import box_lattice
from palpate.geometry.spacing import Refinement, SpacingField
from palpate.geometry.tributary import nearest_node, tributary_cells

BLOCK = box_lattice((0, 0, 0), (1, 1, 1), (2, 2, 2)).surface


def graded(n, seed=0):
    """Nodes that lie up to a thousand times closer together around the origin than far from it."""
    random = np.random.default_rng(seed)
    return random.standard_normal((n, 3)) * np.geomspace(1e-3, 1, n)[:, None]


@pytest.mark.parametrize("n_nodes", [1, 2, 20, 3000])
def test_the_nearest_node_is_the_nearest_whatever_the_spacing(n_nodes):
    nodes = graded(n_nodes)
    samples = np.random.default_rng(1).uniform(-3, 3, (20_000, 3))
    distance, _ = cKDTree(nodes).query(samples)
    owner = nearest_node(nodes, samples)
    empty = np.bincount(cKDTree(nodes).query(samples)[1], minlength=n_nodes) == 0
    own = ~np.isin(owner, np.flatnonzero(empty))  # a node without a sample is given one
    np.testing.assert_array_equal(np.linalg.norm(samples - nodes[owner], axis=1)[own], distance[own])
    assert np.count_nonzero(~own) <= np.count_nonzero(empty)


def test_the_cells_of_a_lattice_are_cubes():
    n = 4
    axis = (np.arange(n) + 0.5) / n
    nodes = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
    fine = (np.arange(8 * n) + 0.5) / (8 * n)
    samples = np.stack(np.meshgrid(fine, fine, fine, indexing="ij"), axis=-1).reshape(-1, 3)
    cells = tributary_cells(nodes, samples, np.full(len(samples), 1.0), 1.0)
    np.testing.assert_allclose(cells.volumes, n**-3.0, rtol=1e-12)
    np.testing.assert_allclose(cells.centroids, nodes, atol=1e-14)
    # The variance of eight points an interval h/8 apart is h² / 12 (1 - 1/64).
    expected = np.broadcast_to(np.eye(3) * n**-2.0 / 12 * (1 - 1 / 64), cells.moments.shape)
    np.testing.assert_allclose(cells.moments, expected, atol=1e-14)


def test_samples_know_a_depth_that_they_have_at_least():
    field = SpacingField(0.1, (Refinement((0.5, 0.5, 1.0), 0.1, 0.03),))
    samples = sample_inside(BLOCK, field, 1 / 4)
    depth = depth_inside(samples.points, BLOCK)
    exact = np.min(np.minimum(samples.points, 1 - samples.points), axis=1)
    np.testing.assert_allclose(depth, exact, atol=1e-12)
    assert np.all(samples.least_depth <= depth + 1e-12)
    assert samples.measures.sum() == pytest.approx(1, rel=0.01)
