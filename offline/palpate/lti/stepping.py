"""Stepping a model in the form that runs, as the server does, sample by sample."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from palpate.model_file import StateSpace

Array = NDArray[np.float64]


def step_through(model: StateSpace, inputs: Array) -> tuple[Array, Array]:
    """(outputs, state): y = C xi + D u, then xi+ = A xi + B u for each sample u of inputs, from xi = 0.

    inputs (n_samples, n_inputs), outputs (n_samples, n_outputs); state (order,) after the last sample
    """
    state = np.zeros(model.order)
    outputs = _step_through(
        model.diagonal,
        model.cross,
        np.ascontiguousarray(model.b),
        np.ascontiguousarray(model.c.T),
        np.ascontiguousarray(model.d),
        np.ascontiguousarray(inputs, dtype=np.float64),
        state,
    )
    return outputs, state


@njit(cache=True)
def _step_through(diagonal, cross, b, c_transposed, d, inputs, x):  # type: ignore[no-untyped-def]
    n_samples, n_inputs = inputs.shape
    n_states, n_outputs = c_transposed.shape
    outputs = np.zeros((n_samples, n_outputs))
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
