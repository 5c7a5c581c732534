"""The model file: one `.npz` that the offline stage writes and the server reads, and nothing else between them."""

from __future__ import annotations

import io
import json
import tempfile
import zipfile
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.files import write_whole

FORMAT = "palpate.reduced-model"
SCHEMA_VERSION = 1

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

Array = NDArray[np.float64]


class ModelFileError(ValueError):
    """A file is not a model that this version can run; the message says why."""


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

    def dense_a(self) -> Array:
        """(order, order), the state matrix A."""
        a = np.diag(self.diagonal)
        i = np.arange(self.order)
        a[i, i ^ 1] = self.cross
        return a


@dataclass(frozen=True)
class PoleResidueSystem:
    """The full model, kept beside the reduced one so that anyone can check what the server answers:

        F(s) = D + sum_i c_i b_i^T / (s - p_i), each pole above the real axis standing for its conjugate too.

    poles (n_poles,), imaginary part >= 0, 1/s
    b (n_poles, n_inputs), c (n_outputs, n_poles), complex; d (n_outputs, n_inputs), N/m
    """

    poles: NDArray[np.complex128]
    b: NDArray[np.complex128]
    c: NDArray[np.complex128]
    d: Array


@dataclass(frozen=True)
class Surface:
    """The body's surface and how it moves with the reduced model's state.

    vertices     (n_vertices, 3), m, at rest
    triangles    (n_triangles, 3), vertex indices, counter-clockwise from outside
    output       (3 n_vertices, order), float32: displacement in m from the *discrete* state,
                 ordered x, y, z of vertex 0, then of vertex 1, ...
    feedthrough  (3 n_vertices, n_inputs), float32: the part that follows the newest input at once
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
    error_time_domain      on a poke: largest force error over the largest force, discrete model against exact response
    error_surface_in_band  surface displacement in the band: largest over the frequencies of |error| over |displacement|
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
    error_time_domain: float
    error_surface_in_band: float
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
    """All that the server needs to run a body, and all that a person needs to trust it.

    continuous  the reduced model dx/dt = A x + B u, F = C x + D u (u displacement in m, F force in N)
    discrete    the same sampled at period_s, in the form that runs:
                F = C xi + D u, then xi+ = A xi + B u with the newest sample u
    full        the model that was reduced; nothing at run time needs it
    static_stiffness (n_outputs, n_inputs), N/m, of the full model; instant stiffness is continuous.d
    config      the configuration it was built from, defaults filled in, as JSON; config_sha256 is the hash of that
                and of the surface file
    """

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

    def summary(self) -> dict[str, Any]:
        """What `palpate inspect --json` prints: plain numbers, lists and strings."""
        accuracy = asdict(self.accuracy)
        accuracy["hankel_singular_values"] = self.accuracy.hankel_singular_values.tolist()
        return {
            "format": FORMAT,
            "schema_version": SCHEMA_VERSION,
            "name": self.name,
            "method": self.method,
            "order": self.order,
            "n_nodes": self.n_nodes,
            "n_states_full": self.n_states_full,
            "period_s": self.period_s,
            "contacts": [asdict(c) for c in self.contacts],
            "static_stiffness_n_per_m": self.static_stiffness.tolist(),
            "instant_stiffness_n_per_m": self.continuous.d.tolist(),
            "n_surface_vertices": len(self.surface.vertices),
            "n_surface_triangles": len(self.surface.triangles),
            "units": UNITS,
            "config_sha256": self.config_sha256,
            "built_with": self.built_with,
            "accuracy": accuracy,
        }


def check_writable(path: Path) -> None:
    """Raise OSError where a model could not be saved at `path`: better before a long build than after it."""
    if path.is_dir():
        raise IsADirectoryError(f"{path} is a folder: expected the name of a model file")
    folder = path.parent
    while not folder.exists():
        folder = folder.parent
    try:
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise OSError(f"{path}: nothing can be written to {folder} ({error.strerror})") from error


def save_model(model: ReducedModel, path: Path) -> None:
    """Write the model; readers see the old file or the whole new one."""
    scalars = {
        "format": FORMAT,
        "schema_version": SCHEMA_VERSION,
        "units": UNITS,
        "name": model.name,
        "method": model.method,
        "period_s": model.period_s,
        "n_nodes": model.n_nodes,
        "n_states_full": model.n_states_full,
        "contacts": [asdict(c) for c in model.contacts],
        "accuracy": {k: v for k, v in asdict(model.accuracy).items() if k != "hankel_singular_values"},
        "config": model.config,
        "config_sha256": model.config_sha256,
        "built_with": model.built_with,
    }
    arrays: dict[str, NDArray[Any]] = {
        "metadata": np.frombuffer(json.dumps(scalars, allow_nan=False).encode(), dtype=np.uint8),
        "static_stiffness": model.static_stiffness,
        "hankel_singular_values": model.accuracy.hankel_singular_values,
    }
    for group in ("continuous", "discrete", "full", "surface"):
        part = getattr(model, group)
        arrays |= {f"{group}_{f.name}": getattr(part, f.name) for f in fields(part)}
    buffer = io.BytesIO()
    np.savez_compressed(buffer, allow_pickle=False, **arrays)
    write_whole(path, buffer.getvalue())


def load_model(path: Path) -> ReducedModel:
    """Read and check a model file.

    Raises FileNotFoundError when there is none, ModelFileError (naming the field) when it is damaged, truncated,
    foreign, of a newer schema, or inconsistent in itself. Nothing in the file is ever unpickled.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such model file")
    if not zipfile.is_zipfile(path):
        raise ModelFileError(f"{path}: damaged or not an .npz archive")
    try:
        with np.load(path, allow_pickle=False) as archive:
            arrays = {key: archive[key] for key in archive.files}
    except Exception as error:  # zipfile, zlib and numpy raise a dozen kinds on damaged bytes
        raise ModelFileError(f"{path}: damaged or not an .npz archive ({_without_advice(error)})") from error
    try:
        return _assemble(arrays)
    except ModelFileError as error:
        raise ModelFileError(f"{path}: {error}") from error


def _without_advice(error: Exception) -> str:
    """numpy's own words on pickled data end in how to load it unsafely, which nobody is to follow."""
    return "it holds pickled objects" if "pickle" in str(error) else str(error)


def _assemble(arrays: dict[str, NDArray[Any]]) -> ReducedModel:
    if "metadata" not in arrays:
        raise ModelFileError("no field 'metadata': not a palpate model")
    try:
        scalars = json.loads(arrays["metadata"].tobytes(), parse_constant=_refuse_constant)
        if scalars["format"] != FORMAT:
            raise ModelFileError(f"format is {scalars['format']!r}, expected {FORMAT!r}: not a palpate model")
        version = scalars["schema_version"]
        if version != SCHEMA_VERSION:
            newer = isinstance(version, int) and version > SCHEMA_VERSION
            hint = "it was written by a newer palpate" if newer else "build it again"
            raise ModelFileError(
                f"schema_version is {version!r}, this version reads {SCHEMA_VERSION}: {hint}"
            )
        order = _count(arrays, "discrete_diagonal")
        contacts = tuple(_contact(c) for c in scalars["contacts"])
        channels = 3 * len(contacts)
        if not contacts:
            raise ModelFileError("field 'contacts' is empty: expected at least one contact patch")
        if order % 2:
            raise ModelFileError(
                f"field 'discrete_diagonal' has length {order}: expected an even one (2x2 blocks)"
            )
        n_vertices = _count(arrays, "surface_vertices")
        n_triangles = _count(arrays, "surface_triangles")
        n_poles = _count(arrays, "full_poles")
        expected = [f.name for f in fields(AccuracyReport) if f.name != "hankel_singular_values"]
        missing = [name for name in expected if name not in scalars["accuracy"]]
        if missing:
            raise ModelFileError(f"field 'accuracy.{missing[0]}' is missing")
        evidence_fields = {name: _numbers(name, scalars["accuracy"][name]) for name in expected}
        model = ReducedModel(
            name=str(scalars["name"]),
            method=str(scalars["method"]),
            period_s=float(scalars["period_s"]),
            n_nodes=int(scalars["n_nodes"]),
            n_states_full=int(scalars["n_states_full"]),
            contacts=contacts,
            continuous=_state_space(arrays, "continuous", order, channels),
            discrete=_state_space(arrays, "discrete", order, channels),
            full=PoleResidueSystem(
                poles=_take(arrays, "full_poles", (n_poles,), np.complex128),
                b=_take(arrays, "full_b", (n_poles, channels), np.complex128),
                c=_take(arrays, "full_c", (channels, n_poles), np.complex128),
                d=_take(arrays, "full_d", (channels, channels), np.float64),
            ),
            static_stiffness=_take(arrays, "static_stiffness", (channels, channels), np.float64),
            surface=Surface(
                vertices=_take(arrays, "surface_vertices", (n_vertices, 3), np.float64),
                triangles=_take(arrays, "surface_triangles", (n_triangles, 3), np.int32),
                output=_take(arrays, "surface_output", (3 * n_vertices, order), np.float32),
                feedthrough=_take(arrays, "surface_feedthrough", (3 * n_vertices, channels), np.float32),
            ),
            accuracy=AccuracyReport(
                **evidence_fields,
                hankel_singular_values=_take(
                    arrays, "hankel_singular_values", (_count(arrays, "hankel_singular_values"),), np.float64
                ),
            ),
            config=str(scalars["config"]),
            config_sha256=str(scalars["config_sha256"]),
            built_with=str(scalars["built_with"]),
        )
    except ModelFileError:
        raise
    except KeyError as error:
        raise ModelFileError(f"field {error} is missing") from error
    except (TypeError, ValueError, UnicodeDecodeError) as error:
        raise ModelFileError(f"the metadata can't be read ({error})") from error
    _check(model)
    return model


def _refuse_constant(text: str) -> None:
    raise ModelFileError(f"the metadata holds {text}: expected finite numbers")


def _numbers(name: str, value: Any) -> Any:
    """A number of the accuracy, None where there is no bound, or the band's two."""
    if name == "error_bound" and value is None:
        return None
    values = value if name == "band_hz" else [value]
    if not (isinstance(values, list) and all(type(v) in (int, float) for v in values)):
        raise ModelFileError(f"field 'accuracy.{name}' is {value!r}: expected a number")
    if name == "band_hz":
        low, high = values
        return float(low), float(high)
    return float(value)


def _check(model: ReducedModel) -> None:
    if not SHORTEST_PERIOD_S <= model.period_s <= LONGEST_PERIOD_S:
        raise ModelFileError(
            f"field 'period_s' is {model.period_s}: expected from {SHORTEST_PERIOD_S:g} to {LONGEST_PERIOD_S:g}"
        )
    names = [contact.name for contact in model.contacts]
    if len(set(names)) < len(names):
        raise ModelFileError(f"field 'contacts' names {names}: expected each name once")
    for contact in model.contacts:
        length = float(np.linalg.norm(contact.normal))
        if not abs(length - 1) < 1e-6:
            raise ModelFileError(
                f"field 'contacts' has a normal of length {length:g} at {contact.name!r}: expected a unit vector"
            )
    triangles, n_vertices = model.surface.triangles, len(model.surface.vertices)
    if triangles.size and not (triangles.min() >= 0 and triangles.max() < n_vertices):
        raise ModelFileError(f"field 'surface_triangles' names vertices outside 0..{n_vertices - 1}")
    # |pole| of [[a, b], [c, d]] blocks: a 2x2 block's spectral radius, partners i and i ^ 1.
    a = model.discrete
    blocks = np.stack([a.diagonal[0::2], a.cross[0::2], a.cross[1::2], a.diagonal[1::2]], axis=-1).reshape(
        -1, 2, 2
    )
    radius = float(np.max(np.abs(np.linalg.eigvals(blocks)), initial=0.0))
    if radius >= 1:
        raise ModelFileError(
            f"the discrete model is unstable: its spectral radius is {radius:.9f}, expected below 1"
        )


def _contact(fields_: dict[str, Any]) -> Contact:
    x, y, z = fields_["center_m"]
    nx, ny, nz = fields_["normal"]
    return Contact(
        name=str(fields_["name"]),
        center_m=(float(x), float(y), float(z)),
        normal=(float(nx), float(ny), float(nz)),
        radius_m=float(fields_["radius_m"]),
        n_nodes=int(fields_["n_nodes"]),
    )


def _state_space(arrays: dict[str, NDArray[Any]], group: str, order: int, channels: int) -> StateSpace:
    shapes = {
        "diagonal": (order,),
        "cross": (order,),
        "b": (order, channels),
        "c": (channels, order),
        "d": (channels, channels),
    }
    return StateSpace(**{k: _take(arrays, f"{group}_{k}", shape, np.float64) for k, shape in shapes.items()})


def _count(arrays: dict[str, NDArray[Any]], field: str) -> int:
    if field not in arrays:
        raise ModelFileError(f"field '{field}' is missing")
    if arrays[field].ndim == 0:
        raise ModelFileError(f"field '{field}' is a scalar: expected an array")
    return len(arrays[field])


def _take(arrays: dict[str, NDArray[Any]], field: str, shape: tuple[int, ...], dtype: Any) -> NDArray[Any]:
    if field not in arrays:
        raise ModelFileError(f"field '{field}' is missing")
    array = arrays[field]
    if array.dtype != dtype or array.shape != shape:
        raise ModelFileError(
            f"field '{field}' is {array.dtype} {array.shape}: expected {np.dtype(dtype).name} {shape}"
        )
    if not np.all(np.isfinite(array)):
        raise ModelFileError(f"field '{field}' holds numbers that are not finite")
    return np.ascontiguousarray(array)
