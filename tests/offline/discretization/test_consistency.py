"""The consistent gradient: the correction by a sparse factor is that of constrained least squares."""

import numpy as np
import pytest

from palpate.discretization.consistency import consistent_gradient, vector_areas
from palpate.discretization.nodal import nodal_basis
from palpate.geometry.fill import fill_surface
from palpate.geometry.shapes import ball, box_lattice
from palpate.geometry.spacing import Refinement
from palpate.meshfree import shape_functions
from palpate.meshfree.kernel import quartic_spline


def _clouds():
    cube = box_lattice((0, 0, 0), (1, 1, 1), (5, 5, 5), 0.2, seed=3)
    contact = Refinement((0.5, 0.5, 1.0), radius_m=0.1, spacing_m=0.15)
    return {
        "jittered": cube,
        "flat": box_lattice((0, 0, 0), (1, 1, 0.3), (6, 6, 3)),
        "graded": fill_surface(cube.surface, 0.25, [contact]),
        "ball": ball(1.0, 0.4),
    }


CLOUDS = _clouds()


@pytest.mark.parametrize("name", CLOUDS)
def test_the_correction_is_the_smallest_that_obeys_the_divergence_theorem(name):
    """Constrained least squares, assembled densely for one axis and solved by its pseudo-inverse."""
    cloud = CLOUDS[name]
    nodes, places, spacing = cloud.points, cloud.centroids, cloud.spacing
    basis, _ = nodal_basis(nodes, spacing, 2.2, derivatives=0, gaps=cloud.gaps)
    h = shape_functions(places, nodes, basis.radii, derivatives=1, gaps=cloud.gaps)
    target = basis.value.T @ vector_areas(cloud)
    corrected = consistent_gradient(nodes, places, cloud.volumes, spacing, target, h, basis.radii)

    n = cloud.n_nodes
    node = np.repeat(np.arange(n), np.diff(h.value.indptr))
    other = h.value.indices
    offset = cloud.points[other] - places[node]
    weight = quartic_spline(np.minimum(np.linalg.norm(offset, axis=1) / basis.radii[other], 1.0))
    linear = np.column_stack([np.ones(len(node)), offset / cloud.spacing[node, None]])
    # Unknowns y = change h / sqrt(W): each row's change is orthogonal to linear fields, the columns' sums are given.
    unit = np.sqrt(weight) / cloud.spacing[node]
    exact = np.zeros((4 * n, len(node)))
    for term in range(4):
        exact[4 * node + term, np.arange(len(node))] = unit * linear[:, term]
    sums = np.zeros((n, len(node)))
    sums[other, np.arange(len(node))] = unit * cloud.volumes[node]
    constraints = np.vstack([exact, sums])
    scale = np.linalg.norm(constraints, axis=1, keepdims=True)
    constraints /= scale
    defect = target - np.column_stack([plain.T @ cloud.volumes for plain in h.gradient])
    wanted = np.vstack([np.zeros((4 * n, 3)), defect]) / scale
    multipliers, *_ = np.linalg.lstsq(constraints @ constraints.T, wanted, rcond=1e-12)
    change = unit[:, None] * (constraints.T @ multipliers)
    for plain, exact_derivative, by_axis in zip(h.gradient, corrected, change.T, strict=True):
        largest = np.abs(plain.data).max()
        np.testing.assert_allclose(exact_derivative.data - plain.data, by_axis, atol=1e-8 * largest)
