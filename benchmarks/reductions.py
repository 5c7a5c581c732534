"""Error against order of the liver's reductions, ours beside pyMOR's and SLICOT's, each in a process of its own.

    python benchmarks/reductions.py [--spacing-mm 12] [--orders 120 240 540] [--contenders NAME ...] [--timeout 60]
    python benchmarks/reductions.py --spacing-mm 6.2 --direct

The body is the liver of `configs/liver.toml` at the given node spacing. Up to 2,000 nodes all its modes are known and errors are those
against them; above, they are against its Ritz modes, and with --direct the force is also compared with solves of
h(s) K + s² M at 5, 15 and 29 Hz: a complex symmetric factorization (MKL PARDISO, else SuperLU) of the matrices in the
parameters, which shares nothing with the modes but K and M.

Every model is judged as it runs, sampled at 1 kHz: largest relative error of the force and of the surface (at some 200 of its vertices) in the
band, largest |F| over the full model's (smoothed) from the band's end to half the sampling rate, energy that a closed motion of
1 mm can take out. Seconds are of the reduction alone, what its orders share and its own, the median of three runs where
they are short; memory is the peak of the process before it is judged.

    passive, tbr, tbr-band, hankel-optimal, modal, modal-static   ours, of all modes given
    Krylov           Ritz modes at 0 Hz, what `passive` starts from, without its fit
    SLICOT AB09AD    balanced truncation; AB09CD Hankel-optimal; through ctrlsys. The same routines that python-control
                     calls. They are dense, so above 1,500 states they get 240 Krylov vectors as a first-order system
    pyMOR SOBHI      second-order rational Krylov, bitangential Hermite interpolation at even frequencies of the band
    pyMOR SOR-IRKA   second-order, H2-optimal shifts, at most 8 iterations
    pyMOR SOBTp      second-order balanced truncation, position Gramians
    pyMOR Loewner    rational interpolation of 400 samples of the force up to half the sampling rate, its stable part

pyMOR's second-order models have no memory. Its reductors get the same K and M (in modal coordinates, where every solve is a
division) at the instant stiffness of the band's end, with the loss there as damping E = beta K. Their basis is then used
with the true memory, which is the line in the first table; the second has the error of its own reduced model against the
damped system, beside that of as many Krylov vectors.
"""

from __future__ import annotations

import argparse
import functools
import json
import os
import platform
import resource
import statistics
import subprocess
import sys
import tempfile
import time
import tomllib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dense_form import dense_a
from palpate.build import build_full_model
from palpate.discretization.assembled_body import AssembledBody
from palpate.factorization import pardiso
from palpate.lti.block_form import diagonalize, to_block_form
from palpate.lti.errors import ReductionError
from palpate.lti.frequencies import band_frequencies, maximum, relative_errors
from palpate.lti.pole_residue import PoleResidueSystem
from palpate.lti.sampling import Sampling
from palpate.lti.viscoelastic import viscoelastic_system
from palpate.modes.elastic_modes import ElasticModes
from palpate.reduction.accuracy import gain_above_band
from palpate.reduction.methods import METHODS, reductions
from palpate.reduction.passive import RitzSubspace, passive
from palpate.reduction.passivity import largest_energy_out
from palpate.reduction.surface import fit_surface_output
from palpate.scene.material import Material, PronySeries
from palpate.scene.schema import Config
from palpate.scene_cloud import shown_surface

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

CONFIGS = Path(__file__).parents[1] / "configs"
PATCH_SPACING_M = 0.0018
DIRECT_HZ = (5.0, 15.0, 29.0)
SAMPLING = Sampling(1e-3, "bilinear", (0.0, 30.0))
BAND_END = 2 * np.pi * SAMPLING.band_hz[1]
PENALTY = 1e4
MOST_DENSE_STATES = 1500
KRYLOV_BLOCKS = 80
JUDGED_VERTICES = 200


# The body


@dataclass(frozen=True, eq=False)
class Body:
    """What the contenders get: modes without shapes, the material's memory, and shapes on the surface to judge with."""

    modes: ElasticModes
    prony: PronySeries
    shapes: Array
    patch_shapes: Array

    @functools.cached_property
    def full(self) -> PoleResidueSystem:
        return viscoelastic_system(self.modes, self.prony)

    @functools.cached_property
    def krylov(self) -> RitzSubspace:
        return RitzSubspace.of(self.modes)

    def with_modes(self, mu: Array, coupling: Array) -> PoleResidueSystem:
        """A projection of the body with the same direct stiffness, and its memory."""
        nowhere = np.zeros((0, len(mu))), np.zeros((0, coupling.shape[1]))
        return viscoelastic_system(
            ElasticModes(mu, coupling, coupling.T, self.modes.direct_stiffness, *nowhere), self.prony
        )


def prepare(spacing_mm: float, path: Path, direct: bool) -> dict[str, Any]:
    """Build the body, store it for the contenders, and return what the heading says about it."""
    scene = tomllib.loads((CONFIGS / "liver.toml").read_text(encoding="utf-8"))
    scene["geometry"]["spacing_m"] = spacing_mm / 1000
    scene["contact"][0]["spacing_m"] = PATCH_SPACING_M
    config = Config.model_validate(scene)
    start = time.process_time()
    full = build_full_model(config, CONFIGS)
    seconds = time.process_time() - start
    vertices, basis = shown_surface(config, full.cloud).vertices, full.body.basis
    judged = vertices[:: max(1, len(vertices) // JUDGED_VERTICES)]
    modes = full.modes
    np.savez(
        path,
        mu=modes.squared_frequencies,
        coupling=modes.input_coupling,
        direct=modes.direct_stiffness,
        gamma=full.material.prony.gamma,
        tau_s=full.material.prony.tau_s,
        shapes=basis.values_at(judged, modes.parameters),
        patch_shapes=basis.values_at(judged, modes.patch_parameters),
    )
    facts: dict[str, Any] = {"nodes": full.cloud.n_nodes, "modes": modes.n_modes, "cpu_s": seconds}
    if direct:
        solves = [direct_force(full.body, full.material, 2 * np.pi * hz) for hz in DIRECT_HZ]
        facts["residuals"] = [solve.residual for solve in solves]
        facts["direct_cpu_s"] = [solve.cpu_s for solve in solves]
        with np.load(path) as stored:
            np.savez(path, **stored, reference=np.array([solve.force for solve in solves]))
    return facts


def load(path: Path) -> tuple[Body, Complex | None]:
    """The body, and the forces of the direct solves where there are any."""
    with np.load(path) as stored:
        coupling = stored["coupling"]
        nowhere = np.zeros((0, len(coupling))), np.zeros((0, coupling.shape[1]))
        modes = ElasticModes(stored["mu"], coupling, coupling.T, stored["direct"], *nowhere)
        prony = PronySeries(tuple(stored["gamma"]), tuple(stored["tau_s"]))
        reference = stored.get("reference")
        return Body(modes, prony, stored["shapes"], stored["patch_shapes"]), reference


# Direct solves


@dataclass(frozen=True)
class DirectSolve:
    """force (n_inputs, n_inputs), N/m; residual of the free nodes' balance over the patch's force."""

    force: Complex
    residual: float
    cpu_s: float


def direct_force(body: AssembledBody, material: Material, omega: float) -> DirectSolve:
    """The reaction to unit displacements of the patch at s = j omega, of a body assembled in unit constants.

    (h K + s² Hᵀ m H) U = Cᵀ f with C U = g, C being the rows of H of the held nodes: by an augmented Lagrangian, whose
    matrix is factorized once. Held nodes have no mass, as in the model.
    """
    from scipy.sparse import csr_array, diags_array, eye_array, kron

    start = time.process_time()
    c, value = body.n_components, body.basis.value
    s = 1j * omega
    h = complex(material.prony.transfer_factor(np.array([s]))[0])
    held = body.supports.prescribed
    mass = material.density_kg_per_m3 * body.mass
    mass[held] = 0.0
    inertia = kron(value.T @ (diags_array(mass) @ value), eye_array(c), format="csr")
    dynamic = csr_array(h * material.youngs_modulus_pa * body.stiffness + s**2 * inertia)
    rows = csr_array(kron(value[held], eye_array(c), format="csr"))
    patch_values = np.kron(body.supports.tips.toarray(), np.eye(c))
    wanted = patch_values.reshape(body.n_nodes, c, -1)[held].reshape(c * len(held), -1).astype(complex)
    weight = PENALTY * abs(dynamic.diagonal()).max()
    solve = complex_symmetric_solver(csr_array(dynamic + weight * (rows.T @ rows)))
    multipliers = np.zeros_like(wanted)
    for _ in range(6):
        solution = solve(rows.T @ (weight * wanted + multipliers))
        missing = wanted - rows @ solution
        multipliers += weight * missing
        if abs(missing).max() < 1e-13:
            break
    balance = dynamic @ solution
    patch: Array = np.kron(body.basis.parameters(body.supports.tips.toarray()), np.eye(c)).astype(float)
    force = patch.T @ balance
    residual = float(np.linalg.norm(balance - rows.T @ multipliers) / np.linalg.norm(rows.T @ multipliers))
    return DirectSolve(force, residual, time.process_time() - start)


def complex_symmetric_solver(matrix: Any) -> Callable[[Complex], Complex]:
    """Solves with a complex symmetric (not Hermitian) matrix: MKL PARDISO where it is installed, else SuperLU."""
    if pardiso.library() is None:
        from scipy.sparse.linalg import splu

        factor = splu(
            matrix.tocsc(),
            permc_spec="MMD_AT_PLUS_A",
            diag_pivot_thresh=1e-3,
            options={"SymmetricMode": True},
        )
        return lambda right: np.asarray(factor.solve(right))
    import ctypes

    upper = pardiso.upper_triangle(matrix, 1)
    parameters = np.zeros(64, np.int32)
    parameters[[0, 1, 9, 20, 34]] = 1, 2, 8, 1, 1  # as in palpate.factorization.pardiso
    handle = (ctypes.c_void_p * 64)()
    kind, n = 6, matrix.shape[0]  # 6: complex symmetric
    pardiso._call(handle, kind, 12, n, upper, parameters, None, None)

    def solve(right: Complex) -> Complex:
        right = np.array(right, dtype=np.complex128, order="F")
        solution = np.empty_like(right, order="F")
        pardiso._call(handle, kind, 33, n, upper, parameters, right, solution)
        return solution

    return solve


# Contenders

System = Callable[[], PoleResidueSystem]


@dataclass(frozen=True)
class Peer:
    """A reduced model of a peer's damped second-order system: its basis with the true memory, and its own error."""

    system: PoleResidueSystem
    own_error: float
    krylov_error: float


def contenders() -> dict[str, Callable[[Body, int], PoleResidueSystem | Peer]]:
    """By name: the model of at most `order` states. What the orders share is computed at the first."""
    ours = {name: functools.partial(_of_family, name) for name in METHODS}
    return {
        "passive": _passive,
        **ours,
        "Krylov": _krylov,
        "SLICOT AB09AD": _slicot_balanced,
        "SLICOT AB09CD": _slicot_hankel,
        "pyMOR SOBHI": functools.partial(_second_order, "SOBHI"),
        "pyMOR SOR-IRKA": functools.partial(_second_order, "SOR-IRKA"),
        "pyMOR SOBTp": functools.partial(_second_order, "SOBTp"),
        "pyMOR Loewner": _loewner,
    }


def _passive(body: Body, order: int) -> PoleResidueSystem:
    return passive(body.full, body.krylov, body.prony, SAMPLING, order=order).system


@functools.cache
def _family(body: Body, method: str) -> Any:
    return reductions(body.full, method, SAMPLING.band_hz)  # type: ignore[arg-type]


def _of_family(method: str, body: Body, order: int) -> PoleResidueSystem:
    family = _family(body, method)
    possible = family.orders[family.orders <= order]
    if not len(possible):
        raise ReductionError(f"needs at least {family.orders[0]} states")
    return family.at(int(possible[-1]))


def n_coordinates(body: Body, order: int) -> int:
    """Second-order coordinates, a multiple of the inputs, whose system with memory has at most `order` states."""
    branches, inputs = len(body.prony.gamma), body.modes.input_coupling.shape[1]
    return (order - branches * inputs) // (2 + branches) // inputs * inputs


def _krylov(body: Body, order: int) -> PoleResidueSystem:
    n = n_coordinates(body, order) // body.modes.input_coupling.shape[1]
    return viscoelastic_system(body.krylov.ritz_modes(n), body.prony)


def _first_order(body: Body) -> tuple[Array, Array, Array, Array]:
    """Fortran-ordered A, B, C, D of the full system, or of 240 Krylov vectors where it is too large to be dense."""
    system = body.full
    if system.n_states > MOST_DENSE_STATES:
        system = viscoelastic_system(body.krylov.ritz_modes(KRYLOV_BLOCKS), body.prony)
    block = to_block_form(system)
    a, b, c, d = (np.array(x, order="F") for x in (dense_a(block), block.b, block.c, block.d))
    return a, b, c, d


def _slicot_balanced(body: Body, order: int) -> PoleResidueSystem:
    import ctrlsys

    a, b, c, d = _first_order(body)
    n, m, p = len(a), b.shape[1], len(c)
    ar, br, cr, _, nr, _, info = ctrlsys.ab09ad("C", "B", "N", "F", n, m, p, order, a, b, c, 0.0)
    if info != 0:
        raise ReductionError(f"AB09AD returned info = {info}")
    return diagonalize(ar[:nr, :nr], br[:nr], cr[:, :nr], d)


def _slicot_hankel(body: Body, order: int) -> PoleResidueSystem:
    import ctrlsys

    a, b, c, d = _first_order(body)
    n, m, p = len(a), b.shape[1], len(c)
    ar, br, cr, dr, nr, *_, info = ctrlsys.ab09cd("C", "N", "F", n, m, p, order, a, b, c, d, 0.0, 0.0)
    if info != 0:
        raise ReductionError(f"AB09CD returned info = {info}")
    return diagonalize(ar[:nr, :nr], br[:nr], cr[:, :nr], dr)


@dataclass(frozen=True)
class Damped:
    """s² q + (1 + beta s) mu q = b u, y = bᵀ q."""

    mu: Array
    b: Array
    beta: float

    @classmethod
    def of(cls, body: Body) -> Damped:
        """With the stiffness and the loss that the material has at the band's end."""
        h = complex(body.prony.transfer_factor(np.array([1j * BAND_END]))[0])
        mu, b = body.modes.squared_frequencies, body.modes.input_coupling
        return cls(h.real * mu, h.real * b, h.imag / h.real / BAND_END)

    def response(self, s: Complex) -> Complex:
        inverse = 1 / (s[:, None] ** 2 + (1 + self.beta * s[:, None]) * self.mu)
        return np.asarray(np.einsum("kp,nk,km->npm", self.b, inverse, self.b))


def _second_order(name: str, body: Body, order: int) -> Peer:
    import scipy.sparse as sparse
    from pymor.core.logger import set_log_levels
    from pymor.models.iosys import SecondOrderModel
    from pymor.reductors.interpolation import SOBHIReductor
    from pymor.reductors.sobt import SOBTpReductor
    from pymor.reductors.sor_irka import SORIRKAReductor

    set_log_levels({"pymor": "ERROR"})
    damped = Damped.of(body)
    k = sparse.diags(damped.mu).tocsc()
    n, m = damped.b.shape
    model = SecondOrderModel.from_matrices(
        sparse.eye(n, format="csc"), damped.beta * k, k, damped.b, damped.b.T
    )
    count = n_coordinates(body, order)
    if name == "SOBHI":
        reductor: Any = SOBHIReductor(model)
        n_places = count // (2 * m)
        places = BAND_END * (np.arange(n_places) + 0.5) / n_places
        sigma = np.repeat(np.concatenate([1j * places, -1j * places]), m)
        directions = np.tile(np.eye(m), (2 * n_places, 1))
        small = reductor.reduce(sigma, directions, directions)
    elif name == "SOR-IRKA":
        reductor = SORIRKAReductor(model)
        small = reductor.reduce(count, maxit=8, tol=1e-2, irka_options={"maxit": 10, "tol": 1e-2})
    else:
        reductor = SOBTpReductor(model)
        small = reductor.reduce(count)
    vectors = reductor.V.to_numpy()
    basis, _ = np.linalg.qr(vectors if len(vectors) == n else vectors.T)
    mu, rotation = np.linalg.eigh(basis.T @ (body.modes.squared_frequencies[:, None] * basis))
    system = body.with_modes(mu, rotation.T @ (basis.T @ body.modes.input_coupling))
    points = 1j * np.linspace(1e-3, BAND_END, 300)
    exact = damped.response(points)
    own = np.stack([small.transfer_function.eval_tf(s) for s in points])
    ritz = body.krylov.ritz_modes(count // m)
    krylov = Damped.of(Body(ritz, body.prony, body.shapes, body.patch_shapes)).response(points)
    return Peer(
        system,
        float(np.max(relative_errors(exact, own))),
        float(np.max(relative_errors(exact, krylov))),
    )


def _loewner(body: Body, order: int) -> PoleResidueSystem:
    from pymor.core.logger import set_log_levels
    from pymor.reductors.loewner import LoewnerReductor

    set_log_levels({"pymor": "ERROR"})
    top = np.pi / SAMPLING.period_s
    omega = np.concatenate([np.geomspace(1e-2, BAND_END, 200), np.linspace(1.05 * BAND_END, top, 200)])
    samples = body.full.transfer(1j * omega) - body.full.d
    rom = LoewnerReductor(1j * omega, samples).reduce(order)
    a, b, c, _, e = rom.to_abcde_matrices()
    reduced = diagonalize(np.linalg.solve(e, a), np.linalg.solve(e, b), c, body.full.d)
    return reduced.take(reduced.poles.real < 0)


# Judging


def work(name: str, path: Path, orders: Sequence[int]) -> Iterator[dict[str, Any]]:
    """A row for each order."""
    body, reference = load(path)
    made: list[tuple[int, PoleResidueSystem | Peer, float, float]] = []
    run = contenders()[name]
    _ = body.full
    for order in orders:
        try:
            made.append((order, *timed(functools.partial(run, body, order))))
        except (ReductionError, np.linalg.LinAlgError, ValueError) as error:
            yield {"order": order, "refused": str(error)[:110]}
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    for order, result, wall, cpu in made:
        system = result.system if isinstance(result, Peer) else result
        row = judge(body, system, reference) | {"order": order, "wall_s": wall, "cpu_s": cpu, "gib": memory}
        if isinstance(result, Peer):
            row |= {"own": result.own_error, "krylov": result.krylov_error}
        yield row


def timed(make: Callable[[], Any]) -> tuple[Any, float, float]:
    """The result, wall and processor seconds: the median of three more runs where the first is short."""
    runs = []
    while len(runs) < 1 or (runs[0][0] < 3.0 and len(runs) < 4):
        start = time.perf_counter(), time.process_time()
        result = make()
        runs.append((time.perf_counter() - start[0], time.process_time() - start[1]))
    warm = runs[1:] or runs  # the first one loads compiled code
    return result, statistics.median(w for w, _ in warm), statistics.median(c for _, c in warm)


def judge(
    body: Body, system: PoleResidueSystem, reference: Complex | None, surface: bool = True
) -> dict[str, Any]:
    """The errors of a system once sampled."""
    full, running = body.full, SAMPLING.sample(system)
    row: dict[str, Any] = {"states": system.n_states}

    def error(w: Array) -> Array:
        return relative_errors(full.transfer(1j * w), running.transfer(np.exp(1j * w * SAMPLING.period_s)))

    row["force"] = maximum(error, band_frequencies((full, system), SAMPLING.band_hz))[1]
    if surface:
        row["surface"] = fit_surface_output(
            body.modes,
            body.prony,
            body.shapes,
            body.patch_shapes,
            to_block_form(running),
            period_s=SAMPLING.period_s,
            band_hz=SAMPLING.band_hz,
        ).error_in_band
    row["gain"] = gain_above_band(full, running, SAMPLING.period_s, SAMPLING.band_hz[1])
    row["energy_j"] = largest_energy_out(running, 1e-3)
    if reference is not None:
        omega = 2 * np.pi * np.array(DIRECT_HZ)
        row["direct"] = relative_errors(reference, SAMPLING.response(system, omega)).tolist()
        row["direct_unsampled"] = relative_errors(reference, system.transfer(1j * omega)).tolist()
    return row


# The run


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    names = tuple(contenders())
    parser.add_argument("--spacing-mm", type=float, default=12.0)
    parser.add_argument("--orders", type=int, nargs="+", default=[120, 240, 540], help="most states")
    parser.add_argument("--contenders", nargs="+", choices=names, default=names)
    parser.add_argument("--direct", action="store_true", help="compare with direct solves, too")
    parser.add_argument("--timeout", type=float, default=60.0, help="seconds that a contender may take")
    parser.add_argument("--worker", choices=("full", *names), help=argparse.SUPPRESS)
    parser.add_argument("--body", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.worker == "full":
        body, reference = load(options.body)
        print(json.dumps(judge(body, body.full, reference, surface=False)))
        return
    if options.worker:
        for row in work(options.worker, options.body, options.orders):
            print(json.dumps(row), flush=True)
        return
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "body.npz"
        facts = prepare(options.spacing_mm, path, options.direct)
        print(f"{platform.processor() or platform.machine()}, Python {platform.python_version()}")
        print(f"{facts['nodes']:,} nodes at {options.spacing_mm:g} mm, {facts['modes']:,} modes, ", end="")
        print(f"made in {facts['cpu_s']:.0f} processor s")
        if options.direct:
            residuals = ", ".join(f"{r:.0e}" for r in facts["residuals"])
            seconds = ", ".join(f"{s:.0f}" for s in facts["direct_cpu_s"])
            print(f"direct solves at 5, 15, 29 Hz: residuals {residuals}; {seconds} processor s")
        peers = show(options, path)
    if peers:
        print(f"\n{'damped second-order system':27} {'coord.':>6} {'its error':>10} {'Krylov':>10}")
        print("\n".join(peers))


def show(options: argparse.Namespace, path: Path) -> list[str]:
    """Run the contenders and print their lines; the lines of the second table."""
    columns = f"{'':15} {'states':>6} {'force':>9} {'surface':>9} {'gain':>7} {'energy uJ':>9} {'wall s':>8} {'cpu s':>8} {'GiB':>5}"
    print(columns + (f" {'5, 15, 29 Hz':>26}" if options.direct else ""))
    peers = []
    for name in ("full", *options.contenders):
        for row in rows_of(name, path, options.orders, options.timeout):
            print(line(name, row), flush=True)
            if "own" in row:
                coordinates = (row["states"] + 2) // 4
                peers.append(f"{name:27} {coordinates:6} {row['own']:10.1e} {row['krylov']:10.1e}")
    return peers


def rows_of(name: str, path: Path, orders: Sequence[int], timeout_s: float) -> Iterator[dict[str, Any]]:
    """The rows of a process of its own, or one that says why there are none."""
    command = [sys.executable, __file__, "--worker", name, "--body", str(path), "--orders", *map(str, orders)]
    try:
        done = subprocess.run(command, timeout=timeout_s, capture_output=True, text=True, check=False)
        output, failed = done.stdout, done.returncode != 0
        reason = (done.stderr.strip().splitlines() or [str(done.returncode)])[-1][:110]
    except subprocess.TimeoutExpired as error:
        output, failed = (error.stdout or b"").decode(), True
        reason = f"not in {timeout_s:g} s"
    yield from (json.loads(text) for text in output.splitlines() if text.startswith("{"))
    if failed:
        yield {"order": 0, "refused": reason}


def line(name: str, row: dict[str, Any]) -> str:
    """One line of the table."""
    if "refused" in row:
        return f"{name:15} {row['order'] or '':>6} {row['refused']}"
    text = (
        f"{name:15} {row['states']:6} {100 * row['force']:8.3g}% {100 * row.get('surface', 0):8.3g}% {row['gain']:7.2f} "
        f"{1e6 * row['energy_j']:9.1e}"
    )
    if "wall_s" in row:
        text += f" {row['wall_s']:8.2f} {row['cpu_s']:8.2f} {row['gib']:5.2f}"
    else:
        text += " " * 24
    if "direct" in row:
        text += " " + " ".join(f"{100 * e:.2g}%" for e in row["direct"])
        if "wall_s" not in row:
            text += "; unsampled " + " ".join(f"{e:.0e}" for e in row["direct_unsampled"])
    return text


if __name__ == "__main__":
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    main()
