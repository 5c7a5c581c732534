"""The full model in time: by Newmark's method on the sparse equations, as in the paper, and exactly, mode by mode."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from palpate.lti.stepping import step_through
from palpate_paper.examples import PERIOD_S, Example
from palpate_paper.stepping import median_seconds, sampled
from palpate_paper.time_integration import newmark

Array = NDArray[np.float64]


@dataclass(frozen=True)
class FullSolution:
    """The driven channel's reaction force (n_samples,), N, two ways, and the processor time of the whole history.

    exact      of the modes, for displacements that are linear between samples
    newmark    average acceleration, one sparse factorization
    blocks_s   the modes stepped by the compiled loop that steps the reduced models, s
    newmark_s  the factorization and all steps, s
    """

    exact: Array
    newmark: Array
    blocks_s: float
    newmark_s: float


def solve_in_full(example: Example) -> FullSolution:
    """Newmark runs once, the modes several times (the median counts)."""
    start = time.thread_time()
    history = newmark(example.equations, example.prony, example.inputs, PERIOD_S)
    newmark_s = time.thread_time() - start
    model = sampled(example.system, PERIOD_S)
    return FullSolution(
        exact=example.system.response(example.inputs, PERIOD_S)[:, example.channel],
        newmark=history.forces[:, example.channel],
        blocks_s=median_seconds(lambda: step_through(model, example.inputs)),
        newmark_s=newmark_s,
    )
