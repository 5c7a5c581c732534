"""SuperLU, which scipy brings along, used as a symmetric solver."""

from __future__ import annotations

from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_array, csr_array
from scipy.sparse.linalg import splu

Array = NDArray[np.float64]


class SuperLU:
    """The factor of a symmetric matrix, with the pivots on the diagonal.

    nnz  entries of L and U
    """

    def __init__(self, matrix: csr_array) -> None:
        full = csc_array((matrix.data, matrix.indices, matrix.indptr), shape=matrix.shape)  # symmetric
        try:
            self._lu = splu(
                full,
                permc_spec="MMD_AT_PLUS_A",
                diag_pivot_thresh=0.0,
                options={"SymmetricMode": True},
            )
        except MemoryError as error:  # also where the factor has more entries than its 32-bit indices count
            raise MemoryError(
                f"SuperLU has not enough memory for a matrix of {full.shape[0]:,} rows: "
                "use a coarser cloud, or install palpate[pardiso], which needs about half"
            ) from error
        self.nnz = int(self._lu.nnz)

    @cached_property
    def n_negative(self) -> int | None:
        """Negative eigenvalues of the matrix (Sylvester's law), or None where a pivot left the diagonal.

        Computed when it is asked for, because scipy copies the whole factor for it.
        """
        if not np.array_equal(self._lu.perm_r, self._lu.perm_c):
            return None
        return int(np.count_nonzero(self._lu.U.diagonal() < 0))

    def solve(self, right: Array) -> Array:
        """(n, k) for right-hand sides (n, k)."""
        return self._lu.solve(right)
