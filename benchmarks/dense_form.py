"""The state matrix of a model as a dense array, for what is computed beside the block form that runs."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from palpate.model_file import StateSpace


def dense_a(system: StateSpace) -> NDArray[np.float64]:
    """(order, order), the state matrix A."""
    a = np.diag(system.diagonal)
    i = np.arange(system.order)
    a[i, i ^ 1] = system.cross
    return a
