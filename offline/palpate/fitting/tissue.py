"""The tissue that records show: stiffness at rest, branches and loss tangent, each with its confidence; or a refusal."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from palpate.fitting.branches import Branches, Fit, fit_branches
from palpate.fitting.confidence import (
    Estimate,
    Interval,
    correlation_time_of,
    estimate_of,
    further_branch,
    intervals,
)
from palpate.fitting.conversion import relaxation_of
from palpate.fitting.equations import Equations, equations_of, stacked
from palpate.fitting.identifiability import missing_data, tells
from palpate.fitting.records import Record, TimeRecord

Array = NDArray[np.float64]

HAPTIC_BAND_HZ = (1.0, 10.0, 30.0)

_NOTABLE_CORRELATION_TIME = 1.5  # in samples
_SIGNIFICANT = 2.58  # standard deviations: by chance in 1 of 200


class NotIdentifiable(ValueError):
    """the records don't determine a part of the material: a line for each, with the data that are missing."""


@dataclass(frozen=True)
class Branch:
    """gamma relative to the modulus at rest, and the time constant tau, s."""

    gamma: Interval
    tau_s: Interval


@dataclass(frozen=True)
class LossTangent:
    """Loss over storage modulus at a frequency; None where no record reaches."""

    frequency_hz: float
    value: Interval | None


@dataclass(frozen=True)
class Tissue:
    """A material as it was fitted.

    modulus_pa    Young's modulus at rest (fully relaxed)
    branches      time constants rising
    loss_tangent  in the haptic band
    residuals     for each record, (n_rows,), fit minus record: over time relative to the largest value; over frequency
                  relative to |E*|, first of the storage, then of the loss modulus
    missing       what the records don't determine, and which data would: a sentence each
    notes         what was assumed or is unusual: a sentence each
    """

    records: tuple[Record, ...]
    modulus_pa: Interval
    branches: tuple[Branch, ...]
    loss_tangent: tuple[LossTangent, ...]
    residuals: tuple[Array, ...]
    missing: tuple[str, ...]
    notes: tuple[str, ...]

    @property
    def rms_residual(self) -> float:
        """Root mean square of all residuals."""
        return float(np.sqrt(np.mean(np.concatenate(self.residuals) ** 2)))

    @property
    def relaxation(self) -> Branches:
        """The modulus as amplitudes, Pa, and time constants, s."""
        at_rest = self.modulus_pa.value
        parts = [at_rest * b.gamma.value for b in self.branches]
        return Branches(np.array([at_rest, *parts]), np.array([b.tau_s.value for b in self.branches]))


def fit_tissue(records: Sequence[Record], partial: bool = False) -> Tissue:
    """Fit one material to all records.

    partial  give the material also where the records don't determine a part of it; `missing` says which

    Raises NotIdentifiable, or ValueError for records that can't be fitted together.
    """
    creep = [r.name for r in records if isinstance(r, TimeRecord) and r.test == "creep"]
    if creep and len(records) > 1:
        raise ValueError(
            f"{creep[0]} is a creep test: expected it alone; relaxation and modulus can be fitted together"
        )
    equations = [equations_of(record) for record in records]
    fits = [fit_branches(part) for part in equations]
    together = equations[0] if len(fits) == 1 else stacked(equations, [f.rms for f in fits])
    fit = fits[0] if len(fits) == 1 else fit_branches(together)
    correlation = max(
        correlation_time_of(f.residuals) if isinstance(r, TimeRecord) else 1.0
        for f, r in zip(fits, records, strict=True)
    )
    estimate, n = estimate_of(fit, correlation), len(fit.branches.times)

    at_rest, *rest = intervals(_constants, estimate)
    branches = list(zip(rest[:n], rest[n:], strict=True))
    beyond = _relaxes_beyond(records, together, fit, correlation)
    missing = tuple(missing_data(records, at_rest, branches, beyond))
    if missing and not partial:
        raise NotIdentifiable("\n".join(missing))

    def relaxation(logarithms: Array) -> Branches:
        fitted = Branches(*np.split(np.exp(logarithms), [1 + n]))
        return relaxation_of(fitted) if creep else fitted

    at_rest, *rest = intervals(lambda x: _constants(relaxation(x).logarithms), estimate)
    return Tissue(
        tuple(records),
        at_rest,
        tuple(Branch(gamma, tau) for gamma, tau in zip(rest[:n], rest[n:], strict=True)),
        tuple(_loss_tangents(records, relaxation, estimate)),
        tuple(e.columns(fit.branches.times) @ fit.branches.amplitudes - e.values for e in equations),
        missing,
        tuple(_notes(records, n, correlation)),
    )


def _relaxes_beyond(
    records: Sequence[Record], equations: Equations, fit: Fit, correlation_time: float
) -> tuple[bool, bool]:
    """Whether a branch much faster than the records tell would improve the fit, and one much slower."""
    fastest = min(record.window_s[0] for record in records)
    slowest = max(record.window_s[1] for record in records)
    columns = equations.columns(np.array([fastest / 5, slowest * 10]))
    faster, slower = (further_branch(fit, column, correlation_time) for column in columns[:, 1:].T)
    return faster > _SIGNIFICANT, slower > _SIGNIFICANT


def complex_modulus(branches: Branches, frequency_hz: Array) -> NDArray[np.complex128]:
    """E* (n,), Pa, at frequencies (n,) of branches of a relaxation."""
    z = 2j * np.pi * np.asarray(frequency_hz)[:, None] * branches.times
    return np.asarray(branches.amplitudes[0] + (z / (1 + z)) @ branches.amplitudes[1:])


def _constants(logarithms: Array) -> Array:
    """From the logarithms of amplitudes and times to those of E, gamma and tau."""
    n = len(logarithms) // 2
    return np.concatenate([logarithms[:1], logarithms[1 : 1 + n] - logarithms[0], logarithms[1 + n :]])


def _loss_tangents(
    records: Sequence[Record], relaxation: Callable[[Array], Branches], estimate: Estimate
) -> Iterator[LossTangent]:
    """Each frequency asks for its own time constant, 1 / (2 pi f), in the window of a record."""
    told = [f for f in HAPTIC_BAND_HZ if tells(records, 1 / (2 * np.pi * f))]
    if len(estimate.logarithms) == 1:
        told = []  # no branch: what losses there are lie below the noise

    def logarithms(x: Array) -> Array:
        modulus = complex_modulus(relaxation(x), np.array(told))
        return np.log(modulus.imag / modulus.real)

    values = dict(zip(told, intervals(logarithms, estimate), strict=True)) if told else {}
    for frequency in HAPTIC_BAND_HZ:
        yield LossTangent(frequency, values.get(frequency))


def _notes(records: Sequence[Record], n_branches: int, correlation_time: float) -> Iterator[str]:
    for record in records:
        yield from record.notes
    if correlation_time > _NOTABLE_CORRELATION_TIME:
        yield (
            "neighboring residuals are alike: the noise was filtered, or the tissue does what a linear model can't. "
            f"The intervals are {correlation_time**0.5:.2g} times as wide for it"
        )
    if not n_branches:
        yield "no relaxation is seen above the noise: the tissue is elastic as far as the record tells"
