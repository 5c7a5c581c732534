"""A surface model that needs no organ: an elastic half-space by its analytic compliance, with modes of no body beside it."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from palpate.model_file import SurfaceAccuracy, SurfaceModel, ToolShape

Floats = NDArray[np.float64]

_SQUARE = 4 * np.log(1 + np.sqrt(2))  # integral of 1/r over a unit square from its center


def half_space_model(
    tools: Sequence[ToolShape],
    count: int = 21,
    spacing_m: float = 3e-3,
    young_pa: float = 1e4,
    softness: Callable[[Floats], Floats] | None = None,
    prony: tuple[Sequence[float], Sequence[float]] = ((), ()),
    n_modes: int = 0,
) -> SurfaceModel:
    """count x count points on the plane z = 0 of an incompressible half-space z < 0, around the origin.

    young_pa  relaxed modulus
    softness  (n_points, 3) -> (n_points,): factor of the compliance where both points are; 1 everywhere if left out
    prony     gamma and tau_s
    n_modes   of 2 to 60 Hz with smooth random shapes, which carry some of a point's compliance each

    The compliance is Boussinesq's and Cerruti's for Poisson's ratio 1/2 (Johnson, Contact Mechanics, 1985, section 3.2); a
    force at a point acts on the square around it, on which the point itself is averaged. A diagonal shift of the smallest
    eigenvalue makes it semidefinite. There is no body to be accurate to: the evidence is not a number.
    """
    axis = (np.arange(count) - (count - 1) / 2) * spacing_m
    x, y = (a.ravel() for a in np.meshgrid(axis, axis, indexing="ij"))
    points = np.stack([x, y, np.zeros(count**2)], axis=1)
    compliance = _compliance(points, spacing_m, young_pa / 3)
    if softness is not None:
        scale = np.sqrt(np.repeat(softness(points), 3))
        compliance *= scale[:, None] * scale
    frequencies = np.geomspace(2.0, 60.0, n_modes) * 2 * np.pi
    return SurfaceModel(
        name="half-space",
        period_s=1e-3,
        n_nodes=0,
        tools=tuple(tools),
        points=points,
        normals=np.tile([0.0, 0.0, 1.0], (count**2, 1)),
        triangles=_triangles(count),
        held=np.zeros(count**2, bool),
        squared_frequencies=frequencies**2,
        shapes=_shapes(points, frequencies, compliance[0, 0]),
        residual=compliance.astype(np.float32),
        gamma=np.array(prony[0], float),
        tau_s=np.array(prony[1], float),
        band_hz=(0.0, 30.0),
        config="",
        config_sha256="",
        built_with="",
        accuracy=SurfaceAccuracy.unknown(count**2),
    )


def _compliance(points: Floats, spacing: float, shear_pa: float) -> Floats:
    """(3 n, 3 n), m/N."""
    n = len(points)
    away = points[:, None] - points
    distance = np.linalg.norm(away, axis=2)
    np.fill_diagonal(distance, 1.0)
    compliance = np.zeros((n, 3, n, 3))
    for i in range(3):
        for j in range(3):
            compliance[:, i, :, j] = (i == j) / distance + away[..., i] * away[..., j] / distance**3
        k = np.arange(n)
        compliance[k, :, k, i] = 0.0
        compliance[k, i, k, i] = _SQUARE / spacing * (1.0 if i == 2 else 1.5)
    compliance = compliance.reshape(3 * n, 3 * n) / (4 * np.pi * shear_pa)
    lowest = np.linalg.eigvalsh(compliance)[0]
    rounding = 1e-6 * compliance.max()  # of float32
    return compliance + max(0.0, rounding - lowest) * np.eye(3 * n)


def _triangles(count: int) -> NDArray[np.int32]:
    i = np.arange(count**2).reshape(count, count)
    a, b, c, d = (corner.ravel() for corner in (i[:-1, :-1], i[1:, :-1], i[1:, 1:], i[:-1, 1:]))
    return np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)]).astype(np.int32)


def _shapes(points: Floats, frequencies: Floats, compliance: float) -> NDArray[np.float32]:
    """(n, 3, n_modes): waves in random directions, together as compliant as a point is."""
    random = np.random.default_rng(0)
    size = max(np.ptp(points), 1e-9)
    shapes = np.empty((len(points), 3, len(frequencies)))
    for k, frequency in enumerate(frequencies):
        wave = np.pi * (1 + 5 * random.random()) / size * random.normal(size=3)
        amplitude = frequency * np.sqrt(2 * compliance / len(frequencies)) * random.uniform(-1, 1, 3)
        shapes[:, :, k] = np.cos(points @ wave + random.uniform(0, np.pi))[:, None] * amplitude
    return shapes.astype(np.float32)
