"""Atomic loads and stores on int64 arrays for compiled code: what a loop and its callers share without a Python lock.

Plain loads are not enough: the compiler may hoist them out of a loop, and a reader may see half of a write.
"""

# mypy: disable-error-code="no-untyped-def, no-untyped-call, call-arg, arg-type"
from __future__ import annotations

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
    array = context.make_array(array_type)(context, builder, args[0])
    return cgutils.get_item_pointer(context, builder, array_type, array, [args[1]])


def _is_int64_vector(array) -> bool:
    return isinstance(array, types.Array) and array.ndim == 1 and array.dtype == types.int64


@intrinsic
def _load(typing_context, array, index):
    if not _is_int64_vector(array):
        return None

    def codegen(context, builder, signature, args):
        return builder.load_atomic(_element(context, builder, signature, args), "acquire", _BYTES)

    return types.int64(array, types.intp), codegen


@intrinsic
def _store(typing_context, array, index, value):
    if not _is_int64_vector(array):
        return None

    def codegen(context, builder, signature, args):
        pointer = _element(context, builder, signature, args)
        builder.store_atomic(args[2], pointer, "release", _BYTES)
        return context.get_dummy_value()

    return types.void(array, types.intp, types.int64), codegen


@intrinsic
def _swap(typing_context, array, index, expected, value):
    if not _is_int64_vector(array):
        return None

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


@compiled
def load_acquire(array: Integers, index: int) -> int:
    """array[index] of an int64 vector; what its writer stored before it is visible afterwards."""
    return _load(array, index)


@compiled
def store_release(array: Integers, index: int, value: int) -> None:
    """array[index] = value on an int64 vector; what was stored before it is visible to whoever loads it."""
    _store(array, index, value)


@compiled
def compare_and_swap(array: Integers, index: int, expected: int, value: int) -> bool:
    """Store `value` where array[index] equals `expected`, in one indivisible act; True when it was stored."""
    return _swap(array, index, expected, value)


# A sequence lock: the writer makes the version odd, writes, makes it even; a reader whose version was odd or has
# changed reads again, up to MAX_READS times. One writer at a time; readers never hold it up, nor it them.

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
    """The version to hand to `is_whole`; odd while a write is under way."""
    return _load(versions, index)


@compiled
def is_whole(versions: Integers, index: int, version: int) -> bool:
    """True when nothing was written since `begin_read` gave `version`."""
    _fence()
    return version % 2 == 0 and _load(versions, index) == version
