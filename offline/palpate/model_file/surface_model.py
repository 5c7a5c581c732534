"""The data classes of a surface model: a body that rigid tools touch anywhere on its surface."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ToolShape:
    """A rigid sphere that touches the surface.

    friction  Coulomb's coefficient against the tissue
    home_m    where its center starts, in the model frame, clear of the surface
    """

    name: str
    radius_m: float
    friction: float
    home_m: tuple[float, float, float]


@dataclass(frozen=True)
class SurfaceModel:
    """Modes of a body held at its supports alone, and the static compliance of what they leave out.

    The displacement of the points under forces f at them is, with h(s) = 1 + sum_j gamma_j s tau_j / (1 + s tau_j),
    u = sum_k phi_k (phi_k . f) / (s² + omega_k² h) + R f / h. The model is continuous in time.

    points               (n_points, 3), m: fixed material points at rest, the vertices that are shown and touched
    normals              (n_points, 3), outward unit normals at rest
    triangles            (n_triangles, 3), counter-clockwise from outside
    held                 (n_points,): the supports hold the point; its rows of shapes and residual are zero
    squared_frequencies  (n_modes,), omega_k², (rad/s)², ascending
    shapes               (n_points, 3, n_modes), phi_k, mass-normalized, kg^-1/2
    residual             (3 n_points, 3 n_points), R, m/N, symmetric and positive semidefinite
    gamma, tau_s         (n_terms,), the Prony series, relative to the relaxed modulus
    """

    kind: ClassVar[str] = "surface"

    name: str
    period_s: float
    n_nodes: int
    tools: tuple[ToolShape, ...]
    points: Array
    normals: Array
    triangles: NDArray[np.int32]
    held: NDArray[np.bool_]
    squared_frequencies: Array
    shapes: NDArray[np.float32]
    residual: NDArray[np.float32]
    gamma: Array
    tau_s: Array
    band_hz: tuple[float, float]
    config: str
    config_sha256: str
    built_with: str

    @property
    def n_points(self) -> int:
        return len(self.points)

    @property
    def n_modes(self) -> int:
        return len(self.squared_frequencies)
