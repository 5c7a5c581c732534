"""A model in the form that runs, and how long stepping it takes."""

from __future__ import annotations

import time
from collections.abc import Callable
from statistics import median

from palpate.lti.block_form import to_block_form
from palpate.lti.pole_residue import PoleResidueSystem
from palpate.lti.sampling import sample
from palpate.model_file import StateSpace


def sampled(system: PoleResidueSystem, period_s: float) -> StateSpace:
    """The system in real block-diagonal form, exact for displacements that are linear between samples."""
    return to_block_form(sample(system, period_s, "first-order-hold"))


def median_seconds(run: Callable[[], object], repeats: int = 5) -> float:
    """Median processor time of a few runs of one thread, s, after one that is not counted (compilation, caches).

    Processor time, because wall time on a busy machine measures its neighbors.
    """
    run()
    times = []
    for _ in range(repeats):
        start = time.thread_time()
        run()
        times.append(time.thread_time() - start)
    return median(times)
