"""The model of a record against other solvers of the same equations."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from palpate.fitting.branches import Branches
from palpate.fitting.conversion import relaxation_of
from palpate.fitting.equations import low_passed
from palpate.fitting.tissue import complex_modulus


@pytest.mark.parametrize("tau_s", [1e-3, 0.3, 50.0])
def test_the_low_pass_of_any_history_is_that_of_an_ode_solver(tau_s: float) -> None:
    rng = np.random.default_rng(0)
    time_s = np.cumsum(rng.uniform(1e-3, 0.2, 10))
    drive = rng.uniform(-1, 1, 10)
    found = low_passed(time_s, drive, np.array([tau_s]))[:, 0]
    value = 0.0
    for k in range(9):  # each straight piece on its own: the solver must not step over a corner
        done = solve_ivp(
            lambda t, x: (np.interp(t, time_s, drive) - x) / tau_s,
            time_s[k : k + 2],
            [value],
            method="Radau",
            rtol=1e-9,
            atol=1e-11,
        )
        value = float(done.y[0, -1])
        assert found[k + 1] == pytest.approx(value, abs=1e-7)


positive = st.floats(0.01, 100)


@given(
    instant=positive,
    parts=st.lists(
        st.tuples(positive, st.floats(-3, 3)), max_size=6, unique_by=lambda part: round(part[1], 1)
    ),
)
def test_modulus_times_compliance_is_one_at_every_frequency(
    instant: float, parts: list[tuple[float, float]]
) -> None:
    parts = sorted(parts, key=lambda part: part[1])
    strengths, times = np.array([p[0] for p in parts]), 10 ** np.array([p[1] for p in parts])
    relaxing = relaxation_of(Branches(np.array([instant, *strengths]), times))
    f = np.geomspace(1e-5, 1e5, 41)
    compliance = instant + sum(a / (1 + 2j * np.pi * f * t) for a, t in zip(strengths, times, strict=True))
    assert np.max(np.abs(complex_modulus(relaxing, f) * compliance - 1)) < 1e-9
    assert np.all(relaxing.amplitudes > 0)
    both = sorted([(t, "relaxing") for t in relaxing.times] + [(t, "creeping") for t in times])
    assert all(a[1] != b[1] for a, b in pairwise(both))


def test_the_zener_body_by_hand() -> None:
    """J_0 = 1, J_1 = 3, lambda = 2 s: E = 1/4, gamma = 3, tau = lambda J_0 / (J_0 + J_1)."""
    relaxing = relaxation_of(Branches(np.array([1.0, 3.0]), np.array([2.0])))
    assert relaxing.amplitudes == pytest.approx([0.25, 0.75])
    assert relaxing.times == pytest.approx([0.5])
