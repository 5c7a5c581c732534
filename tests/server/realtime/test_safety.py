"""The safety functions as pure functions: what they promise for any finite input."""

from __future__ import annotations

import math

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from palpate_client.wire import Flags
from palpate_server.realtime import safety

coordinate = st.floats(-1e6, 1e6)
vector = st.tuples(coordinate, coordinate, coordinate).map(np.array)
positive = st.floats(1e-6, 1e3)
ROUNDING = 1e-12


@settings(deadline=None)
@given(target=vector, applied=vector, origin=vector, radius=positive, max_step=positive)
def test_the_tip_moves_no_further_than_a_step_and_ends_inside_the_workspace(
    target: NDArray[np.float64],
    applied: NDArray[np.float64],
    origin: NDArray[np.float64],
    radius: float,
    max_step: float,
) -> None:
    size = np.linalg.norm(applied)
    if size > radius:
        applied = applied * (radius / size)
    applied += origin
    before = applied.copy()
    flags = safety.follow(target, applied, origin, radius, max_step, 20 * max_step)
    rounding = ROUNDING * (radius + np.abs(origin).max())
    assert np.linalg.norm(applied - before) <= max_step * (1 + ROUNDING) + rounding
    assert np.linalg.norm(applied - origin) <= radius + rounding
    x, y, z = target - origin
    assert bool(flags & Flags.WORKSPACE_CLAMPED) == (math.sqrt(x * x + y * y + z * z) > radius)
    if not flags:
        np.testing.assert_array_equal(applied, target)
    if not flags & Flags.WORKSPACE_CLAMPED:
        way = float(np.linalg.norm(target - before))
        if abs(way - 20 * max_step) > ROUNDING * way + rounding:
            assert bool(flags & Flags.JUMPED) == (way > 20 * max_step)


@settings(deadline=None)
@given(force=vector, previous=vector, max_change=positive, max_magnitude=positive)
def test_the_force_is_bounded_in_change_and_in_magnitude(
    force: NDArray[np.float64], previous: NDArray[np.float64], max_change: float, max_magnitude: float
) -> None:
    size = np.linalg.norm(previous)
    if size > max_magnitude:
        previous = previous * (max_magnitude / size)
    wanted = force.copy()
    flags = safety.bound(force, previous, max_change, max_magnitude)
    largest = np.abs(wanted).max() + max_magnitude
    assert np.linalg.norm(force) <= max_magnitude * (1 + ROUNDING)
    assert np.linalg.norm(force - previous) <= max_change + ROUNDING * largest
    if not flags:
        np.testing.assert_array_equal(force, wanted)


@settings(deadline=None)
@given(force=vector, previous=vector, max_change=positive, max_magnitude=positive)
def test_a_force_above_a_lowered_limit_comes_down_at_the_allowed_rate(
    force: NDArray[np.float64], previous: NDArray[np.float64], max_change: float, max_magnitude: float
) -> None:
    rounding = ROUNDING * (np.abs(force).max() + np.abs(previous).max() + max_magnitude)
    before = np.linalg.norm(previous)
    safety.bound(force, previous, max_change, max_magnitude)
    assert np.linalg.norm(force - previous) <= max_change + rounding
    assert np.linalg.norm(force) <= max(max_magnitude, before - max_change) + rounding


def test_a_lowered_limit_of_the_force_is_no_step() -> None:
    force = np.array([0.0, 0.0, 10.0])
    forces = [10.0]
    for _ in range(10):
        previous, force = force, np.array([0.0, 0.0, 10.0])
        safety.bound(force, previous, 2.0, 0.05)
        forces.append(float(force[2]))
    np.testing.assert_allclose(forces, [10.0, 8.0, 6.0, 4.0, 2.0, *[0.05] * 6], rtol=1e-12)


def test_a_silent_client_is_faded_out_linearly_and_faded_in_again_more_slowly() -> None:
    period_ns = 1_000_000
    scale, scales = 1.0, []
    while scale > 0:
        scale = safety.fade(scale, False, period_ns)
        scales.append(scale)
    assert len(scales) * period_ns in (safety.DECAY_NS, safety.DECAY_NS + period_ns)  # rounding of the sum
    np.testing.assert_allclose(np.diff(scales[:-1]), -period_ns / safety.DECAY_NS)
    ticks = 0
    while scale < 1:
        scale = safety.fade(scale, True, period_ns)
        ticks += 1
    assert ticks * period_ns in (safety.SOFT_START_NS, safety.SOFT_START_NS + period_ns)


def test_hold_and_decay_together_leave_room_below_a_tenth_of_a_second() -> None:
    assert safety.HOLD_NS == 20_000_000
    assert safety.HOLD_NS + safety.DECAY_NS < 100_000_000


@settings(deadline=None)
@given(target=vector, velocity=vector, age_ns=st.integers(0, 10**9))
def test_a_command_is_carried_on_with_its_velocity_for_a_bounded_time(
    target: NDArray[np.float64], velocity: NDArray[np.float64], age_ns: int
) -> None:
    position = np.empty(3)
    safety.reconstruct(target, velocity, age_ns, position)
    seconds = min(age_ns, safety.EXTRAPOLATE_NS) * 1e-9
    np.testing.assert_allclose(position, target + velocity * seconds, rtol=1e-12, atol=1e-9)


def test_a_passive_spring_is_left_alone_and_its_energy_is_counted_exactly() -> None:
    stiffness, period = 100.0, 1e-3
    energy, position, rendered = 0.0, 0.0, np.zeros(3)
    for depth in np.linspace(0, 0.01, 200)[1:]:
        step = np.array([0.0, 0.0, depth - position])
        force = np.array([0.0, 0.0, -stiffness * depth])  # on the device
        energy, flags = safety.keep_passive(energy, rendered, step, force, 1.0, period)
        assert flags == 0
        np.testing.assert_array_equal(force, [0.0, 0.0, -stiffness * depth])
        rendered, position = force, depth
    # A held force lags by a step: the sum is the integral of the spring less half a step of the final force.
    step_m = 0.01 / 199
    expected = 0.5 * stiffness * 0.01**2 - 0.5 * stiffness * 0.01 * step_m
    assert math.isclose(energy, expected, rel_tol=1e-9)


def test_energy_that_came_out_is_taken_back_by_a_bounded_damping() -> None:
    period, max_damping = 1e-3, 5.0
    step = np.array([1e-4, 0.0, 0.0])
    force = np.zeros(3)
    energy, flags = safety.keep_passive(-1e-9, np.zeros(3), step, force, max_damping, period)
    assert flags == Flags.PASSIVITY_LIMITED
    # The next step like this one takes back exactly what is missing.
    energy, flags = safety.keep_passive(energy, force.copy(), step, np.zeros(3), max_damping, period)
    assert math.isclose(energy, 0.0, abs_tol=1e-18)

    force = np.zeros(3)
    safety.keep_passive(-1.0, np.zeros(3), step, force, max_damping, period)
    np.testing.assert_allclose(force, -max_damping * step / period)


def test_without_allowed_damping_passivity_is_only_observed() -> None:
    force = np.ones(3)
    energy, flags = safety.keep_passive(-1.0, np.ones(3), np.ones(3), force, 0.0, 1e-3)
    assert (energy, flags) == (-4.0, 0)
    np.testing.assert_array_equal(force, 1.0)
