"""The conservative discretization against exact fields, quadratic finite elements, Lamb's ball and its own energy."""

import numpy as np
import pytest
from scipy.sparse import csr_array

from palpate.discretization import conservative
from palpate.discretization.consistency import vector_areas
from palpate.geometry.fill import fill_surface
from palpate.geometry.shapes import ball, box_lattice
from palpate.geometry.spacing import Refinement
from palpate.meshfree import SupportError
from palpate.modes.dense import elastic_modes, nodal_stiffness
from palpate.scene.material import Material

EPS = np.finfo(float).eps
CUBE = Material(youngs_modulus_pa=1.0, poissons_ratio=0.3, density_kg_per_m3=10.0)
# Hz: quadratic hexahedra, 8 x 8 x 8 (scikit-fem; computed again in the slow test below).
CUBE_FREQUENCIES = np.array(
    [
        0.03365,
        0.03365,
        0.04571,
        0.08037,
        0.08894,
        0.08894,
        0.10966,
        0.12988,
        0.13525,
        0.13824,
        0.13854,
        0.13854,
    ]
)
# Lamb 1882, lambda = mu, angular frequency over c_s / a: torsional and spheroidal, five-fold each.
LAMB = np.repeat([2.501, 2.640], 5)


def _cube(n, jitter=0.0):
    cloud = box_lattice((0, 0, 0), (1, 1, 1), (n, n, n), jitter, seed=3)
    return cloud, np.flatnonzero(cloud.points[:, 2] == 0)


def _top(cloud, radius):
    away = np.linalg.norm(cloud.points[:, :2] - 0.5, axis=1)
    return np.flatnonzero((away < radius) & (cloud.points[:, 2] == 1))


def _modes(cloud, fixed, contacts, material=CUBE):
    return elastic_modes(conservative.assemble(cloud, material, fixed, contacts))


def _free_stiffness(cloud):
    """K in nodal values of the body that nothing holds."""
    return nodal_stiffness(conservative.assemble(cloud, CUBE, [], []))


def _cube_error(n, jitter):
    cloud, bottom = _cube(n, jitter)
    modes = _modes(cloud, bottom, [])
    return np.abs(np.sqrt(modes.squared_frequencies[:12]) / (2 * np.pi) / CUBE_FREQUENCIES - 1)


def _ball_frequencies(spacing):
    material = Material(2.5, 0.25, 1.0)  # lambda = mu = 1
    modes = _modes(ball(1.0, spacing), [], [], material)
    return np.sqrt(np.abs(modes.squared_frequencies[:16]) / material.shear_modulus_pa)


CLOUDS = {
    "lattice": lambda: _cube(6)[0],
    "jittered": lambda: _cube(6, 0.25)[0],
    "ball": lambda: ball(1.0, 0.28),
    "graded": lambda: fill_surface(
        box_lattice((-1, -1, -1), (1, 1, 1), (2, 2, 2)).surface,
        0.5,
        (Refinement((0.2, 0.1, 1.0), 0.2, 0.1, growth=0.4),),
    ),
}


@pytest.fixture(params=CLOUDS)
def cloud(request):
    return CLOUDS[request.param]()


def _linear_field(cloud):
    strain = np.array([[0.3, 0.7, -0.2], [0.1, -0.4, 0.5], [0.6, 0.2, 0.9]])
    return cloud.points @ strain.T, strain


def test_strain_is_exact_for_linear_fields_and_zero_for_rigid_motions(cloud):
    u, gradient = _linear_field(cloud)
    basis, pattern, operators = conservative.gradient_in_cells(cloud)
    parameters, ones = basis.parameters(u), basis.parameters(np.ones((cloud.n_nodes, 1)))
    for k, wanted in enumerate((gradient, *3 * [np.zeros((3, 3))])):
        for axis in range(3):
            d = csr_array((operators[:, k, axis], pattern.indices, pattern.indptr), shape=pattern.shape)
            scale = 1e3 * EPS * abs(d).sum(axis=1).max() * np.abs(u).max()
            np.testing.assert_allclose(
                d @ parameters, np.tile(wanted[:, axis], (cloud.n_nodes, 1)), atol=scale
            )
            np.testing.assert_allclose(d @ ones, 0, atol=scale)


def test_rigid_motions_need_no_force_and_linear_fields_store_the_exact_energy(cloud):
    k = _free_stiffness(cloud)
    x = cloud.points
    scale = 1e3 * EPS * np.abs(k).sum(axis=1).max()
    for axis in np.eye(3):
        for motion in (np.tile(axis, (cloud.n_nodes, 1)), np.cross(axis, x)):
            np.testing.assert_allclose(k @ motion.ravel(), 0, atol=scale)
    u, gradient = _linear_field(cloud)
    strain = (gradient + gradient.T) / 2
    density = 0.5 * CUBE.lame_lambda_pa * np.trace(strain) ** 2 + CUBE.shear_modulus_pa * np.sum(strain**2)
    assert 0.5 * u.ravel() @ k @ u.ravel() == pytest.approx(density * cloud.volumes.sum(), rel=1e-11)


def test_constant_stress_is_in_equilibrium_with_its_surface_tractions(cloud):
    """The patch test: no force inside, traction times vector area on the boundary."""
    k = _free_stiffness(cloud)
    u, gradient = _linear_field(cloud)
    stress = CUBE.lame_lambda_pa * np.trace(gradient) * np.eye(3) + CUBE.shear_modulus_pa * (
        gradient + gradient.T
    )
    force = (k @ u.ravel()).reshape(-1, 3)
    scale = 1e4 * EPS * np.abs(k).sum(axis=1).max()
    np.testing.assert_allclose(force, vector_areas(cloud) @ stress, atol=scale)
    np.testing.assert_allclose(force[~cloud.boundary], 0, atol=scale)


def test_uniaxial_tension_is_solved_exactly():
    """Bottom pulled against top, sides free: with nu = 0 the exact field is linear, and the force is E A / L."""
    cloud, bottom = _cube(6, 0.25)
    top = np.flatnonzero(cloud.points[:, 2] == 1)
    modes = _modes(cloud, bottom, [top], Material(3.0, 0.0, 1.0))
    assert modes.static_stiffness[2, 2] == pytest.approx(3.0, rel=1e-10)


def test_vector_areas_obey_the_divergence_theorem(cloud):
    b = vector_areas(cloud)
    np.testing.assert_allclose(b.sum(axis=0), 0, atol=1e-12)
    np.testing.assert_allclose(cloud.points.T @ b, cloud.volumes.sum() * np.eye(3), atol=1e-12)
    assert not np.any(b[~cloud.boundary])


def test_the_divergence_theorem_holds_to_local_round_off_where_spacing_spans_a_factor_of_twenty():
    surface = box_lattice((-20, -20, -20), (20, 20, 0), (2, 2, 2)).surface
    cloud = fill_surface(surface, 5.0, (Refinement((0.0, 0.0, 0.0), 0.5, 0.25, growth=0.5),))
    assert cloud.spacing.max() / cloud.spacing.min() > 15
    basis, pattern, operators = conservative.gradient_in_cells(cloud)
    target = basis.value.T @ vector_areas(cloud)
    for axis in range(3):
        g = csr_array((operators[:, 0, axis], pattern.indices, pattern.indptr), shape=pattern.shape)
        local = abs(g).T @ cloud.volumes
        assert np.all(np.abs(g.T @ cloud.volumes - target[:, axis]) < 100 * EPS * local)


def test_stiffness_is_symmetric_and_semi_definite_with_six_rigid_motions(cloud):
    k = _free_stiffness(cloud)
    np.testing.assert_allclose(k, k.T, atol=100 * EPS * np.abs(k).max())
    eigenvalues = np.linalg.eigvalsh(k)
    round_off = len(k) * EPS * eigenvalues[-1]
    assert eigenvalues[0] > -round_off
    assert np.sum(eigenvalues < 100 * round_off) == 6


@pytest.mark.parametrize("jitter", [pytest.param(0.0, marks=pytest.mark.slow), 0.2])
def test_cube_frequencies_are_within_two_and_a_half_percent_at_nine_nodes_an_edge_and_improve_with_refinement(
    jitter,
):
    coarse, medium, fine = (_cube_error(n, jitter) for n in (5, 7, 9))
    assert fine.max() < 0.025  # measured 2.1 and 1.3 %, with 7 nodes 2.6 %
    assert fine.max() < medium.max() < coarse.max()
    assert np.linalg.norm(fine) < np.linalg.norm(medium) < np.linalg.norm(coarse)


def test_a_free_ball_has_six_rigid_modes_and_lambs_frequencies():
    frequencies = _ball_frequencies(0.22)
    assert frequencies[5] < 1e-4 < frequencies[6]
    np.testing.assert_allclose(frequencies[6:], LAMB, rtol=0.02)  # measured 1.2 %


@pytest.mark.slow
def test_a_free_balls_frequencies_improve_with_refinement():
    coarse, fine = (np.abs(_ball_frequencies(spacing)[6:] / LAMB - 1).max() for spacing in (0.22, 0.16))
    assert fine < 0.01
    assert fine < coarse


def test_modes_are_mass_normalized_and_diagonalize_the_stiffness():
    cloud, bottom = _cube(5, 0.2)
    body = conservative.assemble(cloud, CUBE, bottom, [])
    modes = elastic_modes(body)
    k = _free_stiffness(cloud)
    mass = np.repeat(body.mass, 3)
    phi = body.basis.values(modes.parameters)
    np.testing.assert_allclose(phi.T @ (mass[:, None] * phi), np.eye(modes.n_modes), atol=1e-11)
    scale = 1e-11 * modes.squared_frequencies[-1]
    np.testing.assert_allclose(phi.T @ k @ phi, np.diag(modes.squared_frequencies), atol=scale)


def test_the_tip_force_is_the_derivative_of_the_strain_energy():
    cloud, bottom = _cube(6, 0.2)
    body = conservative.assemble(cloud, CUBE, bottom, [_top(cloud, 0.3)])
    modes = elastic_modes(body)
    k = _free_stiffness(cloud)

    def energy(tip):
        q = -(modes.input_coupling @ tip) / modes.squared_frequencies
        u = body.basis.values(modes.parameters @ q + modes.patch_parameters @ tip).ravel()
        return 0.5 * u @ k @ u

    tip = np.array([0.1, -0.2, 0.3])
    # The energy is quadratic, so its central difference is exact.
    derivative = [(energy(tip + e) - energy(tip - e)) / 2 for e in np.eye(3)]
    np.testing.assert_allclose(modes.static_stiffness @ tip, derivative, rtol=1e-9)
    assert np.all(np.linalg.eigvalsh(modes.static_stiffness) > 0)
    # More tissue can only be softer than the tip's own stiffness with everything else held.
    assert np.all(np.linalg.eigvalsh(modes.direct_stiffness - modes.static_stiffness) > 0)


def test_two_patches_influence_each_other_by_the_same_amount():
    cloud, bottom = _cube(6)
    left = np.flatnonzero((cloud.points[:, 2] == 1) & (cloud.points[:, 0] < 0.3))
    right = np.flatnonzero((cloud.points[:, 2] == 1) & (cloud.points[:, 0] > 0.7))
    body = conservative.assemble(cloud, CUBE, bottom, [left, right])
    modes = elastic_modes(body)
    k = modes.static_stiffness
    assert k.shape == (6, 6)
    np.testing.assert_allclose(k, k.T, atol=1e-12 * np.abs(k).max())
    assert np.abs(k[:3, 3:]).max() > 1e-3 * np.abs(k).max()
    np.testing.assert_array_equal(modes.output_coupling, modes.input_coupling.T)
    moved = body.basis.values(modes.patch_parameters).sum(axis=0)
    np.testing.assert_allclose(moved, np.repeat([len(left), len(right)], 3), rtol=1e-11)


def test_nearly_incompressible_tissue_does_not_lock():
    """From nu = 0.3 to 0.499 lambda grows 290 times; stiffness and frequencies at equal G stay of one size."""
    cloud, bottom = _cube(8, 0.2)
    results = []
    for nu in (0.3, 0.49, 0.499):
        modes = _modes(cloud, bottom, [_top(cloud, 0.25)], Material(2 * (1 + nu), nu, 1.0))
        results.append((modes.static_stiffness[2, 2], *np.sqrt(modes.squared_frequencies[:3])))
    compressible, soft, nearly = np.array(results)
    # Exact for a bonded punch on a half-space at equal G: 4 ln(3 - 4 nu) / (1 - 2 nu) grows by a third from 0.3 to 0.5.
    assert np.all(nearly < 1.05 * soft)
    assert np.all(nearly < 1.45 * compressible)


def test_a_body_with_too_small_supports_is_refused_by_node():
    cloud, bottom = _cube(5, 0.25)
    with pytest.raises(SupportError, match=r"point \d+ at .* is covered by \d nodes.*enlarge"):
        conservative.assemble(cloud, CUBE, bottom, [], support_radius_factor=1.05)


@pytest.mark.parametrize(
    ("fixed", "contacts", "message"),
    [
        ([0, 125], [], r"fixed holds node 125: expected indices from 0 to 124"),
        ([0, 0], [], "fixed names a node twice"),
        ([0], [[]], r"contacts\[0\] is empty"),
        ([0], [[1], [2, 0]], r"node 0 is in fixed and in contacts\[1\]"),
        ([0.5], [], "fixed is float64"),
        (np.arange(125), [], "all 125 nodes"),
    ],
)
def test_inconsistent_supports_are_refused_by_name(fixed, contacts, message):
    cloud, _ = _cube(5)
    with pytest.raises(ValueError, match=message):
        conservative.assemble(cloud, CUBE, fixed, contacts)


@pytest.mark.slow
def test_the_table_of_cube_frequencies_is_that_of_quadratic_hexahedra():
    from scipy.sparse.linalg import eigsh
    from skfem import Basis, BilinearForm, ElementHex2, ElementVector, MeshHex, asm, condense
    from skfem.helpers import dot
    from skfem.models.elasticity import lame_parameters, linear_elasticity

    mesh = MeshHex.init_tensor(*[np.linspace(0, 1, 9)] * 3)
    basis = Basis(mesh, ElementVector(ElementHex2()), intorder=4)
    stiffness = asm(linear_elasticity(*lame_parameters(1.0, 0.3)), basis)
    mass = asm(BilinearForm(lambda u, v, _: 10.0 * dot(u, v)), basis)
    bottom = basis.get_dofs(lambda x: x[2] < 1e-9)
    k, m, *_ = condense(stiffness, mass, D=bottom)
    values = eigsh(k, 12, m, sigma=0.0, return_eigenvectors=False)
    np.testing.assert_allclose(np.sqrt(np.sort(values)) / (2 * np.pi), CUBE_FREQUENCIES, atol=6e-6)
