"""Synthetic records from closed-form solutions, which share nothing with the code under test."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import pytest
from numpy.typing import NDArray

from palpate.fitting.records import ModulusRecord, Signal, TimeRecord, time_record

Array = NDArray[np.float64]


def ramped(time_s: Array, ramp_s: float) -> Array:
    return np.minimum(time_s / ramp_s, 1.0)


def low_passed_ramp(time_s: Array, ramp_s: float, tau_s: float) -> Array:
    """The closed-form solution of tau x' = ramp - x, x(0) = 0."""
    rising = (time_s - tau_s * -np.expm1(-time_s / tau_s)) / ramp_s
    end = 1 - tau_s / ramp_s * -np.expm1(-ramp_s / tau_s)
    held = 1 - (1 - end) * np.exp(-(time_s - ramp_s) / tau_s)
    return np.where(time_s < ramp_s, rising, held)


@pytest.fixture(scope="session")
def relaxation() -> Callable[..., TimeRecord]:
    """A relaxation with Gaussian noise, a fraction of the largest stress."""

    def record(
        material: tuple[float, Sequence[float], Sequence[float]],
        time_s: Array,
        ramp_s: float = 0.5,
        noise: float = 0.01,
        seed: int = 0,
    ) -> TimeRecord:
        modulus, gamma, tau = material
        strain = 0.05 * ramped(time_s, ramp_s)
        relaxing = sum(
            g * (strain - 0.05 * low_passed_ramp(time_s, ramp_s, t)) for g, t in zip(gamma, tau, strict=True)
        )
        stress = modulus * (strain + relaxing)
        stress = stress + noise * stress.max() * np.random.default_rng(seed).standard_normal(len(stress))
        return time_record("made.csv", time_s, Signal("strain", "", strain), Signal("stress", "Pa", stress))

    return record


@pytest.fixture(scope="session")
def complex_modulus_record() -> Callable[..., ModulusRecord]:
    """A complex modulus with Gaussian noise, a fraction of its absolute value at each frequency."""

    def record(
        modulus_pa: NDArray[np.complex128], frequency_hz: Array, noise: float = 0.01, seed: int = 0
    ) -> ModulusRecord:
        real, imaginary = np.random.default_rng(seed).standard_normal((2, len(frequency_hz)))
        noisy = modulus_pa + noise * np.abs(modulus_pa) * (real + 1j * imaginary)
        return ModulusRecord("made.csv", frequency_hz, noisy)

    return record
