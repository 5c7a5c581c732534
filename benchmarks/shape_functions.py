"""Shape functions with all first and second derivatives: the compiled kernel beside batched numpy and pycompadre.

    python benchmarks/shape_functions.py [--points 10000] [--order 2] [--threads 1] [--rounds 5]

All get the same neighbor lists, so that only the evaluation is compared. batched numpy is the same algebra by einsum and
batched solves: the largest relative difference shows that both compute the same. pycompadre (not in an extra) is Compadre's
generalized moving least squares with another weight function, by LU, its faster solver, of five operators instead of ten:
value, gradient and Laplacian; its largest error on a quadratic field shows that it computes what it should. The kernel and
pycompadre use as many threads as are told, numpy one; rates are by processor time.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from numba import set_num_threads
from numpy.typing import NDArray

from palpate.meshfree.kernel import Evaluated, Pairs, evaluate
from palpate.meshfree.neighbors import covering_nodes

Array = NDArray[np.float64]
SECOND = ((0, 0), (1, 1), (2, 2), (0, 1), (1, 2), (2, 0))


def compiled(
    points: Array, x: Array, radii: Array, indptr: NDArray[np.int32], indices: NDArray[np.int32], order: int
) -> Array:
    """(10, nnz): value, three first and six second derivatives."""
    out = np.empty((10, len(indices)))
    pairs = Pairs(indptr, indices, radii[indices])
    evaluate(points, x, pairs, order, 2, Evaluated(out[0], out[1:4], out[4:], np.empty(len(points))))
    return out


def batched_numpy(
    points: Array, x: Array, radii: Array, indptr: NDArray[np.int32], indices: NDArray[np.int32], order: int
) -> Array:
    """The same from padded arrays, einsum and batched solves, in batches of 1,000 points."""
    out = np.empty((10, len(indices)))
    counts = np.diff(indptr)
    for begin in range(0, len(points), 1000):
        rows = np.arange(begin, min(begin + 1000, len(points)))
        k = np.arange(counts[rows].max())
        mask = k < counts[rows][:, None]
        entry = np.where(mask, indptr[rows][:, None] + k, 0)
        node = indices[entry]
        scale = np.where(mask, radii[node], 0).max(axis=1)[:, None]
        y = (x[node] - points[rows][:, None]) / scale[..., None]
        ratio = scale / radii[node]
        s = np.linalg.norm(y, axis=-1) * ratio
        t = np.where(mask, np.maximum(1 - s, 0), 0)
        slope = -12 * t**2 * ratio**2
        curvature = np.divide(24 * t * ratio**4, s, out=np.zeros_like(s), where=s > 0)
        w = t**3 * (1 + 3 * s)
        w1 = -slope[..., None] * y
        w2 = np.stack([curvature * y[..., a] * y[..., b] + (slope if a == b else 0) for a, b in SECOND], -1)
        p = np.concatenate([np.ones_like(s)[..., None], y], -1)
        if order == 2:
            p = np.concatenate([p, np.stack([y[..., a] * y[..., b] for a, b in SECOND], -1)], -1)
        moment = np.einsum("nk,nki,nkj->nij", w, p, p)
        size = p.shape[-1]
        right = np.zeros((len(rows), size, 1))
        right[:, 0] = 1
        g = p @ np.linalg.solve(moment, right)
        right = np.zeros((len(rows), size, 3))
        right[:, 1:4] = np.eye(3)
        known1 = w1 * g
        g1 = p @ np.linalg.solve(moment, right - np.swapaxes(p, 1, 2) @ known1)
        right = np.zeros((len(rows), size, 6))
        if order == 2:
            right[:, 4:] = np.diag([2, 2, 2, 1, 1, 1])
        cross = [w1[..., a] * g1[..., b] + w1[..., b] * g1[..., a] for a, b in SECOND]
        known2 = w2 * g + np.stack(cross, -1)
        g2 = p @ np.linalg.solve(moment, right - np.swapaxes(p, 1, 2) @ known2)
        h = np.concatenate(
            [
                w[..., None] * g,
                (known1 + w[..., None] * g1) / scale[..., None],
                (known2 + w[..., None] * g2) / scale[..., None] ** 2,
            ],
            -1,
        )
        out[:, entry[mask]] = h[mask].T
    return out


def compadre(
    points: Array, x: Array, radii: Array, indptr: NDArray[np.int32], indices: NDArray[np.int32], order: int
) -> tuple[Callable[[], Array], Any]:
    """What makes pycompadre's operators and returns the errors (n_points,) of x² + y z's gradient; and Kokkos, to be kept."""
    import pycompadre

    kokkos = pycompadre.KokkosParser([f"--kokkos-num-threads={os.environ['OMP_NUM_THREADS']}"])
    counts = np.diff(indptr)
    lists = np.zeros((len(points), counts.max() + 1), np.int32)
    lists[:, 0] = counts
    lists[:, 1:][np.arange(counts.max()) < counts[:, None]] = indices
    operation = pycompadre.TargetOperation

    def run() -> Array:
        gmls = pycompadre.GMLS(order, 3, "LU", "STANDARD")
        gmls.setWeightingType("power")
        gmls.setWeightingParameter(2)
        helper = pycompadre.ParticleHelper(gmls)
        helper.generateKDTree(x)
        helper.setTargetSites(points)
        helper.setNeighbors(lists)
        helper.setWindowSizes(np.full(len(points), radii.max()))
        gradient = operation.GradientOfScalarPointEvaluation
        targets = [operation.ScalarPointEvaluation, gradient, operation.LaplacianOfScalarPointEvaluation]
        gmls.addTargets(targets[: order + 1])
        gmls.generateAlphas(1, False)
        field = x[:, 0] ** 2 + x[:, 1] * x[:, 2] if order == 2 else x @ (1.0, 2.0, 3.0)
        exact = (
            points[:, [0, 2, 1]] * (2, 1, 1) if order == 2 else np.broadcast_to((1.0, 2.0, 3.0), points.shape)
        )
        return np.asarray(np.linalg.norm(helper.applyStencil(field, gradient) - exact, axis=1))

    return run, kokkos


def alternately(contenders: dict[str, Callable[[], Array]], rounds: int) -> dict[str, tuple[float, Array]]:
    """Fewest processor seconds of each over the rounds, and its result, after one run that compiles and warms up.

    Processor seconds and turns, so that other programs on the machine weigh on all alike.
    """
    results = {name: function() for name, function in contenders.items()}
    best = dict.fromkeys(contenders, np.inf)
    for _ in range(rounds):
        for name, function in contenders.items():
            start = time.process_time()
            function()
            best[name] = min(best[name], time.process_time() - start)
    return {name: (best[name], results[name]) for name in contenders}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--points", type=int, default=10_000)
    parser.add_argument("--order", type=int, choices=(1, 2), default=2)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--rounds", type=int, default=5)
    arguments = parser.parse_args()
    os.environ["OMP_NUM_THREADS"] = str(arguments.threads)
    set_num_threads(arguments.threads)

    n = round(arguments.points ** (1 / 3)) + 4
    h = 1 / (n - 1)
    lattice = np.stack(np.meshgrid(*[np.linspace(0, 1, n)] * 3, indexing="ij"), -1).reshape(-1, 3)
    x = lattice + np.random.default_rng(0).uniform(-0.2, 0.2, lattice.shape) * h
    radii = np.full(len(x), 2.02 * h)
    points = x[
        np.all((lattice > 1.5 * h) & (lattice < 1 - 1.5 * h), axis=1)
    ]  # full supports, as in a large body
    start = time.perf_counter()
    indptr, indices = covering_nodes(points, x, radii)
    search = time.perf_counter() - start
    neighbors = points, x, radii, indptr, indices, arguments.order
    contenders: dict[str, Callable[[], Array]] = {
        "compiled kernel": lambda: compiled(*neighbors),
        "batched numpy": lambda: batched_numpy(*neighbors),
    }
    try:
        contenders["pycompadre"], kokkos = compadre(*neighbors)
    except ImportError:
        kokkos = None
        print("pycompadre is not installed: pip install pycompadre")
    found = alternately(contenders, arguments.rounds)
    print(
        f"{len(points)} points, {arguments.threads} thread(s), order {arguments.order}, {len(indices) / len(points):.1f} neighbors, value + 3 + 6 derivatives"
    )
    print(f"{'neighbor search (scipy cKDTree)':32} {len(points) / search:10,.0f} points/s")
    ours, a = found["compiled kernel"]
    for name, (seconds, _) in found.items():
        print(f"{name:32} {len(points) / seconds:10,.0f} points/s, ratio {seconds / ours:.1f}")
    b = found["batched numpy"][1]
    difference = max(np.abs(u - v).max() / np.abs(v).max() for u, v in zip(a, b, strict=True))
    print(f"largest relative difference of batched numpy {difference:.1e}")
    if "pycompadre" in found:
        print(f"largest error of a gradient of pycompadre {found['pycompadre'][1].max():.1e}")
    contenders.clear()
    del kokkos  # after all that lives in it


if __name__ == "__main__":
    main()
