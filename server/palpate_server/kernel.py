"""One step of the discrete model in block-diagonal form: F = C xi + D u, then xi+ = A xi + B u, allocating nothing.

The form is that of `palpate.model.StateSpace`: state i is coupled to itself and to its partner i XOR 1 alone, so a
step costs O(order (n_inputs + n_outputs)). Inputs and outputs come in threes: x, y, z of each contact.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from palpate_server.compiled import compiled

Floats = NDArray[np.float64]


@compiled
def output(c: Floats, d: Floats, state: Floats, displacement: Floats, force: Floats) -> None:
    """Write F = C xi + D u into `force`.

    c (n_outputs, order), d (n_outputs, n_inputs), state (order,), displacement (n_inputs,) m, force (n_outputs,) N
    """
    for row in range(0, c.shape[0], 3):  # the three of a contact share what is loaded of the state
        x = y = z = 0.0
        for i in range(c.shape[1]):
            x += c[row, i] * state[i]
            y += c[row + 1, i] * state[i]
            z += c[row + 2, i] * state[i]
        for j in range(d.shape[1]):
            x += d[row, j] * displacement[j]
            y += d[row + 1, j] * displacement[j]
            z += d[row + 2, j] * displacement[j]
        force[row], force[row + 1], force[row + 2] = x, y, z


@compiled
def update(
    diagonal: Floats, cross: Floats, b_transposed: Floats, state: Floats, displacement: Floats
) -> None:
    """Advance `state` in place: xi+ = A xi + B u.

    diagonal, cross, state (order,), order even; b_transposed (n_inputs, order); displacement (n_inputs,) m
    """
    for i in range(0, state.shape[0], 2):
        first, second = state[i], state[i + 1]
        state[i] = diagonal[i] * first + cross[i] * second
        state[i + 1] = cross[i + 1] * first + diagonal[i + 1] * second
    for j in range(0, b_transposed.shape[0], 3):
        x, y, z = displacement[j], displacement[j + 1], displacement[j + 2]
        for i in range(state.shape[0]):
            state[i] += b_transposed[j, i] * x + b_transposed[j + 1, i] * y + b_transposed[j + 2, i] * z
