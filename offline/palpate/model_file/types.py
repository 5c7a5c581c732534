"""The data classes of a model. `docs/model-file.md` describes how a file stores them."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from palpate.lti.pole_residue import PoleResidueSystem

FORMAT = "palpate.reduced-model"
SCHEMA_VERSION = 3

SHORTEST_PERIOD_S, LONGEST_PERIOD_S = 1e-4, 1e-1

UNITS = {
    "length": "m",
    "displacement": "m",
    "force": "N",
    "stiffness": "N/m",
    "time": "s",
    "frequency": "Hz",
    "energy": "J",
    "pole": "1/s",
}

SCALARS = (
    "name", "method", "period_s", "n_nodes", "n_states_full", "config", "config_sha256", "built_with",
)  # fmt: skip
"""The fields of `ReducedModel` that the metadata of a file states unchanged."""

Array = NDArray[np.float64]


class ModelFileError(ValueError):
    """A file is not a model that this version can run; the message says why in one line."""


@dataclass(frozen=True)
class Contact:
    """A patch of the surface that moves as one rigid tip: 3 inputs (x, y, z displacement), 3 outputs (force).

    center_m and normal are in the model frame; the normal is the unit outward one. The force is what the tissue
    is held with: it points along the displacement in statics, so a device renders its negative.
    """

    name: str
    center_m: tuple[float, float, float]
    normal: tuple[float, float, float]
    radius_m: float
    n_nodes: int


@dataclass(frozen=True)
class StateSpace:
    """A real system in block-diagonal form: state i is coupled to itself and to its partner i XOR 1 alone.

    A[i, i] = diagonal[i] and A[i, i ^ 1] = cross[i]; a complex pair a +- jb is [[a, b], [-b, a]], two real poles
    share a block with cross = 0, and an odd number of real poles is padded with a state that nothing drives.

    diagonal, cross  (order,), order even
    b (order, n_inputs), c (n_outputs, order), d (n_outputs, n_inputs)
    """

    diagonal: Array
    cross: Array
    b: Array
    c: Array
    d: Array

    @property
    def order(self) -> int:
        return len(self.diagonal)

    @property
    def n_padding(self) -> int:
        """1 where a real pole has a partner that nothing drives and nothing sees, else 0."""
        idle = (self.cross == 0) & np.all(self.b == 0, axis=1) & np.all(self.c == 0, axis=0)
        return int(np.any(idle[1::2]))


@dataclass(frozen=True)
class Surface:
    """The body's surface and its displacement as a function of the reduced model's state.

    vertices     (n_vertices, 3), m, at rest
    triangles    (n_triangles, 3), vertex indices, counter-clockwise from outside
    output       (3 n_vertices, order), float32: displacement in m from the *discrete* state,
                 ordered x, y, z of vertex 0, then of vertex 1, ...
    feedthrough  (3 n_vertices, n_inputs), float32: the part that depends on the newest input directly
    """

    vertices: Array
    triangles: NDArray[np.int32]
    output: NDArray[np.float32]
    feedthrough: NDArray[np.float32]


@dataclass(frozen=True)
class AccuracyReport:
    """How good the reduced model is, measured against the full one. Relative errors are fractions.

    error_in_band          largest over the band of |F_full - F| / |F_full| (2-norms, at each frequency), F being the
                           discrete model that runs: reduction and sampling together
    error_in_band_continuous  the same of the reduced model before it is sampled: the reduction alone
    error_static           the same at 0 Hz
    error_hinf             largest over all frequencies of |F_full - F_reduced|, over the largest |F_full|
    error_bound            a-priori bound in the norm of error_hinf, or None where the method has none
    error_step             after a jump of the tip, the largest force error from 0.2 s on over the static force; the exact
                           response counts the poles beyond half the sampling rate, which no sample follows, at rest
    error_time_domain      on a poke: largest force error over the largest force, discrete model against exact response
    error_surface_in_band  surface displacement in the band: largest over the frequencies of |error| over |displacement|
    gain_above_band        largest |F| / |F_full| from the band's end to half the sampling rate, F being the discrete model
                           and F_full smoothed over a tenth of the frequency (`palpate.lti.frequencies.smoothed_response`)
    change_over_last_vectors  largest relative change of the full model's force in the band by the last of the vectors that it
                           was projected on; 0 where it has all modes
    spectral_abscissa      largest real part of the reduced poles, 1/s
    spectral_abscissa_full the same of the full model, 1/s
    passivity_margin       smallest eigenvalue, over all frequencies, of the part of the discrete force response that
                           dissipates, (F - F^H) / 2j, over |F(0)|; negative: the model can give out energy
    passive_up_to_hz       no sinusoidal poke slower than this gets energy out of the discrete model (more than a margin of
                           -0.001 would); half the sampling rate where it is passive throughout
    largest_energy_out_j   the most energy it can give out in one closed sinusoidal poke of 1 mm amplitude, J
    resolved_frequency_hz  up to where the cloud carries shear waves with 6 nodes a wavelength
    band_hz                the haptic band
    hankel_singular_values (k,), of the reduction's own Gramians, largest first; empty for modal methods
    """

    error_in_band: float
    error_in_band_continuous: float
    error_static: float
    error_hinf: float
    error_bound: float | None
    error_step: float
    error_time_domain: float
    error_surface_in_band: float
    gain_above_band: float
    change_over_last_vectors: float
    spectral_abscissa: float
    spectral_abscissa_full: float
    passivity_margin: float
    passive_up_to_hz: float
    largest_energy_out_j: float
    resolved_frequency_hz: float
    band_hz: tuple[float, float]
    hankel_singular_values: Array


@dataclass(frozen=True)
class ReducedModel:
    """A reduced model with its surface and its accuracy report.

    continuous  the reduced model dx/dt = A x + B u, F = C x + D u (u displacement in m, F force in N)
    discrete    the same sampled at period_s, in the form that runs:
                F = C xi + D u, then xi+ = A xi + B u with the newest sample u
    full        the model that was reduced; nothing at run time needs it, and a file does not hold its poles' groups
    static_stiffness (n_outputs, n_inputs), N/m, of the full model; instant stiffness is continuous.d
    config      the configuration it was built from, defaults filled in, as JSON; config_sha256 is the hash of that
                and of the surface file
    """

    kind: ClassVar[str] = "patch"
    stiffness_factor: ClassVar[float] = 1.0  # only a surface model can be made stiffer

    name: str
    method: str
    period_s: float
    n_nodes: int
    n_states_full: int
    contacts: tuple[Contact, ...]
    continuous: StateSpace
    discrete: StateSpace
    full: PoleResidueSystem
    static_stiffness: Array
    surface: Surface
    accuracy: AccuracyReport
    config: str
    config_sha256: str
    built_with: str

    @property
    def order(self) -> int:
        return self.discrete.order

    @property
    def n_inputs(self) -> int:
        return 3 * len(self.contacts)

    def metadata(self) -> dict[str, Any]:
        """All but the arrays, as a file stores it: plain numbers, lists and strings."""
        accuracy = asdict(self.accuracy)
        del accuracy["hankel_singular_values"]
        return {
            "format": FORMAT,
            "schema_version": SCHEMA_VERSION,
            "kind": self.kind,
            "units": UNITS,
            **{name: getattr(self, name) for name in SCALARS},
            "contacts": [asdict(contact) for contact in self.contacts],
            "accuracy": accuracy,
        }

    def summary(self) -> dict[str, Any]:
        """What `palpate inspect --json` prints: the metadata without the scene, the stiffness and the sizes."""
        metadata = self.metadata()
        del metadata["config"]
        metadata["accuracy"]["hankel_singular_values"] = self.accuracy.hankel_singular_values.tolist()
        return metadata | {
            "order": self.order,
            "static_stiffness_n_per_m": self.static_stiffness.tolist(),
            "instant_stiffness_n_per_m": self.continuous.d.tolist(),
            "n_surface_vertices": len(self.surface.vertices),
            "n_surface_triangles": len(self.surface.triangles),
        }
