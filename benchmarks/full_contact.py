"""Frictionless spheres on a body with all its modes, exact in time: what a surface model is measured against.

Nothing is reduced: the modes are all that the body has, so there is no residual. Between two positions of the device each mode,
with its memory, is advanced by the exponential of its equations under a force that is constant. The contact is solved by
nonnegative least squares: forces along the normals at rest, complementary to the gap along them (Signorini). The sphere hangs
on a spring, as the server's tip does.

The gap is measured as the server measures it (docs/contact.md), so this is a reference for body, time and solver. It is closed in every
tick: the server leaves what its equations did not foresee, such as the drift of a tick, as old penetration. What the
kinematics of the contact are worth is seen by Hertz's and Sneddon's solutions and by finite elements.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cholesky, expm, solve_triangular
from scipy.optimize import nnls
from scipy.sparse import csr_array

from palpate.discretization import conservative
from palpate.geometry.node_surface import node_surface
from palpate.model_file.contact_size import blunted_radius_m
from palpate.modes.dense import elastic_modes
from palpate.scene.schema import Config
from palpate.scene_cloud import build_cloud, fixed_nodes
from palpate.surface_model.footprint import on_components

Floats = NDArray[np.float64]

_REACH_M = 2e-3  # of a gap: points farther away are not solved for


@dataclass(frozen=True)
class FullBody:
    """points, normals (m, 3), at rest; triangles (t, 3); squared_frequencies (n,), (rad/s)²; shapes (m, 3, n), kg^-1/2; gamma, tau_s (t,)"""

    points: Floats
    normals: Floats
    triangles: NDArray[np.int32]
    squared_frequencies: Floats
    shapes: Floats
    gamma: Floats
    tau_s: Floats


@dataclass(frozen=True)
class Tip:
    """A sphere on a spring."""

    radius_m: float
    stiffness_n_per_m: float


def full_body(config: Config, folder: Path = Path()) -> FullBody:
    """The body of a scene with the surface points of its surface model, by dense linear algebra: (3 n_nodes)³ work."""
    material, cloud = config.material.material(), build_cloud(config, folder)
    body = conservative.assemble(
        cloud, material, fixed_nodes(config, cloud), [], config.discretization.support_radius
    )
    nodes, modes = np.flatnonzero(cloud.boundary), elastic_modes(body)
    rows = on_components(csr_array(body.basis.value[nodes]))
    shapes = np.asarray(rows @ modes.parameters, float)
    return FullBody(
        points=cloud.points[nodes],
        normals=cloud.normals[nodes],
        triangles=node_surface(cloud).triangles,
        squared_frequencies=np.asarray(modes.squared_frequencies, float),
        shapes=shapes.reshape(len(nodes), 3, -1),
        gamma=np.array(material.prony.gamma),
        tau_s=np.array(material.prony.tau_s),
    )


def press(body: FullBody, tip: Tip, positions_m: Floats, period_s: float) -> tuple[Floats, Floats]:
    """Forces on the tip (n, 3), N, and how far the tissue moves at most (n,), m, while the device is moved through positions (n, 3), m.

    The body begins at rest, and the first position is clear of it. A force is constant in a period.
    """
    near = np.flatnonzero(_distance(body.points, positions_m) < 1.5 * tip.radius_m + 0.02)
    points, inward = body.points[near], -body.normals[near]
    shapes = body.shapes[near].reshape(3 * len(near), -1)
    radii = blunted_radius_m(body.points, body.triangles, tip.radius_m)[near]
    free, driven = _propagator(body, period_s)
    compliance = (shapes * driven[0]) @ shapes.T
    state = np.zeros((2 + len(body.tau_s), len(body.squared_frequencies)))
    displacement, drift = np.zeros((len(near), 3)), np.zeros(3)
    center = positions_m[0]
    forces, moved = np.zeros((len(positions_m), 3)), np.zeros(len(positions_m))
    for k, device in enumerate(positions_m):
        state = np.einsum("ijk,jk->ik", free, state)
        unloaded = (shapes @ state[0]).reshape(-1, 3)
        depth, felt = _sphere(points + drift - center, inward, radii)
        height = np.einsum("pi,pi->p", points + displacement - center, inward)
        gap = height - (depth - (radii - tip.radius_m))  # a blunter tip has the same lowest point
        closing = np.einsum("pi,pi->p", unloaded - displacement, inward) - felt @ (device - center)
        rows = np.flatnonzero((gap + closing < _REACH_M) & (height > 0) & (depth > 0))
        load = np.zeros((len(near), 3))
        reaction, drift = np.zeros(3), displacement[np.argmin(np.where(height > 0, gap, np.inf))]
        if len(rows):
            spring = felt[rows] @ felt[rows].T / tip.stiffness_n_per_m
            blocks = compliance.reshape(len(near), 3, len(near), 3)[rows][:, :, rows]
            matrix = np.einsum("pi,piqj,qj->pq", inward[rows], blocks, inward[rows]) + spring
            pressed = complementary(matrix, closing[rows] + gap[rows])
            load[rows] = pressed[:, None] * inward[rows]
            reaction = pressed @ felt[rows]
            if pressed.any():
                drift = pressed @ displacement[rows] / pressed.sum()
        state = state + driven * (shapes.T @ load.ravel())
        displacement = (shapes @ state[0]).reshape(-1, 3)
        center = device - reaction / tip.stiffness_n_per_m
        forces[k], moved[k] = -reaction, np.abs(displacement).max()
    return forces, moved


def _sphere(away: Floats, inward: Floats, radius: Floats) -> tuple[Floats, Floats]:
    """Of points `away` (m, 3) from the center of a sphere, of a radius (m,) for each: how far the tip reaches along their inward normals (m,), and the gradient of the gap (m, 3).

    Where a sphere is steeper than 60 degrees, the tip is the cone that touches it there.
    """
    beside = away - np.einsum("pi,pi->p", away, inward)[:, None] * inward
    lateral = np.sqrt(np.einsum("pi,pi->p", beside, beside))
    edge = radius * np.sqrt(3.0) / 2
    round_depth = np.sqrt(radius**2 - np.minimum(lateral, edge) ** 2)
    depth = round_depth - np.sqrt(3.0) * np.maximum(lateral - edge, 0.0)
    slope = np.where(lateral < edge, 1 / round_depth, np.sqrt(3.0) / np.maximum(lateral, edge))
    return depth, inward + slope[:, None] * beside


def _distance(points: Floats, positions: Floats) -> Floats:
    """(m,): of each point from the nearest of some positions."""
    return np.min(np.linalg.norm(points[:, None] - positions[::10], axis=2), axis=1)


def complementary(matrix: Floats, gap: Floats) -> Floats:
    """(k,): p >= 0, complementary to gap + A p >= 0, of a definite matrix A (k, k)."""
    k = len(gap)
    factor = cholesky(matrix + 1e-12 * np.trace(matrix) / k * np.eye(k), lower=True)
    return nnls(factor.T, -solve_triangular(factor, gap, lower=True))[0]


def _propagator(body: FullBody, period_s: float) -> tuple[Floats, Floats]:
    """(2 + t, 2 + t, n) and (2 + t, n): (q, v, z_1, ...) of each mode after a period, from before and from a unit modal force.

    q' = v,  v' = f - omega² (q + sum_j gamma_j z_j),  z_j' = v - z_j / tau_j
    """
    squared, t = body.squared_frequencies, len(body.tau_s)
    rates = np.zeros((len(squared), 3 + t, 3 + t))
    rates[:, 0, 1] = rates[:, 1, 2 + t] = 1.0
    rates[:, 1, 0] = -squared
    rates[:, 1, 2 : 2 + t] = -squared[:, None] * body.gamma
    for j, tau in enumerate(body.tau_s):
        rates[:, 2 + j, 1], rates[:, 2 + j, 2 + j] = 1.0, -1 / tau
    steps = expm(rates * period_s)
    return np.ascontiguousarray(np.moveaxis(steps[:, : 2 + t, : 2 + t], 0, 2)), steps[
        :, : 2 + t, 2 + t
    ].T.copy()
