"""The stiffness of an isotropic body from the strain in each node's cell, compiled."""

from __future__ import annotations

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray
from scipy.sparse import bsr_array, csr_array

Array = NDArray[np.float64]
Indices = NDArray[np.int32]

CHUNKS = 64
"""Parts of the matrix that share work arrays: a multiple of any small number of threads."""


def isotropic_stiffness(
    pattern: csr_array, gradients: Array, volumes: Array, lame_pa: Array, shear_modulus_pa: float
) -> csr_array:
    """(3 n, 3 n), N/m: sum over cells I and operators k of V_I (lambda_k (div u)² + 2 mu eps:eps) with D_k u at I.

    pattern           (n_cells, n), which nodes' parameters reach which cell; only its sparsity counts
    gradients         (nnz, k, 3), the operators D_k, 1/m, entries in the order of the pattern
    volumes           (n_cells,), m³
    lame_pa           (k,), the first Lamé constant that each operator counts with, Pa
    """
    entry = csr_array((np.arange(pattern.nnz), pattern.indices, pattern.indptr), shape=pattern.shape).tocsc()
    columns = (entry.indptr, entry.indices, entry.data)
    rows = (pattern.indptr, pattern.indices)
    counts = _fill(rows, columns, gradients, volumes, lame_pa, shear_modulus_pa, *_nothing(pattern.shape[1]))
    indptr = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
    indices, blocks = np.empty(indptr[-1], np.int32), np.empty((indptr[-1], 3, 3))
    _fill(rows, columns, gradients, volumes, lame_pa, shear_modulus_pa, indptr, indices, blocks)
    if 9 * indptr[-1] <= np.iinfo(np.int32).max:  # indices of 8 bytes are a third of the matrix
        indptr = indptr.astype(np.int32)
    size = 3 * pattern.shape[1]
    return csr_array(bsr_array((blocks, indices, indptr), shape=(size, size)).tocsr())


def _nothing(n: int) -> tuple[NDArray[np.int64], Indices, Array]:
    """For the first pass, which only counts."""
    return np.zeros(n + 1, np.int64), np.empty(0, np.int32), np.empty((0, 3, 3))


@njit(parallel=True, cache=True)
def _fill(
    rows: tuple[Indices, Indices],
    columns: tuple[Indices, Indices, NDArray[np.int64]],
    gradients: Array,
    volumes: Array,
    lame: Array,
    mu: float,
    indptr: NDArray[np.int64],
    indices: Indices,
    blocks: Array,
) -> NDArray[np.int64]:
    """The number of nodes that each node shares a cell with, (n,); then, with room for them, their indices and blocks."""
    cell_starts, nodes = rows
    node_starts, cells, entries = columns
    n = len(node_starts) - 1
    n_operators = gradients.shape[1]
    counts = np.zeros(n, np.int64)
    for chunk in prange(CHUNKS):
        place = np.full(n, -1, np.int32)
        found = np.empty(n, np.int32)
        for i in range(chunk * n // CHUNKS, (chunk + 1) * n // CHUNKS):
            count = 0
            for t in range(node_starts[i], node_starts[i + 1]):
                for f in range(cell_starts[cells[t]], cell_starts[cells[t] + 1]):
                    if place[nodes[f]] < 0:
                        place[nodes[f]] = 0
                        found[count] = nodes[f]
                        count += 1
            counts[i] = count
            row = np.sort(found[:count])
            if len(indices):
                start = indptr[i]
                for k in range(count):
                    place[row[k]] = k
                    indices[start + k] = row[k]
                own = blocks[start : start + count]
                own[:] = 0.0
                for t in range(node_starts[i], node_starts[i + 1]):
                    for f in range(cell_starts[cells[t]], cell_starts[cells[t] + 1]):
                        block = own[place[nodes[f]]]
                        for k in range(n_operators):
                            trace = 0.0
                            for a in range(3):
                                trace += gradients[entries[t], k, a] * gradients[f, k, a]
                            shear = volumes[cells[t]] * mu
                            bulk = volumes[cells[t]] * lame[k]
                            for a in range(3):
                                for b in range(3):
                                    block[a, b] += (
                                        bulk * gradients[entries[t], k, a] * gradients[f, k, b]
                                        + shear * gradients[entries[t], k, b] * gradients[f, k, a]
                                    )
                                block[a, a] += shear * trace
            for k in range(count):
                place[row[k]] = -1
    return counts
