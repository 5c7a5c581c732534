"""One step of the discrete model in block-diagonal form: F = C xi + D u, then xi+ = A xi + B u, allocating nothing.

The form is that of `palpate.model_file.StateSpace`: state i is coupled to itself and to its partner i XOR 1 alone, so a
step costs O(order (n_inputs + n_outputs)). What it takes is the time to read B and C: both steps go through their
matrix once, from its beginning to its end, which caches fetch ahead best.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from palpate_server.realtime.compiled import compiled
from palpate_server.realtime.dot import dot

Floats = NDArray[np.float64]

_CACHE_LINE = 64  # bytes


def aligned(values: Floats) -> Floats:
    """A copy of `values`, in C order, that begins on a cache line: then few vector loads straddle two lines.

    numpy promises 16 bytes; with long rows the difference is a quarter of the time of a step.
    """
    buffer = np.empty(values.size + _CACHE_LINE // 8)
    first = -buffer.ctypes.data % _CACHE_LINE // 8
    copy = buffer[first : first + values.size].reshape(values.shape)
    copy[...] = values
    return copy


@compiled
def output(c: Floats, d: Floats, state: Floats, displacement: Floats, force: Floats) -> None:
    """Write F = C xi + D u into `force`.

    c (n_outputs, order), d (n_outputs, n_inputs), state (order,), displacement (n_inputs,) m, force (n_outputs,) N
    """
    for row in range(c.shape[0]):
        force[row] = dot(c[row], state) + dot(d[row], displacement)


@compiled
def update(
    diagonal: Floats, cross: Floats, b_transposed: Floats, state: Floats, displacement: Floats
) -> None:
    """Advance `state` in place: xi+ = A xi + B u.

    diagonal, cross, state (order,), order even; b_transposed (n_inputs, order); displacement (n_inputs,) m
    """
    for pair in range(state.shape[0] // 2):
        i = 2 * pair  # with range(0, order, 2) the compiler would test every index for its sign
        first, second = state[i], state[i + 1]
        state[i] = diagonal[i] * first + cross[i] * second
        state[i + 1] = cross[i + 1] * first + diagonal[i + 1] * second
    for j in range(b_transposed.shape[0]):
        u = displacement[j]
        for i in range(state.shape[0]):
            state[i] += b_transposed[j, i] * u
