"""Membranes against Bessel zeros and pi sqrt(m² + n²), with the observed order of convergence."""

import numpy as np
import pytest
from scipy.special import jn_zeros

from palpate.meshfree import SupportError
from palpate.modes.dense import elastic_modes
from palpate.scene.material import PronySeries
from palpate_paper import membrane
from palpate_paper.local_fit import local_fit_laplacian
from palpate_paper.membranes import disc_membrane, square_membrane
from palpate_paper.stability import stability

EPS = np.finfo(float).eps
DISC = np.sort(np.concatenate([np.repeat(jn_zeros(m, 6), 1 if m == 0 else 2) for m in range(12)]))[:10]
SQUARE = np.sort([np.pi * np.hypot(m, n) for m in range(1, 9) for n in range(1, 9)])[:10]
MEMBRANES = {
    "disc": (disc_membrane, DISC, (125, 500, 2000), np.pi),
    "square": (square_membrane, SQUARE, (64, 225, 784), 1.0),
}
METHODS = {"conservative": membrane.conservative, "collocation": membrane.collocation}


def _errors(build, method, n_nodes, reference):
    cloud = build(n_nodes)
    frequencies = np.sort(np.sqrt(elastic_modes(METHODS[method](cloud)).squared_frequencies[:10]).real)
    return np.abs(frequencies / reference - 1), cloud.spacing[0]


@pytest.mark.parametrize(
    ("method", "shape"),
    [
        ("conservative", "disc"),
        ("conservative", "square"),
        ("collocation", "square"),
        pytest.param("collocation", "disc", marks=pytest.mark.slow),
    ],
)
def test_frequencies_converge_at_second_order_to_the_exact_ones(method, shape):
    build, reference, counts, _ = MEMBRANES[shape]
    coarse, medium, fine = (_errors(build, method, n, reference) for n in counts)
    assert np.all(fine[0] < 0.013)
    assert np.linalg.norm(fine[0]) < np.linalg.norm(medium[0]) < np.linalg.norm(coarse[0])
    # Two refinements together: at a single one, errors of either sign may pass through zero.
    order = np.log(np.linalg.norm(coarse[0]) / np.linalg.norm(fine[0])) / np.log(coarse[1] / fine[1])
    assert order > 1.7, order


@pytest.mark.parametrize(("method", "tolerance"), [("conservative", 0.005), ("collocation", 0.02)])
def test_the_papers_disc_of_500_nodes_has_its_first_ten_frequencies_right(method, tolerance):
    errors, _ = _errors(disc_membrane, method, 500, DISC)
    assert errors.max() < tolerance


@pytest.mark.slow
def test_the_linear_basis_does_not_converge_by_collocation():
    """Linear consistency is order 0 for a second derivative: refinement leaves the error where it is."""
    errors = []
    for n in (500, 2000):
        modes = elastic_modes(membrane.collocation(disc_membrane(n), order=1))
        errors.append(np.abs(np.sqrt(modes.squared_frequencies[:10]).real / DISC - 1).mean())
    assert errors[1] > 0.8 * errors[0] > 0.05


@pytest.mark.parametrize(("build", "n"), [(disc_membrane, 500), (square_membrane, 200)])
@pytest.mark.parametrize("method", METHODS)
def test_the_papers_membranes_are_stable_with_memory_and_a_tip_in_the_middle(method, build, n):
    cloud = build(n)
    center = cloud.points[cloud.on_edge].mean(axis=0)
    distance = np.linalg.norm(cloud.points - center, axis=1)
    modes = elastic_modes(METHODS[method](cloud, [np.flatnonzero(distance < distance.min() + 1e-9)]))
    judged = stability(modes, PronySeries((1.0,), (1.0,)))
    assert judged.growing_modes == 0
    assert judged.spectral_abscissa_per_s < -0.1


@pytest.mark.parametrize("shape", MEMBRANES)
def test_areas_sum_to_the_region_and_edge_lengths_to_its_closed_edge(shape):
    build, _, counts, area = MEMBRANES[shape]
    cloud = build(counts[0])
    assert cloud.n_nodes == counts[0]
    assert cloud.areas.sum() == pytest.approx(area, rel=1e-12)
    assert np.all(cloud.areas > 0)
    np.testing.assert_allclose(cloud.edge.sum(axis=0), 0, atol=1e-12)
    # Divergence theorem: the edge encloses the area, for the disc to the order of the arc's chord.
    np.testing.assert_allclose(cloud.points.T @ cloud.edge, area * np.eye(2), atol=1e-12)


def test_two_hundred_nodes_make_an_evenly_filled_square():
    cloud = square_membrane(200)
    assert cloud.n_nodes == 200
    assert len(cloud.on_edge) == 56
    distance = np.linalg.norm(cloud.points[:, None] - cloud.points[None], axis=-1)
    nearest = (distance + 9 * np.eye(200)).min(axis=1)
    assert nearest.max() / nearest.min() < 1.15


def test_the_static_force_on_the_middle_of_a_disc_agrees_with_the_ring_around_it():
    """Held at radius r in the middle, the exact force per unit deflection is 2 pi T / ln(1 / r)."""
    cloud = disc_membrane(500)
    radius = np.linalg.norm(cloud.points, axis=1)
    patch = np.flatnonzero(radius < 0.51)
    modes = elastic_modes(membrane.conservative(cloud, [patch], tension_n_per_m=3.0))
    effective = radius[patch].max()
    inner, outer = (3.0 * 2 * np.pi / np.log(1 / r) for r in (effective, effective + cloud.spacing[0]))
    assert inner < modes.static_stiffness[0, 0] < outer


def test_tension_and_density_scale_frequencies_and_forces():
    cloud = disc_membrane(61)
    for assemble in METHODS.values():
        unit = elastic_modes(assemble(cloud, [[0]]))
        other = elastic_modes(assemble(cloud, [[0]], tension_n_per_m=3.0, density_kg_per_m2=0.5))
        np.testing.assert_allclose(other.squared_frequencies, 6 * unit.squared_frequencies, rtol=1e-9)
        np.testing.assert_allclose(other.static_stiffness, 3 * unit.static_stiffness, rtol=1e-9)


def test_the_local_fit_is_exact_for_quadratics():
    cloud = disc_membrane(125)
    x, y = cloud.points.T
    operator = local_fit_laplacian(cloud.points)
    scale = 1e4 * EPS * abs(operator).sum(axis=1).max()
    for field, exact in ((1 + 0 * x, 0), (x, 0), (y, 0), (x * x, 2), (y * y, 2), (x * y, 0)):
        np.testing.assert_allclose(operator @ field, exact, atol=scale)


def test_nodes_on_a_line_are_refused_by_the_local_fit():
    line = np.column_stack([np.linspace(0, 1, 40), np.zeros(40)])
    with pytest.raises(SupportError, match=r"around node 0 at .* determine a quadratic"):
        local_fit_laplacian(line)


@pytest.mark.parametrize(("build", "n"), [(disc_membrane, 7), (square_membrane, 12), (square_membrane, 202)])
def test_node_counts_that_make_no_even_cloud_are_refused(build, n):
    with pytest.raises(ValueError, match=f"n_nodes = {n}: expected"):
        build(n)
