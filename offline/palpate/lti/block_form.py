"""From dense matrices to pole-residue form, and from there to the real 2x2-block state space that runs."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from palpate.lti.errors import ReductionError
from palpate.lti.pole_residue import PoleResidueSystem, phases
from palpate.model_file import StateSpace

_LARGEST_CONDITION = 1e10  # beyond it the diagonal form keeps fewer than six digits


def diagonalize(
    a: NDArray[np.float64], b: NDArray[np.float64], c: NDArray[np.float64], d: NDArray[np.float64]
) -> PoleResidueSystem:
    """The pole-residue form of dx/dt = A x + B u, y = C x + D u; a (n, n), b (n, m), c (p, n), d (p, m), real.

    Rows of b and columns of c have equal 2-norm where neither is zero. Poles ascend in modulus.

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
    return PoleResidueSystem(poles, rows * scale[:, None], columns / scale, np.array(d, dtype=np.float64))


def to_block_form(system: PoleResidueSystem) -> StateSpace:
    """The system in the block form of `palpate.model_file.StateSpace`: real poles first, then the pairs.

    An odd number of real poles is padded with a copy of the last one that nothing drives and nothing sees.
    """
    pair = system.is_pair
    real_b, real_c = system.b[~pair], system.c[:, ~pair]
    # A real pole's b and c may carry opposite complex factors (c b is real): move b's to c.
    phase = phases(real_b)
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
