"""What a record can't tell is refused, with the data that are missing."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from palpate.fitting.records import ModulusRecord, TimeRecord
from palpate.fitting.tissue import NotIdentifiable, fit_tissue

Make = Callable[..., TimeRecord]

LIVER_CREEP = (5400.0, (0.5, 0.3), (1.86, 51.3))


@pytest.mark.parametrize("seed", range(3))
def test_a_hold_of_10_s_says_nothing_on_51_s(relaxation: Make, seed: int) -> None:
    time_s = np.arange(0, 10.5, 0.01)
    with pytest.raises(
        NotIdentifiable,
        match=r"a hold of 9\.99 s does not determine a time constant above 5 s.* Missing: a hold of at least \d+ s",
    ):
        fit_tissue([relaxation(LIVER_CREEP, time_s, seed=seed)])


def test_the_hold_that_was_missing_is_enough(relaxation: Make) -> None:
    tissue = fit_tissue([relaxation(LIVER_CREEP, np.arange(0, 160.5, 0.1))])
    assert tissue.branches[1].tau_s.low < 51.3 < tissue.branches[1].tau_s.high


def test_on_request_the_rest_is_given_and_what_is_unknown_is_said(relaxation: Make) -> None:
    tissue = fit_tissue([relaxation(LIVER_CREEP, np.arange(0, 10.5, 0.01))], partial=True)
    assert len(tissue.missing) == 1
    assert "its stiffness at rest isn't known" in tissue.missing[0]


@pytest.mark.parametrize("seed", range(3))
def test_a_time_constant_below_the_ramp_time_is_refused(relaxation: Make, seed: int) -> None:
    record = relaxation((5400.0, (0.5, 1.5), (2.0, 0.1)), np.arange(0, 20.5, 0.01), seed=seed)
    with pytest.raises(
        NotIdentifiable,
        match=r"a ramp of 0\.5 s does not determine a time constant below 0\.5 s.* Missing: a ramp of",
    ):
        fit_tissue([record])


def test_slow_data_say_nothing_on_the_haptic_band(relaxation: Make) -> None:
    tissue = fit_tissue([relaxation((5400.0, (0.5,), (2.0,)), np.arange(0, 20.5, 0.02))])
    assert [loss.value for loss in tissue.loss_tangent] == [None, None, None]


def test_a_fast_ramp_tells_the_haptic_band_up_to_its_own_frequency(relaxation: Make) -> None:
    """A ramp of 10 ms reaches 1 / (2 pi 10 ms) = 16 Hz."""
    time_s = np.concatenate([np.arange(0, 0.5, 0.001), np.arange(0.5, 20, 0.02)])
    tissue = fit_tissue([relaxation((5400.0, (0.5, 0.5), (2.0, 0.02)), time_s, ramp_s=0.01)])
    assert [loss.value is None for loss in tissue.loss_tangent] == [False, False, True]


def test_high_frequencies_alone_say_nothing_on_rest(
    complex_modulus_record: Callable[..., ModulusRecord],
) -> None:
    f = np.geomspace(1, 60, 30)
    iw = 2j * np.pi * f
    modulus = 1000 * (1 + 0.5 * iw * 0.01 / (1 + iw * 0.01) + 0.5 * iw / (1 + iw))
    with pytest.raises(NotIdentifiable, match="Missing: the complex modulus down to"):
        fit_tissue([complex_modulus_record(modulus, f)])


def test_an_elastic_body_has_no_branch(relaxation: Make) -> None:
    tissue = fit_tissue([relaxation((5400.0, (), ()), np.arange(0, 20.5, 0.02))])
    assert tissue.branches == ()
    assert tissue.modulus_pa.low < 5400 < tissue.modulus_pa.high
    assert "no relaxation is seen above the noise" in tissue.notes[0]


def test_filtered_noise_widens_the_intervals(relaxation: Make) -> None:
    """Noise averaged over 8 neighbors looks 8 times as certain as it is, to one who takes the rows as independent."""
    from dataclasses import replace

    clean = relaxation((5400.0, (0.5,), (2.0,)), np.arange(0, 20.5, 0.02), noise=0.0)
    white = 0.02 * clean.response.values.max() * np.random.default_rng(0).standard_normal(len(clean.time_s))
    filtered = np.convolve(white, np.ones(8) / 8, mode="same")

    def noisy(noise: np.ndarray) -> TimeRecord:  # type: ignore[type-arg]
        return replace(clean, response=replace(clean.response, values=clean.response.values + noise))

    alike = fit_tissue([noisy(filtered)])
    shuffled = fit_tissue([noisy(np.random.default_rng(1).permutation(filtered))])
    assert np.log(alike.modulus_pa.factor) > 2 * np.log(shuffled.modulus_pa.factor)
    assert any("neighboring residuals are alike" in note for note in alike.notes)
    assert not shuffled.notes
