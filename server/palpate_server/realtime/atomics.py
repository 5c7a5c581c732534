"""Atomic loads and stores on vectors of int64, for compiled code alone.

Plain loads are not enough: the compiler may hoist them out of a loop, and a reader may see half of a write.
"""

# mypy: disable-error-code="no-untyped-def, no-untyped-call, call-arg, arg-type"
from __future__ import annotations

from collections.abc import Callable
from typing import cast

import numpy as np
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic
from numpy.typing import NDArray

from palpate_server.realtime.compiled import compiled

Integers = NDArray[np.int64]

_BYTES = 8  # of an int64


def _element(context, builder, signature, args):
    array_type = signature.args[0]
    if (array_type.ndim, array_type.dtype) != (1, types.int64):
        raise TypeError(f"{array_type} is no vector of int64")
    array = context.make_array(array_type)(context, builder, args[0])
    return cgutils.get_item_pointer(context, builder, array_type, array, [args[1]])


@intrinsic
def _load(typing_context, array, index):
    def codegen(context, builder, signature, args):
        return builder.load_atomic(_element(context, builder, signature, args), "acquire", _BYTES)

    return types.int64(array, types.intp), codegen


@intrinsic
def _store(typing_context, array, index, value):
    def codegen(context, builder, signature, args):
        pointer = _element(context, builder, signature, args)
        builder.store_atomic(args[2], pointer, "release", _BYTES)
        return context.get_dummy_value()

    return types.void(array, types.intp, types.int64), codegen


@intrinsic
def _swap(typing_context, array, index, expected, value):
    def codegen(context, builder, signature, args):
        pointer = _element(context, builder, signature, args)
        result = builder.cmpxchg(pointer, args[2], args[3], "acq_rel", "acquire")
        return builder.extract_value(result, 1)

    return types.boolean(array, types.intp, types.int64, types.int64), codegen


@intrinsic
def _fence(typing_context):
    def codegen(context, builder, signature, args):
        builder.fence("seq_cst")
        return context.get_dummy_value()

    return types.void(), codegen


load_acquire = cast(Callable[[Integers, int], int], _load)
"""array[index]; what its writer stored before is visible afterwards."""

store_release = cast(Callable[[Integers, int, int], None], _store)
"""array[index] = value; what was stored before is visible to whoever loads it with `load_acquire`."""

compare_and_swap = cast(Callable[[Integers, int, int, int], bool], _swap)
"""Set array[index] to the last argument if it equals the one before, atomically; whether it did."""


# A sequence lock. The writer makes the version odd, writes, and makes it even. A reader that saw an odd version, or finds
# another one afterwards, reads again, up to MAX_READS times. There is one writer at a time; it never waits for a reader.

MAX_READS = 100


@compiled
def begin_write(versions: Integers, index: int) -> None:
    _store(versions, index, _load(versions, index) + 1)
    _fence()


@compiled
def end_write(versions: Integers, index: int) -> None:
    _store(versions, index, _load(versions, index) + 1)


@compiled
def begin_read(versions: Integers, index: int) -> int:
    """The version to pass to `is_whole`; odd during a write."""
    return _load(versions, index)


@compiled
def is_whole(versions: Integers, index: int, version: int) -> bool:
    """True when nothing was written since `begin_read` gave `version`."""
    _fence()
    return version % 2 == 0 and _load(versions, index) == version
