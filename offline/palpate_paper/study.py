"""Full models, reductions, errors and times that several figures share, each computed once."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from palpate.lti.frequencies import (
    all_frequencies,
    band_frequencies,
    relative_errors,
    spectral_norms,
)
from palpate.lti.pole_residue import PoleResidueSystem
from palpate.lti.stepping import step_through
from palpate.reduction.accuracy import hinf_error, in_band_error
from palpate_paper.examples import PERIOD_S, Example, cube, disc, square
from palpate_paper.full_solution import FullSolution, solve_in_full
from palpate_paper.methods import OF_THE_PAPER, Method, Reduced, reduce_by
from palpate_paper.stepping import median_seconds, sampled


@dataclass(frozen=True)
class Comparison:
    """One reduced model measured against the full one; all errors are fractions.

    error_hinf      largest |F - F_r| over all frequencies over the largest |F|
    error_band      largest |F - F_r| / |F| in the band that the nodes carry
    error_static    the same at 0 Hz
    error_infinite  the same at infinite frequency: what the method does to D
    error_time      sum |F - F_r| over sum |F|, over the samples of the example's history
    stepping_s      processor time of the whole history, s, one compiled step a sample
    bound           the method's bound on error_hinf; None without
    """

    reduced: Reduced
    error_hinf: float
    error_band: float
    error_static: float
    error_infinite: float
    error_time: float
    stepping_s: float
    bound: float | None

    @property
    def method(self) -> Method:
        return self.reduced.method

    @property
    def product(self) -> float:
        """Per cent times seconds of stepping, as in the paper's figure 13."""
        return 100 * self.error_time * self.stepping_s


class Study:
    """Computes the shared parts on first use and keeps them.

    quick  small node clouds
    note   called with the name of each step
    """

    def __init__(self, quick: bool = False, note: Callable[[str], None] = lambda text: None) -> None:
        self.quick = quick
        self.note = note
        self._reduced: dict[tuple[str, str, int], Reduced | None] = {}
        self._solutions: dict[str, FullSolution] = {}
        self._comparisons: dict[tuple[str, bool], list[Comparison]] = {}

    @cached_property
    def disc(self) -> Example:
        self.note("disc: modes of the full model")
        return disc(150) if self.quick else disc(500)

    @cached_property
    def square(self) -> Example:
        self.note("square: modes of the full model")
        return square(9) if self.quick else square(15)

    @cached_property
    def cube(self) -> Example:
        self.note("cube: modes of the full model")
        return cube(6) if self.quick else cube(10)

    def reduced(self, example: Example, method: Method, order: int) -> Reduced | None:
        """The reduction of an example to at most `order` states; None where the method has none."""
        key = (example.name, method.name, order)
        if key not in self._reduced:
            self.note(f"{example.name}: {method.name}, order {order}")
            self._reduced[key] = reduce_by(method, example.system, example.band_hz, order)
        return self._reduced[key]

    def solution(self, example: Example) -> FullSolution:
        """The full model's reaction force to the example's history."""
        if example.name not in self._solutions:
            self.note(f"{example.name}: the full model in time, {len(example.inputs) - 1:,} steps")
            self._solutions[example.name] = solve_in_full(example)
        return self._solutions[example.name]

    def compare(
        self, example: Example, order: int, methods: Sequence[Method] = OF_THE_PAPER
    ) -> list[Comparison]:
        """A comparison for every method that has the order."""
        reductions = [self.reduced(example, m, order) for m in methods]
        return [self._measure(example, r) for r in reductions if r is not None]

    def at_order_of_the_paper(self, example: Example) -> list[Comparison]:
        return self._kept(example, False)

    def at_a_tenth(self, example: Example) -> list[Comparison]:
        return self._kept(example, True)

    def _kept(self, example: Example, small: bool) -> list[Comparison]:
        key = (example.name, small)
        if key not in self._comparisons:
            order = example.small_order if small else example.order
            self._comparisons[key] = self.compare(example, order)
        return self._comparisons[key]

    def _measure(self, example: Example, reduced: Reduced) -> Comparison:
        self.note(f"{example.name}: errors and times of {reduced.method.name}, order {reduced.order}")
        full, small = example.system, reduced.system
        model = sampled(small, PERIOD_S)
        exact = self.solution(example).exact
        stepped = step_through(model, example.inputs)[0][:, example.channel]
        largest = np.max(spectral_norms(full.transfer(1j * all_frequencies((full,)))))
        return Comparison(
            reduced,
            hinf_error(full, small),
            in_band_error(full, small, band_frequencies((full, small), example.band_hz)),
            static_error(full, small),
            float(np.linalg.norm(full.d - small.d, 2) / np.linalg.norm(full.d, 2)),
            float(np.sum(np.abs(stepped - exact)) / np.sum(np.abs(exact))),
            median_seconds(lambda: step_through(model, example.inputs)),
            None if reduced.bound is None else float(reduced.bound / largest),
        )


def static_error(full: PoleResidueSystem, small: PoleResidueSystem) -> float:
    """|F(0) - F_r(0)| / |F(0)|."""
    zero = np.zeros(1, dtype=np.complex128)
    return float(relative_errors(full.transfer(zero), small.transfer(zero))[0])


TIME_SCATTER = 2.0
"""Factor by which times of the same work differ between runs on a busy machine: what is closer counts as equal."""


def ranking(values: dict[str, float], unit: Callable[[float], str], equal_within: float = 1.1) -> str:
    """The names by ascending value with their values; those within the factor of the least of a group count as equal."""
    text, least = "", 0.0
    for name, value in sorted(values.items(), key=lambda item: item[1]):
        new_group = value > equal_within * least
        if text:
            text += " < " if new_group else " ≈ "
        if new_group:
            least = value
        text += f"{name} ({unit(value)})"
    return text


def per_cent(fraction: float) -> str:
    """A fraction with two digits, in per cent."""
    return f"{_two_digits(100 * fraction)} %"


def seconds(value: float) -> str:
    """Seconds with two digits, in ms or µs where small."""
    if value >= 1:
        return f"{_two_digits(value)} s"
    return f"{_two_digits(1e3 * value)} ms" if value >= 1e-3 else f"{_two_digits(1e6 * value)} µs"


def _two_digits(value: float) -> str:
    return f"{value:.0f}" if 100 <= value < 1e5 else f"{value:.2g}"
