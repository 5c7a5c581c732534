"""A body as a discrete state space in block-diagonal form: F = C xi + D u, then xi+ = A xi + B u, allocating nothing.

The form is that of `palpate.model_file.StateSpace`: state i is coupled to itself and to its partner i XOR 1 alone, so a
step costs O(order (n_inputs + n_outputs)). It takes as long as reading B and C does: both functions go through their
matrix once, from its beginning to its end.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from palpate.model_file import StateSpace
from palpate_server.realtime.compiled import compiled
from palpate_server.realtime.dot import dot

Floats = NDArray[np.float64]

_CACHE_LINE = 64  # bytes


class StateSpaceBody(NamedTuple):
    """Matrices, state and output of a discrete model.

    diagonal, cross, state (order,), order even; b_transposed (n_inputs, order); c (n_outputs, order);
    d (n_outputs, n_inputs); force (n_outputs,), N
    """

    diagonal: Floats
    cross: Floats
    b_transposed: Floats
    c: Floats
    d: Floats
    state: Floats
    force: Floats


def make_body(system: StateSpace, displacement: Floats | None = None) -> StateSpaceBody:
    """The body at rest, or where it settles when `displacement` (n_inputs,), m, stays: xi = (1 - A)^-1 B u."""
    state: Floats = np.zeros(system.order)
    if displacement is not None:
        drive = (system.b @ displacement).reshape(-1, 2, 1)
        blocks = np.empty((system.order // 2, 2, 2))
        blocks[:, 0, 0], blocks[:, 1, 1] = 1 - system.diagonal[0::2], 1 - system.diagonal[1::2]
        blocks[:, 0, 1], blocks[:, 1, 0] = -system.cross[0::2], -system.cross[1::2]
        state[:] = np.linalg.solve(blocks, drive).ravel()
    return StateSpaceBody(
        diagonal=aligned(system.diagonal),
        cross=aligned(system.cross),
        b_transposed=aligned(system.b.T),
        c=aligned(system.c),
        d=aligned(system.d),
        state=aligned(state),
        force=np.zeros(len(system.c)),
    )


def empty_body(n_channels: int) -> StateSpaceBody:
    """A body without states, whose force is zero."""
    n = n_channels
    return make_body(
        StateSpace(np.zeros(0), np.zeros(0), np.zeros((0, n)), np.zeros((n, 0)), np.zeros((n, n)))
    )


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
def output(body: StateSpaceBody, displacement: Floats) -> None:
    """Write F = C xi + D u into the body's force; displacement (n_inputs,), m."""
    c, d, state, force = body.c, body.d, body.state, body.force
    for row in range(c.shape[0]):
        force[row] = dot(c[row], state) + dot(d[row], displacement)


@compiled
def update(body: StateSpaceBody, displacement: Floats) -> None:
    """Advance the body's state in place: xi+ = A xi + B u; displacement (n_inputs,), m."""
    # Taken out of the tuple once: in the loops the compiler could not know that what it writes is not the tuple itself.
    diagonal, cross, b_transposed, state = body.diagonal, body.cross, body.b_transposed, body.state
    for pair in range(state.shape[0] // 2):
        i = 2 * pair  # with range(0, order, 2) the compiler would test every index for its sign
        first, second = state[i], state[i + 1]
        state[i] = diagonal[i] * first + cross[i] * second
        state[i + 1] = cross[i + 1] * first + diagonal[i + 1] * second
    for j in range(b_transposed.shape[0]):
        u = displacement[j]
        for i in range(state.shape[0]):
            state[i] += b_transposed[j, i] * u
