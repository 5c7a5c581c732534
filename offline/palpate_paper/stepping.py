"""Stepping a model through time as a server would, and how long that takes."""

from __future__ import annotations

import time
from collections.abc import Callable
from statistics import median

import numpy as np
from numba import njit
from numpy.typing import NDArray

from palpate.lti.block_form import to_block_form
from palpate.lti.pole_residue import DiagonalSystem
from palpate.lti.sampling import sample
from palpate.model_file import StateSpace

Array = NDArray[np.float64]


def sampled(system: DiagonalSystem, period_s: float) -> StateSpace:
    """The system in real block-diagonal form, exact for displacements that are linear between samples."""
    return to_block_form(sample(system, period_s, "first-order-hold"))


def step_through(model: StateSpace, inputs: Array) -> Array:
    """(n_samples, n_outputs): the outputs for inputs (n_samples, n_inputs) from rest, one compiled step a sample."""
    return _step_through(
        model.diagonal,
        model.cross,
        np.ascontiguousarray(model.b),
        np.ascontiguousarray(model.c.T),
        np.ascontiguousarray(model.d),
        np.ascontiguousarray(inputs, dtype=np.float64),
    )


def median_seconds(run: Callable[[], object], repeats: int = 5) -> float:
    """Median processor time of a few runs of one thread, s, after one that is not counted (compilation, caches).

    Processor time, because wall time on a busy machine measures its neighbors.
    """
    run()
    times = []
    for _ in range(repeats):
        start = time.thread_time()
        run()
        times.append(time.thread_time() - start)
    return median(times)


@njit(cache=True)
def _step_through(diagonal, cross, b, c_transposed, d, inputs):  # type: ignore[no-untyped-def]
    n_samples, n_inputs = inputs.shape
    n_states, n_outputs = c_transposed.shape
    outputs = np.zeros((n_samples, n_outputs))
    x = np.zeros(n_states)
    for t in range(n_samples):
        for p in range(n_outputs):
            for m in range(n_inputs):
                outputs[t, p] += d[p, m] * inputs[t, m]
        for k in range(0, n_states, 2):
            even, odd = x[k], x[k + 1]
            for p in range(n_outputs):
                outputs[t, p] += c_transposed[k, p] * even + c_transposed[k + 1, p] * odd
            x[k] = diagonal[k] * even + cross[k] * odd
            x[k + 1] = diagonal[k + 1] * odd + cross[k + 1] * even
            for m in range(n_inputs):
                x[k] += b[k, m] * inputs[t, m]
                x[k + 1] += b[k + 1, m] * inputs[t, m]
    return outputs
