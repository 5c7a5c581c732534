"""A vectorized dot product for compiled code that sums in one stated order, so that it always rounds the same.

A compiler that may reorder sums vectorizes them too, but its order differs between callers, between compilations and between
processors. A replay compares bit for bit, so the order has to be fixed.
"""

# mypy: disable-error-code="no-untyped-def, no-untyped-call, call-arg, arg-type"
from __future__ import annotations

from collections.abc import Callable
from typing import cast

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic
from numpy.typing import NDArray

Reals = NDArray[np.float64] | NDArray[np.float32]

LANES = 16  # numbers at a time: a multiple of the vector width of every processor
FLOAT32_LANES = 64  # and of sums in float32

_FLOAT, _DOUBLE, _INT32 = ir.FloatType(), ir.DoubleType(), ir.IntType(32)


def _is_vector(array) -> bool:
    return (
        isinstance(array, types.Array)
        and array.ndim == 1
        and array.layout == "C"
        and array.dtype in (types.float32, types.float64)
    )


@intrinsic
def _dot(typing_context, first, second):
    if not (_is_vector(first) and _is_vector(second)):
        return None
    result_type = types.float32 if first.dtype == second.dtype == types.float32 else types.float64
    number, count = (_FLOAT, FLOAT32_LANES) if result_type == types.float32 else (_DOUBLE, LANES)

    def codegen(context, builder, signature, args):
        arrays = [
            context.make_array(t)(context, builder, a) for t, a in zip(signature.args, args, strict=True)
        ]
        size = cgutils.unpack_tuple(builder, arrays[0].shape)[0]
        whole = builder.sdiv(size, size.type(count))

        def widened(value, width):
            wide = number if width == 1 else ir.VectorType(number, width)
            return value if value.type == wide else builder.fpext(value, wide)

        def load_lanes(array, place):
            pointer = builder.gep(array.data, [place])
            narrow = ir.VectorType(pointer.type.pointee, count)
            loaded = builder.load(builder.bitcast(pointer, narrow.as_pointer()), align=4)
            return widened(loaded, count)

        lanes_type = ir.VectorType(number, count)
        lanes = cgutils.alloca_once_value(builder, ir.Constant(lanes_type, [0.0] * count))
        with cgutils.for_range(builder, whole) as loop:
            place = builder.mul(loop.index, size.type(count))
            x, y = (load_lanes(a, place) for a in arrays)
            builder.store(builder.fadd(builder.load(lanes), builder.fmul(x, y)), lanes)

        total = builder.load(lanes)
        width = count
        while width > 1:
            width //= 2
            nothing = ir.Constant(total.type, ir.Undefined)
            low, high = (
                ir.Constant(ir.VectorType(_INT32, width), list(range(begin, begin + width)))
                for begin in (0, width)
            )
            total = builder.fadd(
                builder.shuffle_vector(total, nothing, low), builder.shuffle_vector(total, nothing, high)
            )

        result = cgutils.alloca_once_value(builder, builder.extract_element(total, _INT32(0)))
        rest = builder.mul(whole, size.type(count))
        with cgutils.for_range_slice(builder, rest, size, size.type(1)) as (place, _):
            x, y = (widened(builder.load(builder.gep(a.data, [place])), 1) for a in arrays)
            builder.store(builder.fadd(builder.load(result), builder.fmul(x, y)), result)
        return builder.load(result)

    return result_type(first, second), codegen


dot = cast(Callable[[Reals, Reals], float], _dot)
"""sum_i first[i] second[i] of two contiguous vectors (n,); for compiled code alone.

Order: LANES partial sums, each of every LANES-th product. Then the upper half of the sums is added to the lower half until one
sum is left. Then the last n % LANES products are added one by one. Every product and every sum is rounded to float64.
Float32 vectors are widened first where the other one is float64. Of two float32 vectors everything is rounded to float32, in FLOAT32_LANES.
"""
