"""A sphere on an ellipsoid: from a scene to the force of its surface model, against finite elements with the same unilateral contact."""

from __future__ import annotations

import itertools
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import skfem
import trimesh
from numpy.typing import NDArray
from scipy.sparse.linalg import splu
from skfem.helpers import ddot, eye, sym_grad, trace

from full_contact import complementary
from palpate.build_surface import build_surface_model
from palpate.geometry.ply import ply_bytes
from palpate.model_file import SurfaceModel
from palpate.scene.schema import check_config
from palpate.scene.tissues import PRESETS
from palpate_server.simulation import Simulation

Floats = NDArray[np.float64]

AXES_M = np.array([0.030, 0.024, 0.020])
HELD_BELOW_M = -0.006
DEPTH_OVER_RADIUS = 0.3

TOP = AXES_M * np.array([0.0, 0.0, 1.0])
SIDE = AXES_M * np.array([0.6, -0.3, 0.74]) / np.linalg.norm([0.6, -0.3, 0.74])

SCENE = """
name = "ellipsoid"
[geometry]
shape = "surface"
file = "ellipsoid.ply"
spacing_m = {spacing}
[material]
preset = "liver"
[[fixed]]
region = "plane"
point_m = [0.0, 0.0, {held}]
normal = [0.0, 0.0, -1.0]
[surface]
modes = 80
band_hz = [0.0, 5.0]
spacing_m = {fine}
{areas}
[[tool]]
name = "tip"
radius_m = {radius}
friction = 0.0
"""

AREA = """
[[surface.working_area]]
region = "sphere"
center_m = {center}
radius_m = {radius}
"""


def outward(points: Floats) -> Floats:
    """(3, ...) of points (3, ...) on the ellipsoid."""
    gradient = points / AXES_M.reshape(3, *[1] * (points.ndim - 1)) ** 2
    return gradient / np.linalg.norm(gradient, axis=0)


def built(
    folder: Path, place: Floats, radius: float, area_radius: float, fine: float, spacing: float
) -> SurfaceModel:
    sphere = trimesh.creation.icosphere(subdivisions=4)
    (folder / "ellipsoid.ply").write_bytes(ply_bytes(sphere.vertices * AXES_M, sphere.faces))
    area = AREA.format(center=place.tolist(), radius=area_radius)
    text = SCENE.format(spacing=spacing, held=HELD_BELOW_M, fine=fine, areas=area, radius=radius)
    return build_surface_model(check_config(tomllib.loads(text), "ellipsoid"), folder)


def felt(model: SurfaceModel, place: Floats) -> float:
    """N, along the normal, at rest: 3 s after the last of its motion."""
    simulation, normal, radius = Simulation(model, 1e6), outward(place), model.tools[0].radius_m
    for depth in np.minimum(np.linspace(-0.05, 5 * DEPTH_OVER_RADIUS, 3500), DEPTH_OVER_RADIUS):
        reaction = simulation.step({"tip": place + (1 - depth) * radius * normal})["tip"]
    return float(reaction.force_n @ normal)


def mesh_around(place: Floats, size_m: float) -> skfem.MeshTet:
    """Tetrahedra of the ellipsoid: `size_m` where the tip touches, larger farther away."""
    mesh = skfem.MeshTet.init_ball(1)
    while True:
        corners = mesh.p[:, mesh.t] * AXES_M[:, None, None]
        away = np.linalg.norm(corners.mean(axis=1) - place[:, None], axis=0)
        pairs = itertools.combinations(range(4), 2)
        longest = np.max([np.linalg.norm(corners[:, i] - corners[:, j], axis=0) for i, j in pairs], axis=0)
        large = np.flatnonzero(longest > size_m + 0.6 * np.maximum(away - 0.005, 0.0))
        if not len(large):
            return skfem.MeshTet(mesh.p * AXES_M[:, None], mesh.t)
        mesh = mesh.refined(large)
        points, boundary = mesh.p.copy(), mesh.boundary_nodes()
        points[:, boundary] /= np.linalg.norm(points[:, boundary], axis=0)
        mesh = skfem.MeshTet(points, mesh.t)


def by_finite_elements(place: Floats, radius_m: float, size_m: float) -> float:
    """N, along the normal. Quadratic displacement; pressure linear on the faces, not negative, complementary to the mean gap.

    Beside the normals the sphere stands over the body at rest, moved by the mean displacement of what is pressed.
    """
    mesh, material = mesh_around(place, size_m), PRESETS["liver"]
    basis = skfem.Basis(mesh, skfem.ElementVector(skfem.ElementTetP2()), intorder=3)
    lame, mu = material.lame_lambda_pa, material.shear_modulus_pa

    @skfem.BilinearForm
    def stiffness(u: Any, v: Any, w: Any) -> Any:
        strain = sym_grad(u)
        return ddot(2 * mu * strain + eye(lame * trace(strain), 3), sym_grad(v))

    @skfem.BilinearForm
    def inward(pressure: Any, v: Any, w: Any) -> Any:
        return -pressure * (w.normal[0] * v[0] + w.normal[1] * v[1] + w.normal[2] * v[2])

    @skfem.LinearForm
    def weighted(v: Any, w: Any) -> Any:
        return w.field * v

    held = basis.get_dofs(mesh.facets_satisfying(lambda x: x[2] < HELD_BELOW_M, boundaries_only=True)).all()
    free = np.setdiff1d(np.arange(basis.N), held)
    factor = splu(stiffness.assemble(basis)[free][:, free].tocsc(), permc_spec="MMD_AT_PLUS_A")

    def touched(x: Floats) -> Any:
        return np.linalg.norm(x - place[:, None], axis=0) < 0.6 * radius_m

    faces = mesh.facets_satisfying(touched, boundaries_only=True)
    moved = skfem.FacetBasis(mesh, basis.elem, facets=faces, intorder=4)
    pressed = skfem.FacetBasis(mesh, skfem.ElementTetP1(), facets=faces, intorder=4)
    vertices = np.unique(mesh.facets[:, faces])
    x = np.asarray(moved.global_coordinates())
    loads = inward.assemble(pressed, moved, normal=outward(x))[:, vertices].toarray()
    responses = np.zeros(loads.shape)
    responses[free] = factor.solve(loads[free])

    def integral(field: Floats) -> Floats:
        return np.asarray(weighted.assemble(pressed, field=field))[vertices]

    return equilibrium(
        x,
        place,
        radius_m,
        integral,
        loads.T @ responses,
        lambda pressure: np.asarray(moved.interpolate(responses @ pressure)),
    )


def equilibrium(
    x: Floats,
    place: Floats,
    radius_m: float,
    integral: Callable[[Floats], Floats],
    compliance: Floats,
    displacement: Callable[[Floats], Floats],
) -> float:
    """The force, N, of a sphere on quadrature points x (3, n_faces, n_points), m.

    integral      of a field (n_faces, n_points) times each of the functions of the pressure
    displacement  (3, n_faces, n_points), m, from the pressure
    """
    normal, center = outward(x), place + (1 - DEPTH_OVER_RADIUS) * radius_m * outward(place)
    height = -np.einsum("ifq,ifq->fq", x - center[:, None, None], normal)
    mean, force, before = np.zeros(3), 0.0, np.inf
    while abs(force - before) > 1e-5 * force:
        before = force
        away = x + mean[:, None, None] - center[:, None, None]
        beside = away - np.einsum("ifq,ifq->fq", away, normal) * normal
        squared = np.einsum("ifq,ifq->fq", beside, beside)
        reach = np.sqrt(np.maximum(radius_m**2 - squared, (0.1 * radius_m) ** 2))  # far from what is pressed
        pressure = complementary(compliance, integral(height - reach))
        shares = np.array([integral(u) @ pressure for u in displacement(pressure)])
        mean = shares / (integral(np.ones_like(height)) @ pressure)
        # The tip feels the gradient of the gap.
        gradient = np.einsum("i,ifq->fq", outward(place), normal - beside / reach)
        force = float(integral(gradient) @ pressure)
    return force


@pytest.mark.slow
def test_a_tip_on_an_ellipsoid_feels_what_finite_elements_say(tmp_path: Path) -> None:
    radius = 0.012
    model = built(tmp_path, TOP, radius, 0.010, fine=0.002, spacing=0.006)
    assert felt(model, TOP) == pytest.approx(by_finite_elements(TOP, radius, 0.004), rel=0.08)


@pytest.mark.slow
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("place", [pytest.param(TOP, id="top"), pytest.param(SIDE, id="side")])
def test_a_smaller_tip_on_finer_points_is_closer_to_finite_elements(tmp_path: Path, place: Floats) -> None:
    """The body gives way by 1.9 of the 2.4 mm, so the contact's radius is 1.8 mm: points are 1.5 mm apart."""
    radius = 0.008
    model = built(tmp_path, place, radius, 0.007, fine=0.0015, spacing=0.004)
    assert felt(model, place) == pytest.approx(by_finite_elements(place, radius, 0.0025), rel=0.05)
