"""How functions of the real-time path are compiled: cached on disk where that is possible, with and without the GIL."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any, TypeVar, cast

from numba import njit

Function = TypeVar("Function", bound=Callable[..., Any])

# Sums may be reordered and fused: that is what vectorises a dot product.
FAST_MATH = {"reassoc", "contract", "nsz"}


def compiled(function: Function) -> Function:
    """Compile `function`; Python calls it with the GIL held, so use it for what lasts microseconds."""
    return _compile(function, nogil=False)


def compiled_without_gil(function: Function) -> Function:
    """Compile `function`; it releases the GIL for as long as it runs."""
    return _compile(function, nogil=True)


def compiled_exactly(function: Function) -> Function:
    """Compile `function` with every operation as written: a test for NaN on sums that may be reordered is optimised away."""
    return _compile(function, nogil=False, fast_math=set())


def _compile(function: Function, *, nogil: bool, fast_math: set[str] = FAST_MATH) -> Function:
    try:
        return cast(Function, njit(cache=True, nogil=nogil, fastmath=fast_math)(function))
    except (
        RuntimeError
    ) as error:  # no cache directory is writable: a read-only container, another user's files
        warnings.warn(
            f"compiled functions are not cached, every start takes seconds longer ({error}); "
            "point NUMBA_CACHE_DIR to a writable directory",
            RuntimeWarning,
            stacklevel=3,
        )
        return cast(Function, njit(cache=False, nogil=nogil, fastmath=fast_math)(function))
