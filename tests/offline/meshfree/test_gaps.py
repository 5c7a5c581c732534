"""Shape functions end at a gap, go around its end, and are the plain ones in a convex body."""

import numpy as np
import pytest

from palpate.geometry.shapes import box_lattice
from palpate.geometry.visibility import find_gaps
from palpate.meshfree import shape_functions

SPACING = 0.006
FACTOR = 2.2


@pytest.fixture(scope="module")
def functions(prongs):
    radii = FACTOR * prongs.spacing
    return shape_functions(prongs.points, prongs.points, radii, derivatives=1, gaps=prongs.gaps)


def test_no_support_reaches_from_one_prong_into_the_other(prongs, functions):
    beyond_the_end = prongs.points[:, 0] > 0.015 + FACTOR * SPACING / 2
    upper = prongs.points[:, 1] > 0.02
    across = functions.value[beyond_the_end & upper][:, beyond_the_end & ~upper]
    assert across.nnz == 0
    near_the_end = np.abs(prongs.points[:, 0] - 0.015) < 0.003
    assert functions.value[near_the_end & upper][:, near_the_end & ~upper].nnz > 0


def test_prongs_that_move_rigidly_apart_are_not_strained(prongs, functions):
    upper = prongs.points[:, 1] > 0.02
    # Whatever the field is around the slit's end, in the prongs it is a rigid motion each.
    rng = np.random.default_rng(0)
    turn = np.cross(rng.normal(size=3), prongs.points)
    field = np.where(upper[:, None], turn + np.array([1.0, 2.0, 3.0]), 0.0)
    far = prongs.points[:, 0] > 0.015 + 1.5 * FACTOR * SPACING
    gradient = np.stack([(g @ field)[far] for g in functions.gradient])
    strain = gradient + gradient.transpose(2, 1, 0)
    np.testing.assert_allclose(strain, 0, atol=1e-11 * np.abs(field).max() / SPACING)


def test_linear_fields_stay_exact_next_to_a_gap(prongs, functions):
    x = prongs.points
    np.testing.assert_allclose(functions.value @ np.ones(len(x)), 1, rtol=1e-12)
    np.testing.assert_allclose(functions.value @ x, x, atol=1e-12)
    for axis, derivative in enumerate(functions.gradient):
        np.testing.assert_allclose(derivative @ x, np.tile(np.eye(3)[axis], (len(x), 1)), atol=1e-9)


def test_a_support_goes_around_the_end_of_a_gap_with_the_weight_of_the_path(prongs):
    """Next to the end of the slit a pair across it has a smaller value than one as far apart without a slit between."""
    radii = FACTOR * prongs.spacing
    plain = shape_functions(prongs.points, prongs.points, radii)
    around = shape_functions(prongs.points, prongs.points, radii, gaps=prongs.gaps)
    upper, in_slit = prongs.points[:, 1] > 0.0209, prongs.points[:, 0] > 0.0155
    lower = prongs.points[:, 1] < 0.0191
    a, b = (h.value[upper & in_slit][:, lower & in_slit].sum() for h in (plain, around))
    assert 0 < b < 0.1 * a


def test_a_point_of_the_surface_is_moved_by_its_own_side(prongs):
    """A view's vertices next to the slit take the displacement of their own prong."""
    upper = prongs.points[:, 1] > 0.02
    x = np.linspace(0.04, 0.058, 9)
    vertices = np.column_stack([x, np.full(9, 0.021), np.linspace(0.001, 0.029, 9)])
    at = shape_functions(vertices, prongs.points, FACTOR * prongs.spacing, gaps=prongs.gaps).value
    np.testing.assert_allclose(at @ np.where(upper, 1.0, 0.0), 1, rtol=1e-12)


def test_in_a_convex_body_they_are_the_plain_ones():
    cloud = box_lattice((0, 0, 0), (1, 1, 1), (6, 6, 6), 0.2, seed=3)
    radii = FACTOR * cloud.spacing
    gaps = find_gaps(cloud.surface, lambda p: np.full(len(p), 0.2))
    plain, seen = (
        shape_functions(cloud.points, cloud.points, radii, derivatives=1, gaps=g) for g in (None, gaps)
    )
    np.testing.assert_array_equal(seen.value.indices, plain.value.indices)
    for a, b in zip([plain.value, *plain.gradient], [seen.value, *seen.gradient], strict=True):
        np.testing.assert_array_equal(a.data, b.data)
