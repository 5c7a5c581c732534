"""What one tick costs: the block-diagonal kernel against BLAS matrix-vector products, then the whole tick and its message.

    python benchmarks/tick_compute.py [--runs 7]

The kernel and BLAS (through numba, so without Python between the calls) step the same model with the same inputs; the best
of several runs is printed, in microseconds a step. `tick` is everything that runs at a deadline: input, safety, kernel,
records; `encode` makes the force message; `allocated` counts what ten thousand ticks took from the heap of compiled code.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable

import numpy as np
from numba import njit
from numba.core.runtime import _nrt_python as _nrt
from numba.core.runtime import rtsys

from palpate_server import kernel, loop, wire
from palpate_server.image import make_image
from palpate_server.safety import Limits
from palpate_server.sample_model import spring_mass_model

STEPS = 10_000


@njit(fastmath=True)
def run_blocks(n, diagonal, cross, b_transposed, c, d, state, inputs, force):
    for k in range(n):
        u = inputs[k % inputs.shape[0]]
        kernel.output(c, d, state, u, force)
        kernel.update(diagonal, cross, b_transposed, state, u)


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


@njit
def run_ticks(n, image, start, period):
    for k in range(n):
        loop.repeat_tick(image, start + k * period)


def best(runs: int, function: Callable[[], None]) -> float:
    """Microseconds a step, the best of `runs`."""
    times = []
    for _ in range(runs):
        started = time.perf_counter()
        function()
        times.append(time.perf_counter() - started)
    return min(times) / STEPS * 1e6


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=7)
    options = parser.parse_args()
    print("order channels |  blocks    BLAS   ratio |    tick  encode | allocated")
    for order in (100, 200, 600):
        for contacts in (1, 10):
            row(order, contacts, options.runs)


def row(order: int, contacts: int, runs: int) -> None:
    model = spring_mass_model(contacts, order // 2)
    system, channels = model.discrete, 3 * contacts
    inputs = np.random.default_rng(0).normal(size=(64, channels)) * 1e-3
    b_transposed = np.ascontiguousarray(system.b.T)
    state, force = np.zeros(order), np.zeros(channels)
    blocks_args = (system.diagonal, system.cross, b_transposed, system.c, system.d)
    run_blocks(1, *blocks_args, state, inputs, force)
    state[:] = 0
    blocks = best(runs, lambda: run_blocks(STEPS, *blocks_args, state, inputs, force))

    a, dense_state, dense_force = system.dense_a(), np.zeros(order), np.zeros(channels)
    scratch = (np.zeros(order), np.zeros(channels), np.zeros(order))
    dense_args = (a, system.b, system.c, system.d, dense_state, inputs, dense_force, *scratch)
    run_blas(1, *dense_args)
    dense_state[:] = 0
    blas = best(runs, lambda: run_blas(STEPS, *dense_args))
    np.testing.assert_allclose(state, dense_state, atol=1e-9 * np.abs(dense_state).max())

    limits = Limits(10.0, 2000.0, 1.0, 0.1, 4.0)
    memory = loop.make_memory(system, model.period_s, [limits] * contacts, 1 / 30)
    image = make_image(memory)
    start = time.monotonic_ns()
    for contact in range(contacts):
        loop.write_command(memory.commands, contact, 1, 1, start, -1, (0.0, 0.0, 1e-3), (0.0, 0.0, 0.0))
    period = int(memory.period_ns[0])
    run_ticks(1, image, start, period)
    _nrt.memsys_enable_stats()
    before = rtsys.get_allocation_stats()
    run_ticks(STEPS, image, start, period)
    after = rtsys.get_allocation_stats()
    _nrt.memsys_disable_stats()
    tick = best(runs, lambda: run_ticks(STEPS, image, start, period))
    encoder = wire.ForceEncoder(contacts)

    def encode() -> None:
        for k in range(STEPS):
            encoder.encode(k, start, memory.record_inputs[0], memory.record_motion[0])

    print(
        f"{order:5d} {channels:8d} | {blocks:7.2f} {blas:7.2f} {blas / blocks:7.1f} | "
        f"{tick:7.2f} {best(runs, encode):7.2f} | {after.alloc - before.alloc}",
        flush=True,
    )


if __name__ == "__main__":
    main()
