"""The consistent gradient: the correction by a sparse factor is that of the dense normal matrix with its null space filled."""

import numpy as np
import pytest

from palpate.discretization.consistency import consistent_gradient, vector_areas
from palpate.discretization.nodal import nodal_basis
from palpate.geometry.fill import fill_surface
from palpate.geometry.shapes import ball, box_lattice
from palpate.geometry.spacing import Refinement
from palpate.meshfree.kernel import quartic_spline


def _clouds():
    cube = box_lattice((0, 0, 0), (1, 1, 1), (6, 6, 6), 0.2, seed=3)
    contact = Refinement((0.5, 0.5, 1.0), radius_m=0.1, spacing_m=0.05)
    return {
        "jittered": cube,
        "flat": box_lattice((0, 0, 0), (1, 1, 0.3), (8, 8, 3)),
        "graded": fill_surface(cube.surface, 0.2, [contact]),
        "ball": ball(1.0, 0.3),
    }


CLOUDS = _clouds()


@pytest.mark.parametrize("name", CLOUDS)
def test_the_correction_is_the_smallest_that_obeys_the_divergence_theorem(name):
    """Constrained least squares, assembled densely for one axis and solved by its pseudo-inverse."""
    cloud = CLOUDS[name]
    basis, h = nodal_basis(cloud.points, cloud.spacing, 2.2, derivatives=1)
    areas = vector_areas(cloud)
    corrected = consistent_gradient(cloud.points, cloud.volumes, cloud.spacing, areas, h, basis.radii)

    n = cloud.n_nodes
    node = np.repeat(np.arange(n), np.diff(h.value.indptr))
    other = h.value.indices
    offset = cloud.points[other] - cloud.points[node]
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
    for axis, plain in enumerate(h.gradient):
        defect = h.value.T @ areas[:, axis] - plain.T @ cloud.volumes
        wanted = np.concatenate([np.zeros(4 * n), defect]) / scale[:, 0]
        gram = (constraints / scale) @ (constraints / scale).T
        change = unit * ((constraints / scale).T @ np.linalg.lstsq(gram, wanted, rcond=1e-12)[0])
        largest = np.abs(plain.data).max()
        np.testing.assert_allclose(corrected[axis].data - plain.data, change, atol=1e-8 * largest)
