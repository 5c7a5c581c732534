"""From a creep compliance to the relaxation modulus of the same tissue, exactly."""

from __future__ import annotations

import numpy as np

from palpate.fitting.branches import Branches


def relaxation_of(creep: Branches) -> Branches:
    """The modulus E + sum_j E_j s tau_j / (1 + s tau_j) = 1 / J(s), with J(s) = J_0 + sum_k J_k / (1 + s lambda_k).

    J is the transfer function of x' = -diag(rates) x + v stress, strain = J_0 stress + v' x, with rates 1 / lambda_k and
    v_k² = J_k / lambda_k. Solved for the stress it has the symmetric matrix diag(rates) + v v' / J_0, whose eigenvalues are
    the rates 1 / tau_j. So all E_j are positive, and the tau_j and lambda_k alternate
    (N. W. Tschoegl, The Phenomenological Theory of Linear Viscoelastic Behavior, 1989).
    """
    instant, parts = creep.amplitudes[0], creep.amplitudes[1:]
    v = np.sqrt(parts / creep.times)
    rates, vectors = np.linalg.eigh(np.diag(1 / creep.times) + np.outer(v, v) / instant)
    strengths = (v @ vectors / instant) ** 2 / rates
    order = slice(None, None, -1)  # rates rise, times fall
    at_rest = 1 / (instant + np.sum(parts))
    return Branches(np.concatenate([[at_rest], strengths[order]]), 1 / rates[order])
