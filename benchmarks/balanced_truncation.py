"""Balanced truncation of the paper's cube with all memory states: ours against pyMOR's and SLICOT's, on the same matrices.

    python benchmarks/balanced_truncation.py [--order 120] [--timeout 900] [--threads 1] [--counts 5,5,5 6,6,7 10,10,10] [--contenders palpate SLICOT]

Everyone gets the mass-normalized stiffness of a `conservative` cube with its contact patch and the Prony series, or the
first-order matrices made of them (x = u, v and the memories; E = I), and returns a model of the same order. A run has a
process of its own; wall and processor seconds are of the reduction alone (for ours the eigendecomposition of the stiffness
included, for the others the assembly of A excluded), memory is the peak of the process, error the largest |F - F_reduced|
over the largest |F|. The stiffness of a meshfree cube this small is nearly full, so the low-rank iteration gets A dense, too.
Who has not finished in time is extrapolated with the third power of the states, and marked so.

    palpate         modes, closed-form poles, Cholesky of the Cauchy-form Gramian (`palpate.reduction.reduce`)
    SLICOT          AB09AD through ctrlsys
    pyMOR dense     BTReductor with scipy's Lyapunov solver
    pyMOR low-rank  BTReductor with low-rank ADI and its own shifts
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

CONTENDERS = ("palpate", "SLICOT", "pyMOR dense", "pyMOR low-rank")


def cube(counts: tuple[int, int, int]) -> dict[str, Array]:
    """Mass-normalized stiffness blocks of the paper's cube (section 4.2), its contact the nodes at the top center."""
    from palpate.discretization import conservative
    from palpate.discretization.supports import components
    from palpate.geometry.shapes import box_lattice
    from palpate.modes.dense import elastic_modes
    from palpate.scene.tissues import PRESETS

    material = PRESETS["paper-cube"]
    cloud = box_lattice((0, 0, 0), (1, 1, 1), counts)
    bottom = np.flatnonzero(cloud.points[:, 2] < 1e-9)
    distance = np.linalg.norm(cloud.points - (0.5, 0.5, 1.0), axis=1)
    tip = np.flatnonzero(distance < distance.min() + 1e-9)
    body = conservative.assemble(cloud, material, bottom, [tip])
    modes = elastic_modes(body)
    free = components(body.supports.free, 3)
    root_mass = np.repeat((material.density_kg_per_m3 * cloud.volumes) ** 0.5, 3)[free]
    vectors = root_mass[:, None] * body.basis.values(modes.parameters)[free]  # orthonormal
    return {
        "stiffness": (vectors * modes.squared_frequencies) @ vectors.T,
        "coupling": vectors @ modes.input_coupling,
        "direct": modes.direct_stiffness,
        "gamma": np.array(material.prony.gamma),
        "tau_s": np.array(material.prony.tau_s),
    }


def first_order(body: dict[str, Array]) -> tuple[Array, Array, Array, Array]:
    """A, B, C, D with the states u, v, z_j of the free nodes and z_j - u of the patch (Eq. 9 and 34)."""
    k, p, direct = body["stiffness"], body["coupling"], body["direct"]
    n, m, gamma, tau = len(k), p.shape[1], body["gamma"], body["tau_s"]
    size = 2 * n + len(gamma) * (n + m)
    a, b = np.zeros((size, size)), np.zeros((size, m))
    w_free, w_patch = np.zeros((n, size)), np.zeros((m, size))
    w_free[:, :n] = np.eye(n)
    a[:n, n : 2 * n] = np.eye(n)
    for j in range(len(gamma)):
        start = 2 * n + j * (n + m)
        free, patch = slice(start, start + n), slice(start + n, start + n + m)
        w_free[:, free], w_patch[:, patch] = gamma[j] * np.eye(n), gamma[j] * np.eye(m)
        a[free, free], a[free, n : 2 * n] = -np.eye(n) / tau[j], np.eye(n)
        a[patch, patch], b[patch] = -np.eye(m) / tau[j], -np.eye(m) / tau[j]
    instant = 1 + gamma.sum()
    a[n : 2 * n] -= k @ w_free + p @ w_patch
    b[n : 2 * n] -= instant * p
    return a, b, p.T @ w_free + direct @ w_patch, instant * direct


def full_system(body: dict[str, Array]) -> Any:
    """The exact system of the same matrices, in pole-residue form."""
    from palpate.lti.viscoelastic import viscoelastic_system
    from palpate.modes.elastic_modes import ElasticModes
    from palpate.scene.material import PronySeries

    mu, vectors = np.linalg.eigh(body["stiffness"])
    b = vectors.T @ body["coupling"]
    nowhere = np.zeros((0, len(mu))), np.zeros((0, b.shape[1]))
    modes = ElasticModes(mu, b, b.T, body["direct"], *nowhere)
    return viscoelastic_system(modes, PronySeries(tuple(body["gamma"]), tuple(body["tau_s"])))


def reduced_by(contender: str, body: dict[str, Array], order: int) -> tuple[Any, float, float]:
    """The reduced system, wall and processor seconds."""
    from palpate.lti.block_form import diagonalize

    if contender == "palpate":
        from palpate.reduction import reduce

        small = {
            k: v[:30, :30] if k == "stiffness" else v[:30] if k == "coupling" else v for k, v in body.items()
        }
        reduce(full_system(small), "tbr", order=4)  # loads the compiled kernels
        start = time.perf_counter(), time.process_time()
        reduced: Any = reduce(full_system(body), "tbr", order=order).system
    else:
        a, b, c, d = first_order(body)
        n, m, p = len(a), b.shape[1], len(c)
        if contender == "SLICOT":
            import ctrlsys

            fortran = [np.asfortranarray(x) for x in (a.copy(), b.copy(), c.copy())]
            start = time.perf_counter(), time.process_time()
            ar, br, cr, *_, info = ctrlsys.ab09ad("C", "B", "N", "F", n, m, p, order, *fortran, 0.0)
            if info != 0:
                raise RuntimeError(f"AB09AD returned info = {info}")
            reduced = diagonalize(ar[:order, :order], br[:order], cr[:, :order], d)
        else:
            from pymor.core.defaults import set_defaults
            from pymor.core.logger import set_log_levels
            from pymor.models.iosys import LTIModel
            from pymor.reductors.bt import BTReductor

            set_log_levels({"pymor": "ERROR"})
            if contender == "pyMOR dense":
                never = 10**9
                set_defaults(
                    {
                        "pymor.solvers.matrix_equations.utils.mat_eqn_sparse_min_size.value": never,
                        "pymor.models.iosys.sparse_min_size.value": never,
                    }
                )
            model = LTIModel.from_matrices(a, b, c, d)
            start = time.perf_counter(), time.process_time()
            rom = BTReductor(model).reduce(order)
            ar, br, cr, dr, er = rom.to_abcde_matrices()
            if er is not None:
                ar, br = np.linalg.solve(er, ar), np.linalg.solve(er, br)
            reduced = diagonalize(ar, br, cr, d if dr is None else dr)
    return reduced, time.perf_counter() - start[0], time.process_time() - start[1]


def work(contender: str, path: Path, order: int) -> dict[str, float]:
    """One contender's figures."""
    from palpate.lti.frequencies import all_frequencies, spectral_norms

    with np.load(path) as archive:
        body = dict(archive)
    reduced, wall, processor = reduced_by(contender, body, order)
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    full = full_system(body)
    omega = all_frequencies((full,))[:: max(1, full.n_states // 3000)]
    exact = full.transfer(1j * omega)
    gain = max(float(np.max(spectral_norms(exact))), float(np.linalg.norm(full.d, 2)))
    error = float(np.max(spectral_norms(exact - reduced.transfer(1j * omega)))) / gain
    return {"wall_s": wall, "processor_s": processor, "memory_gib": memory / 2**30, "error": error}


def run(contender: str, path: Path, order: int, timeout_s: float, threads: int) -> dict[str, float] | str:
    """The figures of a run in a process of its own, or why there are none."""
    environment = os.environ | {
        name: str(threads)
        for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
    }
    command = [sys.executable, __file__, "--worker", contender, "--body", str(path), "--order", str(order)]
    try:
        done = subprocess.run(
            command, env=environment, timeout=timeout_s, capture_output=True, text=True, check=False
        )
    except subprocess.TimeoutExpired:
        return f"not in {timeout_s:g} s"
    if done.returncode != 0:
        lines = done.stderr.strip().splitlines()
        return f"failed: {lines[-1][:100] if lines else done.returncode}"
    result: dict[str, float] = json.loads(done.stdout.splitlines()[-1])
    return result


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--order", type=int, default=120)
    parser.add_argument("--timeout", type=float, default=900.0, help="seconds a run may take")
    parser.add_argument("--threads", type=int, default=1, help="threads of BLAS and of compiled loops")
    parser.add_argument(
        "--counts", nargs="+", default=["5,5,5", "6,6,7", "10,10,10"], help="nodes along x, y, z"
    )
    parser.add_argument(
        "--largest-peer", type=int, default=3000, help="most states that the others are tried with"
    )
    parser.add_argument(
        "--contenders", nargs="+", choices=CONTENDERS, default=CONTENDERS, help="ours always runs"
    )
    parser.add_argument("--worker", choices=CONTENDERS, help=argparse.SUPPRESS)
    parser.add_argument("--body", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.worker:
        print(json.dumps(work(options.worker, options.body, options.order)))
        return
    seconds: dict[str, tuple[int, float]] = {}  # largest run of each that finished
    print(f"order {options.order}, {options.threads} thread(s)\n")
    print(f"{'states':>7} {'':15} {'wall s':>9} {'cpu s':>9} {'GiB':>6} {'error':>9} {'wall / ours':>12}")
    for text in options.counts:
        counts = tuple(int(x) for x in text.split(","))
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "body.npz"
            body = cube((counts[0], counts[1], counts[2]))
            np.savez(path, **body)
            n_states = (
                2 * len(body["stiffness"])
                + len(body["gamma"]) * len(body["stiffness"])
                + 3 * len(body["gamma"])
            )
            del body
            ours = 0.0
            for contender in (c for c in CONTENDERS if c == "palpate" or c in options.contenders):
                too_large = contender != "palpate" and n_states > options.largest_peer
                outcome = (
                    f"more than {options.largest_peer} states"
                    if too_large
                    else run(contender, path, options.order, options.timeout, options.threads)
                )
                head = f"{n_states:>7} {contender:15}"
                if isinstance(outcome, str):
                    note = f" {outcome}"
                    if contender in seconds:
                        states, wall = seconds[contender]
                        guess = wall * (n_states / states) ** 3
                        note += f"; extrapolated from {states} states: {guess:.0f} s, {guess / ours:.0f} x"
                    print(head + note, flush=True)
                    continue
                wall = outcome["wall_s"]
                ours = wall if contender == "palpate" else ours
                seconds[contender] = (n_states, wall)
                print(
                    f"{head} {wall:9.2f} {outcome['processor_s']:9.2f} {outcome['memory_gib']:6.2f} "
                    f"{outcome['error']:9.1e} {wall / ours:11.1f}x",
                    flush=True,
                )


if __name__ == "__main__":
    main()
