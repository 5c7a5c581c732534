"""Known materials come back from noisy records, within the confidence that is stated."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
import pytest
from numpy.typing import NDArray

from palpate.fitting.confidence import Interval
from palpate.fitting.equations import low_passed
from palpate.fitting.records import ModulusRecord, Signal, TimeRecord, time_record
from palpate.fitting.tissue import NotIdentifiable, Tissue, fit_tissue

MATERIAL = (5400.0, (0.5, 0.3), (1.5, 12.0))
TIME_S = np.arange(0, 60.5, 0.05)

Make = Callable[..., TimeRecord]


def modulus_at(
    frequency_hz: NDArray[np.float64], modulus_pa: float, gamma: Sequence[float], tau_s: Sequence[float]
) -> NDArray[np.complex128]:
    iw = 2j * np.pi * frequency_hz
    return np.asarray(
        modulus_pa * (1 + sum(g * iw * t / (1 + iw * t) for g, t in zip(gamma, tau_s, strict=True)))
    )


def constants(tissue: Tissue) -> list[Interval]:
    return [tissue.modulus_pa, *(b.gamma for b in tissue.branches), *(b.tau_s for b in tissue.branches)]


def is_covered(tissue: Tissue, material: tuple, share: float = 1.0) -> bool:  # type: ignore[type-arg]
    """Whether the number of branches is right and every interval holds its constant; `share` of the interval, in logarithms."""
    modulus, gamma, tau = material
    if len(tissue.branches) != len(gamma):
        return False
    return all(
        abs(math.log(true / i.value)) <= share * math.log(i.high / i.value)
        for i, true in zip(constants(tissue), (modulus, *gamma, *tau), strict=True)
    )


def test_ten_noisy_records_recover_the_material_as_often_as_stated(relaxation: Make) -> None:
    tissues = [fit_tissue([relaxation(MATERIAL, TIME_S, seed=seed)]) for seed in range(10)]
    # Of 10 with probability 0.95, fewer than 8 have probability 0.0115.
    assert sum(is_covered(t, MATERIAL) for t in tissues) >= 8
    # Intervals that are wide enough for anything would cover, too.
    assert max(i.factor for t in tissues for i in constants(t)) < 1.15


@pytest.mark.slow
@pytest.mark.parametrize(
    ("material", "time_s"),
    [
        (MATERIAL, TIME_S),
        ((5400.0, (0.5,), (0.58,)), np.arange(0, 10.5, 0.01)),
        ((3000.0, (0.4, 0.3), (1.86, 51.3)), np.arange(0, 300.5, 0.2)),
        ((5400.0, (0.5, 0.4, 0.3), (0.6, 6.0, 60.0)), np.arange(0, 300.5, 0.2)),
    ],
)
def test_95_of_100_records_recover_the_material(
    relaxation: Make,
    material: tuple,
    time_s: np.ndarray,  # type: ignore[type-arg]
) -> None:
    tissues = [fit_tissue([relaxation(material, time_s, seed=seed)]) for seed in range(100)]
    assert sum(is_covered(t, material) for t in tissues) >= 95
    # The count can tell: a third of the intervals is too little.
    assert sum(is_covered(t, material, 1 / 3) for t in tissues) < 75


def test_without_noise_and_with_uneven_samples_the_material_comes_back_exactly(relaxation: Make) -> None:
    time_s = np.concatenate([[0.0], np.geomspace(0.01, 60, 400)])
    # The corner of the ramp must be a sample: between samples the strain is taken as straight.
    record = relaxation(MATERIAL, np.union1d(time_s, [0.5]), noise=0.0)
    tissue = fit_tissue([record])
    assert [i.value for i in constants(tissue)] == pytest.approx([5400, 0.5, 0.3, 1.5, 12.0], rel=1e-4)


def test_the_ramp_is_part_of_the_model(relaxation: Make) -> None:
    """Taken as a step at the end of the ramp, gamma would be (tau / ramp) (1 - exp(-ramp / tau)) = 0.72 of what it is."""
    slow = (5400.0, (0.5,), (7.0,))
    tissue = fit_tissue([relaxation(slow, np.arange(0, 65, 0.05), ramp_s=5.0, noise=0.001)])
    assert is_covered(tissue, slow)
    assert tissue.branches[0].gamma.factor < 1.02


def test_a_creep_test_gives_the_same_material_as_a_relaxation() -> None:
    """J_0 = 1, J_1 = 3, lambda = 2 s, per 4 kPa: E = 1 kPa, gamma = 3, tau = 0.5 s."""
    time_s = np.arange(0, 20.5, 0.02)
    stress = 50 * np.minimum(time_s / 0.5, 1)
    strain = (stress + 3 * low_passed(time_s, stress, np.array([2.0]))[:, 0]) / 4000
    strain += 0.01 * strain.max() * np.random.default_rng(0).standard_normal(len(strain))
    record = time_record("creep.csv", time_s, Signal("strain", "", strain), Signal("stress", "Pa", stress))
    assert record.test == "creep"
    tissue = fit_tissue([record])
    assert is_covered(tissue, (1000.0, (3.0,), (0.5,)))
    assert tissue.branches[0].gamma.factor < 1.05


def test_a_slow_and_a_fast_record_together_tell_what_neither_tells_alone(
    relaxation: Make, complex_modulus_record: Callable[..., ModulusRecord]
) -> None:
    material = (1000.0, (0.8, 0.5, 0.4, 0.3), (0.0037, 0.05, 0.6, 8.0))
    f = np.geomspace(0.5, 60, 20)
    exact = modulus_at(f, *material)
    slow = [relaxation(material, np.arange(0, 40, 0.04), ramp_s=0.2, seed=seed) for seed in range(4)]
    fast = [complex_modulus_record(exact, f, seed=100 + seed) for seed in range(4)]
    for alone in (slow[0], fast[0]):
        with pytest.raises(NotIdentifiable, match="Missing"):
            fit_tissue([alone])
    tissues = [fit_tissue(both) for both in zip(slow, fast, strict=True)]
    # Of 4 with probability 0.95, fewer than 3 have probability 0.014.
    assert sum(is_covered(tissue, material) for tissue in tissues) >= 3
    for loss in tissues[0].loss_tangent:
        modulus = modulus_at(np.array([loss.frequency_hz]), *material)[0]
        assert loss.value is not None
        assert loss.value.value == pytest.approx(modulus.imag / modulus.real, rel=0.1)
        assert loss.value.factor < 1.1


def test_a_power_law_tissue_comes_out_as_about_five_branches(
    complex_modulus_record: Callable[..., ModulusRecord],
) -> None:
    """A spectrum tau^-0.15 between 3.7 ms and 51 s: a loss tangent near tan(0.15 pi / 2) = 0.24."""
    x = np.linspace(math.log(3.7e-3), math.log(51), 4001)
    f = np.geomspace(1e-3, 60, 60)
    z = 2j * np.pi * f[:, None] * np.exp(x)
    modulus = 3000 * (1 + 0.5 * np.trapezoid(np.exp(-0.15 * x) * z / (1 + z), x, axis=1))
    tissue = fit_tissue([complex_modulus_record(modulus, f)])
    assert 4 <= len(tissue.branches) <= 6
    taus = [b.tau_s.value for b in tissue.branches]
    assert 0.0037 < taus[0] < taus[-1] < 100
    at_10_hz = tissue.loss_tangent[1].value
    assert at_10_hz is not None
    exact = np.interp(10, f, modulus.imag / modulus.real)
    assert at_10_hz.value == pytest.approx(exact, rel=0.05)
    assert 0.2 < exact < 0.25
