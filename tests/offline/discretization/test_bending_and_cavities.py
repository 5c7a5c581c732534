"""Thin parts, cavities and slits: against beams, Lamé's hollow sphere and quadratic finite elements."""

import numpy as np
import pytest
import trimesh
from scipy.sparse.linalg import splu

from palpate.discretization import conservative
from palpate.discretization.consistency import vector_areas
from palpate.geometry.cloud import TriangleSurface
from palpate.geometry.fill import fill_surface
from palpate.geometry.regions import contact_patch
from palpate.geometry.shapes import box_lattice
from palpate.geometry.soundness import check_surface
from palpate.geometry.spacing import Refinement
from palpate.modes.dense import elastic_modes
from palpate.scene.material import Material

# Angular frequencies of a cantilever 9 x 1 x 1, E = rho = 1, nu = 0.3: quadratic hexahedra, 18 x 3 x 3 (scikit-fem).
# With trilinear ones, 36 x 4 x 4, they are 1.8 and 2.0 % higher.
BENDING = np.array([0.012492, 0.012492, 0.074204, 0.074204])


def _bending_error(thickness_nodes, jitter=0.0):
    length_nodes = 9 * (thickness_nodes - 1) + 1
    counts = (length_nodes, thickness_nodes, thickness_nodes)
    cloud = box_lattice((0, 0, 0), (9, 1, 1), counts, jitter, seed=1)
    held = np.flatnonzero(cloud.points[:, 0] == 0)
    modes = elastic_modes(conservative.assemble(cloud, Material(1.0, 0.3, 1.0), held, []))
    return np.sqrt(modes.squared_frequencies[:4]) / BENDING - 1


def test_a_cantilever_two_and_three_nodes_thick_bends_within_seven_percent():
    # Two nodes: the third and fourth lowest are torsion and bending, which only three can tell apart.
    np.testing.assert_allclose(_bending_error(2)[:2], 0, atol=0.07)
    np.testing.assert_allclose(_bending_error(3), 0, atol=0.05)


@pytest.mark.slow
@pytest.mark.parametrize("jitter", [0.0, 0.25])
def test_a_cantilever_five_nodes_thick_bends_as_well_as_trilinear_elements(jitter):
    np.testing.assert_allclose(_bending_error(5, jitter), 0, atol=0.018)


def _hollow_sphere(inner, outer, subdivisions):
    mesh = trimesh.creation.icosphere(subdivisions=subdivisions)
    vertices, triangles = np.asarray(mesh.vertices), np.asarray(mesh.faces, np.int32)
    vertices = vertices * np.cbrt(4 * np.pi / 3 / mesh.volume)
    both = np.vstack([triangles, triangles[:, ::-1] + len(vertices)])
    return TriangleSurface(np.vstack([outer * vertices, inner * vertices]), both)


def _error_under_inner_pressure(spacing, nu):
    """Largest mean radial displacement error of the two surfaces of a hollow sphere of radii 1/2 and 1 under pressure 1."""
    a, b = 0.5, 1.0
    surface = _hollow_sphere(a, b, 3)
    check_surface(surface)
    cloud = fill_surface(surface, spacing)
    body = conservative.assemble(cloud, Material(1.0, nu, 1.0), [], [])
    radius = np.linalg.norm(cloud.points, axis=1)
    inner, outer = (cloud.boundary & (side * (radius - 0.75) > 0) for side in (-1, 1))
    forces = np.where(inner[:, None], -vector_areas(cloud), 0.0)
    load = (body.basis.value.T @ forces).ravel()
    # Nothing holds it: its rigid motions are given a stiffness, which the pressure does not load.
    rigid = [np.tile(e, (cloud.n_nodes, 1)) for e in np.eye(3)] + [
        np.cross(e, cloud.points) for e in np.eye(3)
    ]
    basis, _ = np.linalg.qr(np.column_stack([r.ravel() for r in rigid]))
    k = body.stiffness.toarray()
    parameters = np.linalg.solve(k + np.trace(k) / len(k) * basis @ basis.T, load - basis @ (basis.T @ load))
    u = body.basis.value @ parameters.reshape(-1, 3)
    radial = np.sum(u * cloud.points, axis=1) / radius
    exact = a**3 / (b**3 - a**3) * ((1 - 2 * nu) * radius + (1 + nu) * b**3 / (2 * radius**2))
    return max(abs(radial[on].mean() / exact[on].mean() - 1) for on in (inner, outer))


def test_a_hollow_sphere_under_pressure_widens_as_lame_says():
    assert _error_under_inner_pressure(0.2, 0.3) < 0.05


@pytest.mark.slow
@pytest.mark.parametrize("nu", [0.3, 0.49])
def test_a_hollow_sphere_converges_to_lames_solution(nu):
    coarse, fine = (_error_under_inner_pressure(h, nu) for h in (0.2, 0.14))
    assert fine < 0.03
    assert fine < 0.6 * coarse


E_PA, NU = 2900.0, 0.45
CENTER, RADIUS = (0.048, 0.04, 0.015), 0.006


def _prongs_by_finite_elements(gap):
    """N/m: quadratic hexahedra, half of the body by symmetry, finer around the patch."""
    from skfem import Basis, ElementHex2, ElementVector, MeshHex, asm
    from skfem.models.elasticity import lame_parameters, linear_elasticity

    low, high = 0.02 - gap / 2, 0.02 + gap / 2

    def lines(*parts):
        return np.concatenate([[0.0], *(np.linspace(a, b, n + 1)[1:] for a, b, n in parts)])

    x = lines((0, 0.015, 3), (0.015, 0.038, 5), (0.038, 0.058, 10), (0.058, 0.06, 1))
    y = lines((0, low, 2), (low, high, 1), (high, 0.034, 3), (0.034, 0.04, 2))
    mesh = MeshHex.init_tensor(x, y, lines((0, 0.008, 2), (0.008, 0.015, 4)))
    middle = mesh.p[:, mesh.t].mean(axis=1)
    mesh = mesh.remove_elements(np.flatnonzero((middle[0] > 0.015) & (middle[1] > low) & (middle[1] < high)))
    basis = Basis(mesh, ElementVector(ElementHex2()), intorder=4)
    k = asm(linear_elasticity(*lame_parameters(E_PA, NU)), basis).tocsc()
    place, component = basis.doflocs, np.zeros(basis.N, int)
    for dofs in (basis.nodal_dofs, basis.edge_dofs, basis.facet_dofs, basis.interior_dofs):
        component[dofs] = (np.arange(len(dofs)) % 3)[:, None]
    away = np.hypot(place[0] - CENTER[0], place[2] - CENTER[2])
    patch = (np.abs(place[1] - CENTER[1]) < 1e-9) & (away <= RADIUS + 1e-9)
    given = (place[0] < 1e-9) | patch | (np.abs(place[2] - 0.015) < 1e-9) & (component == 2)
    u = np.where(patch & (component == 1), 1.0, 0.0)
    free = np.flatnonzero(~given)
    factor = splu(k[free][:, free].tocsc(), permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True})
    u[free] = factor.solve(-(k[free] @ u))
    return 2 * u @ (k @ u)


@pytest.mark.slow
@pytest.mark.parametrize("gap", [0.002, 0.006])
def test_a_prong_next_to_a_slit_is_within_ten_percent_of_finite_elements(two_prongs, gap):
    cloud = fill_surface(two_prongs(gap), 0.004, [Refinement(CENTER, RADIUS, 0.002)])
    held = np.flatnonzero(cloud.boundary & (cloud.points[:, 0] < 1e-6))
    patch = contact_patch(CENTER, RADIUS, cloud)
    modes = elastic_modes(conservative.assemble(cloud, Material(E_PA, NU, 1060.0), held, [patch.nodes]))
    assert modes.static_stiffness[1, 1] == pytest.approx(_prongs_by_finite_elements(gap), rel=0.1)
