"""Between diagonal systems and the real 2x2-block state space that runs."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from palpate.lti.errors import ReductionError
from palpate.lti.pole_residue import DiagonalSystem
from palpate.model_file import StateSpace

_LARGEST_CONDITION = 1e10  # beyond it the diagonal form keeps fewer than six digits


def diagonalize(
    a: NDArray[np.float64], b: NDArray[np.float64], c: NDArray[np.float64], d: NDArray[np.float64]
) -> DiagonalSystem:
    """The diagonal form of dx/dt = A x + B u, y = C x + D u; a (n, n), b (n, m), c (p, n), d (p, m), real.

    Rows of b and columns of c have equal 2-norm where neither is zero. Poles ascend in modulus, each its own group.

    Raises ReductionError where the eigenvectors' condition number is beyond 1e10: A is not diagonalizable in doubles.
    """
    poles, vectors = np.linalg.eig(a)
    vectors = vectors.astype(np.complex128)
    condition = np.linalg.cond(vectors) if len(poles) else 1.0
    if not condition <= _LARGEST_CONDITION:
        raise ReductionError(
            f"the eigenvectors of the state matrix have condition number {condition:.1e}, expected at most "
            f"{_LARGEST_CONDITION:.0e}: its poles nearly coincide, choose another order"
        )
    upper = np.flatnonzero(poles.imag >= 0)
    upper = upper[np.argsort(np.abs(poles[upper]), kind="stable")]
    rows = np.linalg.solve(vectors, b.astype(np.complex128))[upper]
    columns = (c @ vectors)[:, upper]
    on_axis = poles[upper].imag == 0  # there the eigenvectors are real, the solution has complex round-off
    rows[on_axis], columns[:, on_axis] = rows[on_axis].real, columns[:, on_axis].real
    row_norm, column_norm = np.linalg.norm(rows, axis=1), np.linalg.norm(columns, axis=0)
    driven = (row_norm > 0) & (column_norm > 0)
    scale = np.sqrt(np.where(driven, column_norm, 1) / np.where(driven, row_norm, 1))
    poles = poles[upper].astype(np.complex128)
    return DiagonalSystem(
        poles, rows * scale[:, None], columns / scale, np.array(d, dtype=np.float64), np.arange(len(poles))
    )


def to_block_form(system: DiagonalSystem) -> StateSpace:
    """The system in the block form of `palpate.model_file.StateSpace`: real poles first, then the pairs.

    An odd number of real poles is padded with a copy of the last one that nothing drives and nothing sees.
    """
    pair = system.is_pair
    real_b, real_c = system.b[~pair], system.c[:, ~pair]
    # A real pole's b and c may carry opposite complex factors (c b is real): move b's to c.
    largest = np.take_along_axis(real_b, np.argmax(np.abs(real_b), axis=1, keepdims=True), axis=1)[:, 0]
    phase = np.where(largest != 0, largest / np.where(largest != 0, np.abs(largest), 1), 1)
    real_poles = system.poles.real[~pair]
    rows, columns = (real_b / phase[:, None]).real, (real_c * phase).real
    if len(real_poles) % 2:
        real_poles = np.append(real_poles, real_poles[-1])
        rows = np.vstack([rows, np.zeros((1, system.n_inputs))])
        columns = np.hstack([columns, np.zeros((system.n_outputs, 1))])
    n_real, n = len(real_poles), len(real_poles) + 2 * int(np.count_nonzero(pair))
    diagonal, cross = np.empty(n), np.zeros(n)
    b, c = np.empty((n, system.n_inputs)), np.empty((system.n_outputs, n))
    diagonal[:n_real], b[:n_real], c[:, :n_real] = real_poles, rows, columns
    even, odd = slice(n_real, n, 2), slice(n_real + 1, n, 2)
    diagonal[even] = diagonal[odd] = system.poles.real[pair]
    cross[even], cross[odd] = -system.poles.imag[pair], system.poles.imag[pair]
    b[even], b[odd] = np.sqrt(2) * system.b[pair].real, np.sqrt(2) * system.b[pair].imag
    c[:, even], c[:, odd] = np.sqrt(2) * system.c[:, pair].real, -np.sqrt(2) * system.c[:, pair].imag
    return StateSpace(diagonal, cross, b, c, system.d.copy())


def from_block_form(state_space: StateSpace) -> DiagonalSystem:
    """The diagonal form of a block-diagonal state space, continuous or discrete; states keep their order.

    Raises ValueError where a block with cross coupling is not [[a, b], [-b, a]].
    """
    diagonal, cross = state_space.diagonal, state_space.cross
    if len(diagonal) % 2:
        raise ValueError(f"the state space has {len(diagonal)} states: expected an even number (2x2 blocks)")
    coupled = cross[0::2] != 0
    rotating = (diagonal[0::2] == diagonal[1::2]) & (cross[0::2] == -cross[1::2])
    if np.any(coupled & ~rotating) or np.any(~coupled & (cross[1::2] != 0)):
        raise ValueError("a block of the state space is neither two real poles nor [[a, b], [-b, a]]")
    # Even + j odd, over sqrt(2), has the pole a - jb; where that lies below the real axis take its conjugate.
    x_b = (state_space.b[0::2] + 1j * state_space.b[1::2]) / np.sqrt(2)
    x_c = (state_space.c[:, 0::2] - 1j * state_space.c[:, 1::2]) / np.sqrt(2)
    down = cross[0::2] > 0
    x_b, x_c = np.where(down[:, None], x_b.conj(), x_b), np.where(down, x_c.conj(), x_c)
    n = len(diagonal)
    poles = diagonal.astype(np.complex128)
    b, c = state_space.b.astype(np.complex128), state_space.c.astype(np.complex128)
    even = 2 * np.flatnonzero(coupled)
    poles[even] += 1j * np.abs(cross[even])
    b[even], c[:, even] = x_b[coupled], x_c[:, coupled]
    kept = np.ones(n, dtype=np.bool_)
    kept[even + 1] = False
    return DiagonalSystem(
        poles[kept], b[kept], c[:, kept], np.array(state_space.d), np.arange(int(np.count_nonzero(kept)))
    )
