"""Measuring a reduced model, continuous and discrete, against the full one."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from palpate.lti.block_form import to_block_form
from palpate.lti.errors import ReductionError
from palpate.lti.frequencies import (
    all_frequencies,
    band_frequencies,
    maximum,
    relative_errors,
    smoothed_response,
    spectral_norms,
)
from palpate.lti.pole_residue import PoleResidueSystem
from palpate.lti.stepping import step_through
from palpate.model_file import AccuracyReport
from palpate.model_file.advice import what_to_change
from palpate.reduction.methods import Reduction
from palpate.reduction.passivity import largest_energy_out, passive_up_to, passivity_margin

Array = NDArray[np.float64]

_MEANINGLESS_ERROR = 100.0
"""A relative error above this is round-off, not a reduction: the build is refused."""

_POKE_AMPLITUDE_M = 1e-3

_SETTLED_S = 0.2
"""When the force after a jump is compared: about a hand's reaction time later."""


def measure(
    full: PoleResidueSystem,
    reduction: Reduction,
    running: PoleResidueSystem,
    *,
    period_s: float,
    band_hz: tuple[float, float],
    error_surface_in_band: float,
    resolved_frequency_hz: float,
    change_over_last_vectors: float = 0.0,
) -> AccuracyReport:
    """The accuracy report that goes with a model; `palpate.model_file.AccuracyReport` defines each figure.

    running  the reduced system sampled at period_s
    The surface error, the resolved frequency and the change over the last vectors are passed on.
    """
    errors, largest = _hinf(full, reduction.system)
    in_band = band_frequencies((full, reduction.system), band_hz)
    zero = np.zeros(1, dtype=np.complex128)
    bound = reduction.error_bound

    def error_once_sampled(omega: Array) -> Array:
        return relative_errors(full.transfer(1j * omega), running.transfer(np.exp(1j * omega * period_s)))

    return AccuracyReport(
        error_in_band=maximum(error_once_sampled, in_band)[1],
        error_in_band_continuous=in_band_error(full, reduction.system, in_band),
        error_static=float(relative_errors(full.transfer(zero), reduction.system.transfer(zero))[0]),
        error_hinf=errors / largest,
        error_bound=None if bound is None else bound / largest,
        error_step=step_error(full, running, period_s),
        error_time_domain=time_domain_error(full, running, poke(full.n_inputs, period_s, band_hz), period_s),
        error_surface_in_band=error_surface_in_band,
        gain_above_band=gain_above_band(full, running, period_s, band_hz[1]),
        change_over_last_vectors=change_over_last_vectors,
        spectral_abscissa=reduction.system.spectral_abscissa,
        spectral_abscissa_full=full.spectral_abscissa,
        passivity_margin=passivity_margin(running),
        passive_up_to_hz=passive_up_to(running) / (2 * np.pi * period_s),
        largest_energy_out_j=largest_energy_out(running, _POKE_AMPLITUDE_M),
        resolved_frequency_hz=resolved_frequency_hz,
        band_hz=band_hz,
        hankel_singular_values=reduction.hankel_singular_values,
    )


def in_band_error(full: PoleResidueSystem, reduced: PoleResidueSystem, omega: Array) -> float:
    """Largest |F - F_reduced| / |F| over the frequencies omega, rad/s, refined around its peaks."""

    def error(w: Array) -> Array:
        return relative_errors(full.transfer(1j * w), reduced.transfer(1j * w))

    return maximum(error, omega)[1]


def gain_above_band(
    full: PoleResidueSystem, running: PoleResidueSystem, period_s: float, band_end_hz: float
) -> float:
    """Largest |F_running| / |F| from the band's end to half the sampling rate, F by `smoothed_response`.

    The trapezoidal rule alone makes it more than 1 where the force rises with frequency: it shifts frequencies down.
    """
    start, end = 2 * np.pi * band_end_hz, np.pi / period_s
    resonances = np.angle(running.poles[running.is_pair]) / period_s
    omega = np.concatenate([np.linspace(start, end, 800), np.geomspace(start, end, 400), resonances])
    omega = np.unique(omega[(omega >= start) & (omega <= end)])

    def gain(w: Array) -> Array:
        return spectral_norms(running.transfer(np.exp(1j * w * period_s))) / spectral_norms(
            smoothed_response(full, w, start)
        )

    return maximum(gain, omega)[1]


def hinf_error(full: PoleResidueSystem, reduced: PoleResidueSystem) -> float:
    """Largest |F - F_reduced| over all frequencies over the largest |F|, by adaptive sampling, infinity included."""
    error, largest = _hinf(full, reduced)
    return error / largest


def _hinf(full: PoleResidueSystem, reduced: PoleResidueSystem) -> tuple[float, float]:
    """(max |F - F_reduced|, max |F|) over all frequencies."""
    omega = all_frequencies((full, reduced))

    def error(w: Array) -> Array:
        return spectral_norms(full.transfer(1j * w) - reduced.transfer(1j * w))

    def gain(w: Array) -> Array:
        return spectral_norms(full.transfer(1j * w))

    at_infinity = float(np.linalg.norm(full.d - reduced.d, 2)), float(np.linalg.norm(full.d, 2))
    return max(maximum(error, omega)[1], at_infinity[0]), max(maximum(gain, omega)[1], at_infinity[1])


def poke(n_inputs: int, period_s: float, band_hz: tuple[float, float]) -> Array:
    """(n_samples, n_inputs), m, over 5 s: every channel pressed 1 mm, held with a small vibration, and released.

    The press and the release take 0.5 s, twice differentiable; the vibration is a twentieth of the press, at 5 Hz and
    up by channel or in the middle of the band where that is lower. Channels start 0.1 s after each other.
    """
    times = np.asarray(period_s * np.arange(round(5.0 / period_s) + 1), dtype=np.float64)
    samples = np.empty((len(times), n_inputs))
    for channel in range(n_inputs):
        start = 0.2 + 0.1 * (channel % 6)
        envelope = _smooth_step((times - start) / 0.5) - _smooth_step((times - start - 2.5) / 0.5)
        middle = (band_hz[0] + band_hz[1]) / 2
        frequency = min(middle, 5.0 + 2.0 * (channel % 3))
        samples[:, channel] = envelope * (1 + 0.05 * np.sin(2 * np.pi * frequency * (times - start)))
    return 1e-3 * samples


def time_domain_error(
    full: PoleResidueSystem, running: PoleResidueSystem, inputs: Array, period_s: float
) -> float:
    """Largest force error over the largest force: the running model, stepped, against the full exact response."""
    exact = full.response(inputs, period_s)
    stepped, _ = step_through(to_block_form(running), inputs)
    error = np.linalg.norm(stepped - exact, axis=1)
    return float(np.max(error) / np.max(np.linalg.norm(exact, axis=1)))


def step_error(full: PoleResidueSystem, running: PoleResidueSystem, period_s: float) -> float:
    """Largest |F_running - F| over |F(0)| after a jump of the tip, over 1,000 samples from 0.2 s on (2-norms).

    F is the exact step response of the full model's poles within half the sampling rate and the static response of those
    beyond: no sample can follow them, so what the running model makes of them has to be gone.
    """
    samples = np.ceil(_SETTLED_S / period_s) + np.arange(1000)
    slow = full.take(np.abs(full.poles) < np.pi / period_s)
    exact = slow.step_response(samples * period_s) + full.static_gain() - slow.static_gain()
    # sum_{j<k} C A^j B + D, a geometric series for each pole
    weights = np.where(running.is_pair, 2.0, 1.0) / (1 - running.poles)
    powers = 1 - running.poles ** samples[:, None]
    stepped = running.d + np.einsum("tk,kpm->tpm", powers * weights, running.residues).real
    error = float(np.max(spectral_norms(stepped - exact)))
    return error / float(spectral_norms(full.static_gain()[None])[0])


def refuse_meaningless(accuracy: AccuracyReport, method: str) -> None:
    """Raises ReductionError where the force in the band or at 0 Hz is wrong by more than 10,000 % or by no finite number.

    A poor method at a low order is wrong by some hundred per cent, and `warnings` says so; beyond a factor of 100 the
    numbers are round-off.
    """
    for error, where in ((accuracy.error_in_band, "in the band"), (accuracy.error_static, "at 0 Hz")):
        if not error <= _MEANINGLESS_ERROR:
            raise ReductionError(
                f"the reduced model's force is wrong by {100 * error:.3g} % {where}, expected at most "
                f"{100 * _MEANINGLESS_ERROR:.0f} %: {what_to_change(method)}, or check the material's constants"
            )


def _smooth_step(x: Array) -> Array:
    """0 for x <= 0, 1 for x >= 1, twice continuously differentiable: 10 x³ - 15 x⁴ + 6 x⁵."""
    t = np.clip(x, 0.0, 1.0)
    return np.asarray(t**3 * (10 - 15 * t + 6 * t**2), dtype=np.float64)
