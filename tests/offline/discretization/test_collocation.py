"""The paper's collocation against exact fields and its own equations; its stability on the paper's cube."""

import numpy as np
import pytest

from palpate.discretization import collocation
from palpate.geometry.shapes import ball, box_lattice
from palpate.modes.dense import elastic_modes, nodal_stiffness
from palpate.scene.material import PronySeries
from palpate.scene.tissues import PRESETS
from palpate_paper.stability import stability

EPS = np.finfo(float).eps
CUBE = PRESETS["paper-cube"]
CLOUDS = {
    "lattice": lambda: box_lattice((0, 0, 0), (1, 1, 1), (6, 6, 6)),
    "jittered": lambda: box_lattice((0, 0, 0), (1, 1, 1), (6, 6, 6), 0.2, seed=3),
    "ball": lambda: ball(1.0, 0.28),
}


@pytest.fixture(params=CLOUDS)
def cloud(request):
    return CLOUDS[request.param]()


def _cube(n, jitter=0.0):
    cloud = box_lattice((0, 0, 0), (1, 1, 1), (n, n, n), jitter, seed=3)
    return cloud, np.flatnonzero(cloud.points[:, 2] == 0)


def _top_center(cloud):
    """The node or the four nodes nearest to the center of the top face."""
    distance = np.linalg.norm(cloud.points - [0.5, 0.5, 1], axis=1)
    return np.flatnonzero(distance < distance.min() + 1e-9)


def _rows(cloud):
    """Functions of node indices: the rows of momentum and of traction, acting on nodal values."""
    force = nodal_stiffness(collocation.assemble(cloud, CUBE, [], [])).reshape(cloud.n_nodes, 3, -1)

    def rows(measure, nodes):
        return (force[nodes] / measure[nodes, None, None]).reshape(3 * len(nodes), -1)

    return lambda nodes: -rows(cloud.volumes, nodes), lambda nodes: rows(cloud.areas, nodes)


def test_linear_fields_have_exact_tractions_and_no_body_force_and_rigid_motions_have_neither(cloud):
    divergence_of_stress, traction_rows = _rows(cloud)
    inside, surface = np.flatnonzero(~cloud.boundary), np.flatnonzero(cloud.boundary)
    divergence, traction = divergence_of_stress(inside), traction_rows(surface)
    rotation = np.array([[0, -0.4, 0.2], [0.4, 0, -0.7], [-0.2, 0.7, 0]])
    strain = np.array([[0.3, 0.7, -0.2], [0.1, -0.4, 0.5], [0.6, 0.2, 0.9]])
    for gradient in (np.zeros((3, 3)), rotation, strain):
        u = (cloud.points @ gradient.T + [0.1, 0.2, -0.3]).ravel()
        stress = CUBE.lame_lambda_pa * np.trace(gradient) * np.eye(3) + CUBE.shear_modulus_pa * (
            gradient + gradient.T
        )
        for rows, exact in ((divergence, 0.0), (traction, (cloud.normals[surface] @ stress).ravel())):
            round_off = 1e3 * EPS * np.abs(rows).sum(axis=1).max()
            np.testing.assert_allclose(rows @ u, exact, atol=round_off)


def test_the_patch_test_is_solved_exactly(cloud):
    """A linear field prescribed on the whole boundary is the solution inside."""
    divergence_of_stress, _ = _rows(cloud)
    inside = np.flatnonzero(~cloud.boundary)
    strain = np.array([[0.3, 0.7, -0.2], [0.1, -0.4, 0.5], [0.6, 0.2, 0.9]])
    exact = (cloud.points @ strain.T).ravel()
    free = (3 * inside[:, None] + np.arange(3)).ravel()
    rows = divergence_of_stress(inside)
    known = np.delete(rows, free, axis=1) @ np.delete(exact, free)
    np.testing.assert_allclose(np.linalg.solve(rows[:, free], -known), exact[free], atol=1e-11)


def test_modes_satisfy_momentum_inside_and_zero_traction_on_the_free_surface():
    cloud, bottom = _cube(6, 0.1)
    tip = _top_center(cloud)
    body = collocation.assemble(cloud, CUBE, bottom, [tip])
    modes = elastic_modes(body)
    divergence_of_stress, traction_rows = _rows(cloud)
    held = np.concatenate([bottom, tip])
    surface = np.setdiff1d(np.flatnonzero(cloud.boundary), held)
    inside = np.flatnonzero(~cloud.boundary)
    shapes = body.basis.values(modes.parameters)
    shapes /= np.linalg.norm(shapes, axis=0)
    divergence = divergence_of_stress(inside)
    inertia = (
        -CUBE.density_kg_per_m3 * shapes.reshape(cloud.n_nodes, 3, -1)[inside] * modes.squared_frequencies
    )
    scale = 1e-11 * np.abs(divergence).sum(axis=1).max()
    np.testing.assert_allclose(divergence @ shapes, inertia.reshape(len(divergence), -1), atol=scale)
    traction = traction_rows(surface)
    scale = 1e-11 * np.abs(traction).sum(axis=1).max()
    np.testing.assert_allclose(traction @ shapes, 0, atol=scale)
    np.testing.assert_allclose(traction @ body.basis.values(modes.patch_parameters), 0, atol=scale)
    np.testing.assert_allclose(shapes.reshape(cloud.n_nodes, 3, -1)[held], 0, atol=1e3 * EPS)


def test_the_static_force_is_the_traction_of_the_static_solution_times_its_area():
    cloud, bottom = _cube(6, 0.1)
    tip = _top_center(cloud)
    body = collocation.assemble(cloud, CUBE, bottom, [tip])
    modes = elastic_modes(body)
    divergence_of_stress, traction_rows = _rows(cloud)
    # All rows at once, nothing eliminated.
    inside = np.flatnonzero(~cloud.boundary)
    surface = np.setdiff1d(np.flatnonzero(cloud.boundary), np.concatenate([bottom, tip]))
    free = (3 * np.concatenate([inside, surface])[:, None] + np.arange(3)).ravel()
    rows = np.vstack([divergence_of_stress(inside), traction_rows(surface)])
    tip_motion = body.basis.values(modes.patch_parameters)
    tip_motion[free] = 0
    solution = tip_motion.copy()
    solution[free] = np.linalg.solve(rows[:, free], -rows @ tip_motion)
    force = np.einsum("k,kai->ai", cloud.areas[tip], (traction_rows(tip) @ solution).reshape(len(tip), 3, 3))
    np.testing.assert_allclose(modes.static_stiffness, force, atol=1e-9 * np.abs(force).max())


@pytest.mark.parametrize("tip", ["one node", "four nodes"])
@pytest.mark.parametrize(
    "n_nodes", [6, pytest.param(10, marks=pytest.mark.slow)]
)  # along an edge; the paper has 10
def test_all_poles_of_the_papers_cube_are_in_the_left_half_plane(tip, n_nodes):
    cloud, bottom = _cube(n_nodes)
    contacts = {"one node": [_top_center(cloud)[:1]], "four nodes": [_top_center(cloud)]}[tip]
    modes = elastic_modes(collocation.assemble(cloud, CUBE, bottom, contacts))
    judged = stability(modes, CUBE.prony)
    assert judged.growing_modes == 0
    assert judged.spectral_abscissa_per_s < 0
    # The roots of s² (1 + s tau) + mu (1 + s tau + gamma s tau), mode by mode, say the same.
    (gamma,), (tau,) = CUBE.prony.gamma, CUBE.prony.tau_s
    roots = [np.roots([tau, 1, mu * tau * (1 + gamma), mu]) for mu in modes.squared_frequencies]
    assert np.max(np.real(roots)) == pytest.approx(judged.spectral_abscissa_per_s, rel=1e-6)


def test_complex_modes_come_in_conjugate_pairs_ascending_in_size():
    cloud, bottom = _cube(7, 0.2)
    modes = elastic_modes(collocation.assemble(cloud, CUBE, bottom, [_top_center(cloud)]))
    mu = modes.squared_frequencies
    assert np.all(np.diff(np.abs(mu)) >= 0)
    np.testing.assert_allclose(np.sort_complex(mu), np.sort_complex(mu.conj()), rtol=1e-9)


def test_stability_counts_growing_modes_and_its_damping_is_just_enough():
    class Modes:
        squared_frequencies = np.array([1.0, 4 + 0.4j, 4 - 0.4j])

    judged = stability(Modes, PronySeries())
    assert judged.growing_modes == 2
    assert judged.largest_imaginary_part == pytest.approx(0.4 / abs(4 + 0.4j))
    c = judged.curing_damping_per_s
    for factor, sign in ((0.99, 1), (1.01, -1)):
        real = max(np.roots([1, factor * c, mu]).real.max() for mu in Modes.squared_frequencies)
        assert sign * real > 0
    assert stability(Modes, PronySeries((1.0,), (1.0,))).growing_modes == 0


def test_a_statically_diverging_mode_is_reported_as_incurable():
    class Modes:
        squared_frequencies = np.array([1.0, -0.1 + 0j])

    judged = stability(Modes, CUBE.prony)
    assert judged.growing_modes == 1
    assert judged.curing_damping_per_s == np.inf


def test_a_patch_node_inside_the_body_is_refused_by_name():
    cloud, bottom = _cube(5)
    inside = np.flatnonzero(~cloud.boundary)[0]
    with pytest.raises(ValueError, match=rf"contacts\[0\] holds node {inside}, which is not on the boundary"):
        collocation.assemble(cloud, CUBE, bottom, [[inside]])
