"""From the continuous model to the one that steps once a period, by the trapezoidal rule or an exact first-order hold.

Both answer a displacement with the force at the same sample. They differ in what they take the motion between samples
to be. The first-order hold draws straight lines: exact for those, but a sampled smooth motion then has images around
every multiple of the sampling rate, which a stiff contact answers with its instant stiffness, and the kinks make the
sampled model give out energy that the tissue never had. The trapezoidal (bilinear) rule evaluates F at
s = 2/T (z - 1)/(z + 1): nothing above half the sampling rate exists for it, and what absorbs energy goes on absorbing
it. It has two weaknesses, and each pole is treated for them:

- It shifts frequencies by (omega T)²/12, 0.3 % at 30 Hz and 1 kHz, which sharp resonances do not forgive. Poles in and
  near the haptic band are prewarped, so that they fall where they belong.
- It maps poles much faster than the sampling rate next to z = -1: after a jump a light or stiff body alternates at half
  the sampling rate for seconds. So each pole gets the rule s = (1 + theta)/T (z - 1)/(z + theta) with the largest
  theta <= 1 that lets it decay as fast as in continuous time, and beyond half the sampling rate by a factor of at least
  0.8 a sample. The rule maps |z| >= 1 into Re s >= 0 for every theta in 0..1, as the trapezoidal rule (theta = 1) does.

Measured on configs/liver-coarse.toml at 1 kHz (61 N/m at rest, 4.1 kN/m instantly), largest force error in 0-30 Hz: the
unreduced model 6.2 % by the hold, 0.76 % by the plain trapezoidal rule; order 120 (0.62 % before sampling) 5.3 and 0.75 %.
`docs/validation.md` has all figures. By the trapezoidal rule the unreduced model is passive up to half the sampling rate,
by the hold up to 298 Hz.
Tustin 1947; Franklin, Powell & Workman 1998, sections 6.1 and 6.3.2; Liniger & Willoughby 1970 for theta.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from palpate.lti.pole_residue import PoleResidueSystem, first_order_hold

SamplingRule = Literal["bilinear", "first-order-hold"]
SAMPLING_RULES: tuple[str, ...] = get_args(SamplingRule)

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

_NEAR_BAND = 1.5
"""Poles up to this many times the band's upper end are prewarped: further out a shift matters less than the residue's."""

_FASTEST_DECAY = 0.8
"""Factor a sample beyond half the sampling rate: a ringing there is gone within 0.05 s at 1 kHz (0.8^50 = 1e-5)."""


def sample(
    system: PoleResidueSystem, period_s: float, rule: SamplingRule, band_hz: float = 0.0
) -> PoleResidueSystem:
    """The system sampled at period_s; its poles are those of z.

    band_hz  upper end of the band in which the trapezoidal rule is to be true to frequency, Hz; 0: nowhere

    Either rule steps x+ = Phi x + B0 u + B1 u+, y = C x + D u; with xi = x - B1 u the newest sample is enough:
    y = C xi + (D + C B1) u, then xi+ = Phi xi + (B0 + Phi B1) u, the running form of `palpate.model_file.StateSpace`.

    Raises ValueError for a period that is not above 0 or an unknown rule.
    """
    if not (np.isfinite(period_s) and period_s > 0):
        raise ValueError(f"period_s = {period_s}: expected a finite number above 0")
    if rule not in SAMPLING_RULES:
        raise ValueError(f"rule = {rule!r}: expected one of {', '.join(SAMPLING_RULES)}")
    if rule == "bilinear":
        own_decay = np.exp(system.poles.real * period_s)
        system = _prewarped(system, period_s, 2 * np.pi * _NEAR_BAND * band_hz)
        decay, old, new = damped_trapezoidal_rule(system.poles * period_s, own_decay)
    else:
        decay, old, new = first_order_hold(system.poles * period_s)
    b_new = (period_s * new)[:, None] * system.b
    b = (period_s * old)[:, None] * system.b + decay[:, None] * b_new
    weight = np.where(system.is_pair, 2.0, 1.0)
    d = system.d + np.real((weight * system.c) @ b_new)
    down = decay.imag < 0
    return PoleResidueSystem(
        np.where(down, decay.conj(), decay),
        np.where(down[:, None], b.conj(), b),
        np.where(down, system.c.conj(), system.c),
        d,
        system.group,
    )


def damped_trapezoidal_rule(z: Complex, own_decay: Array) -> tuple[Complex, Complex, Complex]:
    """(decay, old, new) for z = p T, each (n,): weights as in `first_order_hold`, with the theta of `damping`."""
    theta = damping(z, own_decay)
    new = 1 / (1 + theta - z)
    return (1 + theta + theta * z) * new, theta * new, new


def damping(z: Complex, own_decay: Array) -> Array:
    """(n,): the largest theta in 0..1 with |(1 + theta + theta z) / (1 + theta - z)| <= limit, for z = p T, Re z < 0.

    own_decay  (n,), factor a sample by which the continuous pole decays

    The limit is own_decay or 0.8, whichever is larger, and 0.8 where |z| > pi. theta is 1 where the trapezoidal rule keeps
    to it, else, with E = limit², the root of
    (|1 + z|² - E) theta² + 2 (1 + Re z - E (1 - Re z)) theta + 1 - E |1 - z|² = 0.
    """
    limit2 = np.where(np.abs(z) > np.pi, _FASTEST_DECAY, np.maximum(own_decay, _FASTEST_DECAY)) ** 2
    a = np.abs(1 + z) ** 2 - limit2
    half_b = 1 + z.real - limit2 * (1 - z.real)
    c = 1 - limit2 * np.abs(1 - z) ** 2
    # theta = 1 is beyond the limit (by more than round-off) and theta = 0 within it: one root lies between.
    too_slow = (a + 2 * half_b + c > 1e-12) & (c < 0)
    root = np.sqrt(np.where(too_slow, half_b**2 - a * c, 0.0))
    # Of the two forms of the root the one without cancellation.
    numerator = np.where(half_b > 0, -c, root - half_b)
    denominator = np.where(half_b > 0, half_b + root, a)
    return np.where(too_slow, numerator / np.where(too_slow, denominator, 1.0), 1.0)


@dataclass(frozen=True)
class Sampling:
    """How a model will be sampled.

    band_hz  (low, high) of the haptic band: the trapezoidal rule is true to frequency there
    """

    period_s: float
    rule: SamplingRule = "bilinear"
    band_hz: tuple[float, float] = (0.0, 30.0)

    def sample(self, system: PoleResidueSystem) -> PoleResidueSystem:
        """The system sampled, see `sample`."""
        return sample(system, self.period_s, self.rule, self.band_hz[1])

    def response(self, system: PoleResidueSystem, omega: Array) -> Complex:
        """(n, n_outputs, n_inputs): of the system, once sampled, to sines of omega (n,), rad/s, below pi/period_s."""
        return self.sample(system).transfer(np.exp(1j * omega * self.period_s))


def _prewarped(system: PoleResidueSystem, period_s: float, limit: float) -> PoleResidueSystem:
    """Poles of modulus up to `limit`, rad/s, moved to g(p) = 2/T tanh(p T/2), which the trapezoidal rule maps to e^{pT}.

    Residues go by g'(p), so that r/(s - p) stays itself near s = p once s is warped too, and D keeps the statics.
    """
    moved = np.abs(system.poles) <= limit
    tangent = np.tanh(np.where(moved, system.poles, 0) * period_s / 2)
    poles = np.where(moved, 2 / period_s * tangent, system.poles)
    gain = np.sqrt(1 - tangent**2)
    b, c = gain[:, None] * system.b, gain * system.c
    weight = np.where(system.is_pair, 2.0, 1.0)
    lost = np.real((weight * c / poles) @ b) - np.real((weight * system.c / system.poles) @ system.b)
    return PoleResidueSystem(poles, b, c, system.d + lost, system.group)
