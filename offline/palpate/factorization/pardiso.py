"""MKL PARDISO through ctypes: supernodal, on all cores, without hashing its matrix."""

from __future__ import annotations

import ctypes
import weakref
from dataclasses import dataclass
from functools import cache
from importlib import metadata
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import bsr_array, csr_array

Array = NDArray[np.float64]
Integers = NDArray[np.int32]

_POSITIVE_DEFINITE, _INDEFINITE = 2, -2  # matrix types
_ANALYZE_AND_FACTORIZE, _SOLVE, _RELEASE = 12, 33, -1  # phases
_CAUSES = {
    -2: "not enough memory",
    -4: "zero or negative pivot",
    -9: "not enough memory",
    -8: "too many nonzeros",
}


@cache
def library() -> ctypes.CDLL | None:
    """MKL's runtime from the installed package `mkl`, or None."""
    try:
        files = metadata.files("mkl") or []
    except metadata.PackageNotFoundError:
        return None
    for file in files:
        if file.name.startswith(("libmkl_rt.", "mkl_rt.")) and not file.name.endswith(".lib"):
            return ctypes.CDLL(str(file.locate()))
    return None


@dataclass(frozen=True)
class UpperTriangle:
    """The upper triangle of a symmetric matrix, in blocks; those on the diagonal are stored in full.

    values (n_blocks, block, block), starts (n_rows + 1,), columns (n_blocks,): rows and columns of blocks
    """

    values: Array
    starts: Integers
    columns: Integers

    @property
    def block(self) -> int:
        return self.values.shape[1]


def upper_triangle(matrix: csr_array, block: int) -> UpperTriangle:
    """Of a matrix (n, n) with both triangles, n a multiple of `block`; entries that it does not store become zeros."""
    n_rows = matrix.shape[0] // block
    # scipy's `triu` makes three copies of the matrix on the way.
    rows = np.repeat(np.arange(n_rows, dtype=np.int32), np.diff(matrix.indptr[::block]))
    kept = matrix.indices // block >= rows
    starts = np.concatenate([[0], np.cumsum(kept)])[matrix.indptr].astype(np.int32)
    upper = csr_array((matrix.data[kept], matrix.indices[kept], starts), shape=matrix.shape)
    upper.sort_indices()
    blocks = bsr_array(upper, blocksize=(block, block))
    return UpperTriangle(
        blocks.data, blocks.indptr.astype(np.int32, copy=False), blocks.indices.astype(np.int32, copy=False)
    )


class Pardiso:
    """The factor of a symmetric matrix given by its upper triangle.

    nnz         entries of the factor
    n_negative  negative eigenvalues of the matrix: its inertia
    """

    def __init__(self, upper: UpperTriangle, definite: bool) -> None:
        n = len(upper.starts) - 1
        self._handle = (ctypes.c_void_p * 64)()
        self._type = _POSITIVE_DEFINITE if definite else _INDEFINITE
        self._matrix = upper
        parameters = np.zeros(64, np.int32)
        parameters[0] = 1  # no defaults
        parameters[1] = 2  # nested dissection (METIS)
        parameters[9] = 8  # perturb pivots below 1e-8 of the norm: the residual tells
        parameters[17] = -1  # report the entries of the factor
        parameters[20] = 1  # pivots of one and two
        parameters[34] = 1  # indices from 0
        parameters[36] = upper.block if upper.block > 1 else 0  # blocks, else compressed rows
        self._parameters = parameters
        weakref.finalize(self, _release, self._handle, self._type, n, parameters)
        _call(self._handle, self._type, _ANALYZE_AND_FACTORIZE, n, self._matrix, parameters, None, None)
        self.nnz = int(parameters[17]) * upper.block**2
        self.n_negative = 0 if definite else int(parameters[22])

    def solve(self, right: Array) -> Array:
        """(n, k) for right-hand sides (n, k)."""
        right = np.array(right, dtype=np.float64, order="F")
        solution = np.empty_like(right, order="F")
        n = len(self._matrix.starts) - 1
        _call(self._handle, self._type, _SOLVE, n, self._matrix, self._parameters, right, solution)
        return solution


def _release(handle: Any, kind: int, n: int, parameters: Integers) -> None:
    _call(handle, kind, _RELEASE, n, None, parameters, None, None)


def _call(
    handle: Any,
    kind: int,
    phase: int,
    n: int,
    matrix: UpperTriangle | None,
    parameters: Integers,
    right: Array | None,
    solution: Array | None,
) -> None:
    """One call of `pardiso`. Raises LinAlgError with the cause, MemoryError."""
    mkl = library()
    assert mkl is not None
    error = ctypes.c_int(0)
    arrays = (matrix.values, matrix.starts, matrix.columns) if matrix else ()
    values, starts, columns = (a.ctypes.data_as(ctypes.c_void_p) for a in arrays) if matrix else (None,) * 3
    mkl.pardiso(
        handle,
        _integer(1),
        _integer(1),
        _integer(kind),
        _integer(phase),
        _integer(n),
        values,
        starts,
        columns,
        None,
        _integer(1 if right is None else right.shape[1]),
        parameters.ctypes.data_as(ctypes.c_void_p),
        _integer(0),
        None if right is None else right.ctypes.data_as(ctypes.c_void_p),
        None if solution is None else solution.ctypes.data_as(ctypes.c_void_p),
        ctypes.byref(error),
    )
    if error.value in (-2, -9):
        raise MemoryError(f"PARDISO: not enough memory for a matrix of {n:,} rows")
    if error.value:
        cause = _CAUSES.get(error.value, f"error {error.value}")
        raise np.linalg.LinAlgError(f"PARDISO: {cause}, in a matrix of {n:,} rows")


def _integer(value: int) -> Any:
    return ctypes.byref(ctypes.c_int(value))
