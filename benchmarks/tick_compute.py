"""What one tick costs: the block-diagonal kernel against BLAS matrix-vector products, then the whole tick and its message.

    python benchmarks/tick_compute.py [--runs 101]

The kernel and BLAS (through numba, so without Python between the calls; one thread) step the same model with the same inputs,
in turns of a thousand steps, their arrays aligned alike. The best of all runs is printed, in microseconds of processor time a
step: what else runs on the machine only adds to it. `tick` is everything that runs at a deadline: input, safety, kernel,
records, with a new command for every contact; `encode` makes the force message; `allocated` counts what a thousand ticks took
from the heap of compiled code.

What bounds the ratio is memory: with 30 channels at order 200, BLAS reads 430 KB a step and the blocks 110 KB, which is more
than a first-level cache holds. `read` is the time to only sum up what the blocks read of B, C and D: most of their step.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Callable

os.environ["OPENBLAS_NUM_THREADS"] = "1"  # read when numpy and scipy are imported

import numpy as np
from numba import njit
from numba.core.runtime import _nrt_python as _nrt
from numba.core.runtime import rtsys

from dense_form import dense_a
from palpate_server import codec
from palpate_server.bodies import state_space
from palpate_server.coupling.models import make_running
from palpate_server.diagnostics.sample_model import spring_mass_model
from palpate_server.realtime import scheduler, shared_memory
from palpate_server.realtime.native_image import make_image
from palpate_server.realtime.safety import Limits

STEPS = 1_000


@njit(fastmath=True)
def run_blocks(n, body, inputs):
    for k in range(n):
        u = inputs[k % inputs.shape[0]]
        state_space.output(body, u)
        state_space.update(body, u)


@njit
def run_blas(n, a, b, c, d, state, inputs, force, following, part_force, part_state):
    for k in range(n):
        u = inputs[k % inputs.shape[0]]
        np.dot(c, state, force)
        np.dot(d, u, part_force)
        force += part_force
        np.dot(a, state, following)
        np.dot(b, u, part_state)
        for i in range(state.shape[0]):
            state[i] = following[i] + part_state[i]


@njit(fastmath=True)
def run_reads(n, arrays):
    for _ in range(n):
        total = 0.0
        for array in arrays:
            for i in range(array.size):
                total += array[i]
        arrays[0][0] = total * 1e-300  # so that every pass has to be made


@njit
def run_ticks(n, incoming, image, start, period):
    tools = incoming.size
    first = incoming[0].sequence + 1
    for k in range(n):
        now = start + k * period
        for tool in range(tools):
            command = incoming[tool]
            command.tool = tool
            command.sequence, command.arrival_ns = first + k, now
            command.position_m[2] = 1e-3 * (k % 64)
        scheduler.hand_over(image, tools)
        scheduler.repeat_tick(image, now, now, False)


def allocations(function: Callable[[], None]) -> int:
    _nrt.memsys_enable_stats()
    before = rtsys.get_allocation_stats().alloc
    function()
    after = rtsys.get_allocation_stats().alloc
    _nrt.memsys_disable_stats()
    return after - before


def best_in_turns(runs: int, *functions: Callable[[], object]) -> list[float]:
    """Microseconds of processor time a step, the best of `runs` of each function, one after the other in each run."""
    times = [float("inf")] * len(functions)
    for _ in range(runs):
        for i, function in enumerate(functions):
            started = time.thread_time()
            function()
            times[i] = min(times[i], (time.thread_time() - started) / STEPS * 1e6)
    return times


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=101)
    options = parser.parse_args()
    print("order channels |    read  blocks    BLAS   ratio |    tick  encode | allocated")
    for order in (100, 200, 600):
        for contacts in (1, 10):
            row(order, contacts, options.runs)


def row(order: int, contacts: int, runs: int) -> None:
    model = spring_mass_model(contacts, order // 2)
    system, channels = model.discrete, 3 * contacts
    inputs = np.random.default_rng(0).normal(size=(64, channels)) * 1e-3
    blocks = state_space.make_body(system)
    dense = [state_space.aligned(matrix) for matrix in (dense_a(system), system.b, system.c, system.d)]
    dense_state, dense_force = state_space.aligned(np.zeros(order)), np.zeros(channels)
    scratch = (np.zeros(order), np.zeros(channels), np.zeros(order))
    dense_args = (*dense, dense_state, inputs, dense_force, *scratch)
    run_blocks(1000, blocks, inputs)
    run_blas(1000, *dense_args)
    np.testing.assert_allclose(blocks.state, dense_state, atol=1e-9 * np.abs(dense_state).max())
    np.testing.assert_allclose(blocks.force, dense_force, atol=1e-9 * np.abs(dense_force).max())
    matrices = tuple(
        state_space.aligned(matrix.ravel()) for matrix in (blocks.b_transposed, blocks.c, blocks.d)
    )
    run_reads(1, matrices)

    limits = Limits(10.0, 2000.0, 1.0, 0.1, 4.0)
    memory = shared_memory.make_memory(make_running(model), model.period_s, [limits] * contacts, 1 / 30)
    ticks_args = (memory.commands.incoming, make_image(memory), time.monotonic_ns(), int(memory.period_ns[0]))
    run_ticks(1, *ticks_args)
    entry, ticks = (allocations(lambda n=n: run_ticks(n, *ticks_args)) for n in (0, STEPS))
    encoder = codec.ForceEncoder(contacts)
    tick_words, ports = (codec.as_words(part)[0] for part in (memory.ring.ticks, memory.ring.ports))

    def encode() -> None:
        for _ in range(STEPS):
            encoder.encode(tick_words, ports)

    reading, stepping, blas, tick, encoding = best_in_turns(
        runs,
        lambda: run_reads(STEPS, matrices),
        lambda: run_blocks(STEPS, blocks, inputs),
        lambda: run_blas(STEPS, *dense_args),
        lambda: run_ticks(STEPS, *ticks_args),
        encode,
    )
    print(
        f"{order:5d} {channels:8d} | {reading:7.2f} {stepping:7.2f} {blas:7.2f} {blas / stepping:7.1f} | "
        f"{tick:7.2f} {encoding:7.2f} | {ticks - entry}",
        flush=True,
    )


if __name__ == "__main__":
    main()
