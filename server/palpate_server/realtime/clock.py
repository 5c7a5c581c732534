"""The monotonic clock (CLOCK_MONOTONIC, the one of time.monotonic_ns) for compiled code: read it, sleep until a time."""

# mypy: disable-error-code="no-untyped-def, no-untyped-call, call-arg"
from __future__ import annotations

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from palpate_server.realtime.compiled import compiled, compiled_without_gil

_CLOCK_MONOTONIC = 1
_TIMER_ABSTIME = 1
_NANOSECONDS = 1_000_000_000

_INT32 = ir.IntType(32)
_INT64 = ir.IntType(64)
_TIMESPEC = ir.LiteralStructType([_INT64, _INT64])  # seconds, nanoseconds


@intrinsic
def _clock_gettime(typing_context):

    def codegen(context, builder, signature, args):
        timespec = cgutils.alloca_once(builder, _TIMESPEC)
        function_type = ir.FunctionType(_INT32, [_INT32, _TIMESPEC.as_pointer()])
        function = cgutils.get_or_insert_function(builder.module, function_type, "clock_gettime")
        builder.call(function, [_INT32(_CLOCK_MONOTONIC), timespec])
        fields = builder.load(timespec)
        seconds = builder.extract_value(fields, 0)
        return builder.add(builder.mul(seconds, _INT64(_NANOSECONDS)), builder.extract_value(fields, 1))

    return types.int64(), codegen


@intrinsic
def _clock_nanosleep(typing_context, deadline_ns):

    def codegen(context, builder, signature, args):
        timespec = cgutils.alloca_once(builder, _TIMESPEC)
        nanoseconds = _INT64(_NANOSECONDS)
        builder.store(builder.sdiv(args[0], nanoseconds), cgutils.gep_inbounds(builder, timespec, 0, 0))
        builder.store(builder.srem(args[0], nanoseconds), cgutils.gep_inbounds(builder, timespec, 0, 1))
        pointer = _TIMESPEC.as_pointer()
        function_type = ir.FunctionType(_INT32, [_INT32, _INT32, pointer, pointer])
        function = cgutils.get_or_insert_function(builder.module, function_type, "clock_nanosleep")
        flags = _INT32(_TIMER_ABSTIME)
        return builder.call(function, [_INT32(_CLOCK_MONOTONIC), flags, timespec, ir.Constant(pointer, None)])

    return types.int32(types.int64), codegen


@compiled
def monotonic_ns() -> int:
    """Nanoseconds on the monotonic clock."""
    return _clock_gettime()


@compiled_without_gil
def sleep_until(deadline_ns: int) -> None:
    """Sleep until `deadline_ns` on the monotonic clock. Returns at once if that is past, and early on a signal."""
    _clock_nanosleep(deadline_ns)
