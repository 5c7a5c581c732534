"""From a creep compliance to the relaxation modulus of the same tissue, exactly."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq

from palpate.fitting.branches import Branches

Array = NDArray[np.float64]


def relaxation_of(creep: Branches) -> Branches:
    """The modulus E + sum_j E_j s tau_j / (1 + s tau_j) = 1 / J(s), with J(s) = J_0 + sum_k J_k / (1 + s lambda_k).

    All E_j are positive, and each tau_j lies below its lambda_k and above the next shorter one: poles and zeros of a
    passive compliance alternate (N. W. Tschoegl, The Phenomenological Theory of Linear Viscoelastic Behavior, 1989).
    """
    instant, parts, times = creep.amplitudes[0], creep.amplitudes[1:], creep.times
    rates = 1 / times  # falling

    # With s = -r, each zero of J lies between a rate and the next faster one; the fastest has a bound of its own.
    def compliance(r: float) -> float:
        return float(instant + np.sum(parts * rates / (rates - r)))

    fastest = rates[:1] * (1 + 2 * np.sum(parts) / instant)
    zeros = []
    for slow, fast in zip(rates, [*fastest, *rates[:-1]], strict=True):
        gap = fast - slow
        zeros.append(
            brentq(compliance, slow + 1e-12 * gap, fast - 1e-12 * gap, xtol=1e-15 * fast, rtol=1e-14)
        )
    found = np.array(zeros)
    # The residue of 1 / J at s = -r is 1 / J'(s); that of E_j s tau_j / (1 + s tau_j) is -E_j r.
    slopes = np.array([-np.sum(parts * rates / (rates - r) ** 2) for r in found])
    return Branches(np.concatenate([[1 / (instant + np.sum(parts))], -1 / (slopes * found)]), 1 / found)
