"""Real-time priority, locked memory and processor affinity, where the operating system allows them."""

from __future__ import annotations

import ctypes
import gc
import os
import resource
import sys

# Priorities of SCHED_FIFO (1 to 99), above ordinary threads and below the kernel's. The thread that receives commands runs ticks
# too, and the loop may wait for one of them, so no ordinary thread may interrupt it. Zenoh's threads keep the links alive and
# carry the messages: they need little time, but within the lease. The threads for queries, status and surface come last. They
# need a priority because a thread that waits for a processor may hold the GIL, for which commands then wait.
LOOP_PRIORITY = 80
COMMAND_PRIORITY = 70
ZENOH_PRIORITY = 5
SERVICE_PRIORITY = 2
_MCL_CURRENT, _MCL_FUTURE, _MCL_ONFAULT = 1, 2, 4  # on fault: lock a page when it is first used
_SWITCH_INTERVAL_S = 1e-4  # of Python threads


def raise_priority(priority: int = LOOP_PRIORITY, *, inherited: bool = False) -> str | None:
    """Give the calling thread a priority of SCHED_FIFO. Returns why not, or None.

    Threads and processes that it starts are of ordinary priority, unless `inherited`.
    """
    policy = os.SCHED_FIFO if inherited else os.SCHED_FIFO | os.SCHED_RESET_ON_FORK
    try:
        os.sched_setscheduler(0, policy, os.sched_param(priority))
    except OSError as error:
        return (
            f"no real-time scheduling ({error.strerror}): expect late ticks on a busy machine; "
            f"allow it with `ulimit -r {LOOP_PRIORITY}` or the capability SYS_NICE"
        )
    return None


def pin(cpu: int) -> str | None:
    """Keep the calling thread on the processor with this number. Returns why not, or None."""
    try:
        os.sched_setaffinity(0, {cpu})
    except (OSError, OverflowError) as error:
        return f"the loop is not kept on processor {cpu} ({error}): there may be fewer, or others are not allowed"
    return None


def lock_memory() -> str | None:
    """Keep the process's memory from being swapped out. Returns why not, or None."""
    soft, _ = resource.getrlimit(resource.RLIMIT_MEMLOCK)
    if soft != resource.RLIM_INFINITY and os.geteuid() != 0:  # a limited lock makes later allocations fail
        return f"memory is not locked (limit {soft} bytes): allow it with `ulimit -l unlimited`"
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.mlockall(_MCL_CURRENT | _MCL_FUTURE | _MCL_ONFAULT):
        return f"memory is not locked ({os.strerror(ctypes.get_errno())})"
    return None


def tune_interpreter() -> None:
    """Shorten pauses: exclude all existing objects from garbage collection, and switch Python threads more often."""
    gc.collect()
    gc.freeze()
    sys.setswitchinterval(_SWITCH_INTERVAL_S)
