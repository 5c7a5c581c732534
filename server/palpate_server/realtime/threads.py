"""What the operating system can do for the loop, when it allows it: scheduling priority, memory that stays."""

from __future__ import annotations

import ctypes
import gc
import os
import resource
import sys

# Of SCHED_FIFO, 1 to 99: above ordinary threads, below the kernel's own. The thread that receives commands runs ticks too;
# if an ordinary thread could interrupt it in the middle of one, the loop would have to wait for both.
LOOP_PRIORITY = 80
COMMAND_PRIORITY = 70
_MCL_CURRENT, _MCL_FUTURE, _MCL_ONFAULT = 1, 2, 4  # on fault: what is never touched needs no memory
_SWITCH_INTERVAL_S = 1e-4  # after which a busy Python thread lets another one run


def raise_priority(priority: int = LOOP_PRIORITY) -> str | None:
    """Schedule the calling thread first in, first out; or say why not."""
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
    except OSError as error:
        return (
            f"no real-time scheduling ({error.strerror}): expect late ticks on a busy machine; "
            f"allow it with `ulimit -r {LOOP_PRIORITY}` or the capability SYS_NICE"
        )
    return None


def pin(cpu: int) -> str | None:
    """Keep the calling thread on one processor, by its number; or say why not."""
    try:
        os.sched_setaffinity(0, {cpu})
    except (OSError, OverflowError) as error:
        return f"the loop is not kept on processor {cpu} ({error}): there may be fewer, or others are not allowed"
    return None


def lock_memory() -> str | None:
    """Keep the process's memory from being swapped out; or say why not."""
    soft, _ = resource.getrlimit(resource.RLIMIT_MEMLOCK)
    if soft != resource.RLIM_INFINITY and os.geteuid() != 0:  # a limited lock makes later allocations fail
        return f"memory is not locked (limit {soft} bytes): allow it with `ulimit -l unlimited`"
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.mlockall(_MCL_CURRENT | _MCL_FUTURE | _MCL_ONFAULT):
        return f"memory is not locked ({os.strerror(ctypes.get_errno())})"
    return None


def calm_interpreter() -> None:
    """Take what exists out of the garbage collector's sight, and let waiting Python threads run sooner."""
    gc.collect()
    gc.freeze()
    sys.setswitchinterval(_SWITCH_INTERVAL_S)
