"""The data classes of a surface model: a body that rigid tools touch anywhere on its surface."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from palpate.model_file.types import FORMAT, SCHEMA_VERSION, UNITS

LEAST_RADIUS_M, MOST_RADIUS_M = 1e-4, 1.0
MOST_FRICTION = 2.0

SAMPLE_SIZE = 204
"""Points at which the errors of a model are measured; all there are where that is fewer."""

_ROUND_OFF = 1e-9
"""Of a passivity margin: what double precision leaves near a resonance without damping."""

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ToolShape:
    """A rigid sphere that touches the surface.

    radius_m  LEAST_RADIUS_M to MOST_RADIUS_M
    friction  Coulomb's coefficient against the tissue, 0 to MOST_FRICTION
    home_m    where its center starts, in the model frame, clear of the surface
    """

    name: str
    radius_m: float
    friction: float
    home_m: tuple[float, float, float]


@dataclass(frozen=True)
class SurfaceAccuracy:
    """How good a surface model is, for the smallest tool pressed in by half its radius; against the assembled body.

    The tool displaces the points in contact alike; C is the compliance of this footprint, (3, 3). An error is the largest,
    over the directions, of |force error| / |force|. Relative errors are fractions.

    contact_radius_m          radius of the contact, sqrt(radius * depth) (Hertz 1882)
    error_static              largest at 0 Hz over a sample of SAMPLE_SIZE points, against static solutions of their own
    error_static_median       the median over the sample
    error_in_band             largest in the band over the sample, against the assembled body; before sampling in time
    error_in_band_median      the median over the sample
    error_in_working_area     the largest over the sample's points in the working areas, where tools are meant to touch
    error_map                 (n_points,) float32: the error of the nearest point of the sample; or, if it is more, by how much
                              the force is too large where the tool acts as a blunter one (`contact_size`); 0 at held points
    passivity_margin          smallest eigenvalue, over the points and up to half the sampling rate, of the part of w C(jw) that
                              dissipates, over |w C(0)|; 0 or above to round-off, else no model is made
    passivity_margin_sampled  the same for the displacement in a tick under a force held over it, sampled for period_s
    largest_stiffness_n_per_m  that a device meets in one tick along the normal, over the points that are not held
    residual_shift_m_per_n    what was added to the diagonal of the residual, so that it is definite in spite of rounding
    resolved_frequency_hz     up to where the cloud carries shear waves with 6 nodes a wavelength, where it is coarsest
    """

    contact_radius_m: float
    error_static: float
    error_static_median: float
    error_in_band: float
    error_in_band_median: float
    error_in_working_area: float
    passivity_margin: float
    passivity_margin_sampled: float
    largest_stiffness_n_per_m: float
    residual_shift_m_per_n: float
    resolved_frequency_hz: float
    error_map: NDArray[np.float32]

    @property
    def is_passive(self) -> bool:
        """Whether no energy comes out: both margins are 0 or above, to round-off."""
        return min(self.passivity_margin, self.passivity_margin_sampled) >= -_ROUND_OFF

    @staticmethod
    def unknown(n_points: int) -> SurfaceAccuracy:
        """The evidence of a model that was not made from a body: not a number."""
        nan = float("nan")
        errors = np.full(n_points, nan, np.float32)
        return SurfaceAccuracy(nan, nan, nan, nan, nan, nan, nan, nan, nan, nan, nan, errors)


SURFACE_SCALARS = ("name", "period_s", "n_nodes", "config", "config_sha256", "built_with")
"""The fields of `SurfaceModel` that the metadata of a file states unchanged."""


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
    stiffness_factor     of all moduli, over those of the file, where it is 1; see `stiffened`
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
    accuracy: SurfaceAccuracy
    stiffness_factor: float = 1.0

    @property
    def order(self) -> int:
        """Number of modes."""
        return self.n_modes

    @property
    def n_points(self) -> int:
        return len(self.points)

    @property
    def n_modes(self) -> int:
        return len(self.squared_frequencies)

    def metadata(self) -> dict[str, Any]:
        """All but the arrays, as a file stores it: plain numbers, lists and strings."""
        accuracy = asdict(self.accuracy)
        del accuracy["error_map"]
        return {
            "format": FORMAT,
            "schema_version": SCHEMA_VERSION,
            "kind": self.kind,
            "units": UNITS,
            **{name: getattr(self, name) for name in SURFACE_SCALARS},
            "band_hz": list(self.band_hz),
            "tools": [asdict(tool) for tool in self.tools],
            "accuracy": accuracy,
        }

    def summary(self) -> dict[str, Any]:
        """What `palpate inspect --json` prints: the metadata without the scene, and the sizes."""
        metadata = self.metadata()
        del metadata["config"]
        return metadata | {
            "order": self.order,
            "highest_mode_hz": float(np.sqrt(self.squared_frequencies[-1]) / (2 * np.pi)),
            "n_points": self.n_points,
            "n_held_points": int(np.count_nonzero(self.held)),
            "n_triangles": len(self.triangles),
        }


def stiffened(model: SurfaceModel, factor: float) -> SurfaceModel:
    """The model of the same body with all moduli times a factor above 0.

    The modes stay, omega² grows and R shrinks by the factor: exact, because all stiffness is proportional to the modulus and
    the mass is not. The band scales with the frequencies. `accuracy` stays as it was measured: at rest it is that of every
    factor; in the band it is nearly so, since the Prony series keeps its times.
    """
    root = factor**0.5
    return replace(
        model,
        squared_frequencies=model.squared_frequencies * factor,
        residual=model.residual / np.float32(factor),
        band_hz=(model.band_hz[0] * root, model.band_hz[1] * root),
        stiffness_factor=model.stiffness_factor * factor,
    )
