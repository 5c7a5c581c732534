"""From the pointer to the device: smoothing, and what each gesture asks for."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from palpate_view import motion
from palpate_view.motion import CLEARANCE_M, MAX_PULL_M, MAX_SPEED_M_PER_S, RATE_RAD_PER_S, Motion, follow
from palpate_view.surface import Hit

UP = np.array([0.0, 0.0, 1.0])
POINTER = np.array([0.01, 0.02, 0.05])
HIT = Hit(np.array([0.03, 0.03, 0.04]), UP)
RADIUS_M, DEPTH_M = 0.005, 0.004


def test_smoothing_is_the_solution_of_its_equation() -> None:
    start = Motion(np.array([0.01, 0.0, 0.0]), np.array([0.0, 0.02, 0.0]))
    target = np.array([0.012, 0.001, 0.0])
    w = RATE_RAD_PER_S

    def equation(_: float, state: np.ndarray) -> np.ndarray:
        return np.concatenate([state[3:], -2 * w * state[3:] - w**2 * (state[:3] - target)])

    at_rest = np.concatenate([start.position_m, start.velocity_m_per_s])
    end = solve_ivp(equation, (0, 0.03), at_rest, rtol=1e-10, atol=1e-13).y[:, -1]
    moved = start
    for _ in range(10):
        moved = follow(moved, target, 0.003)
    np.testing.assert_allclose(moved.position_m, end[:3], atol=1e-9)
    np.testing.assert_allclose(moved.velocity_m_per_s, end[3:], atol=1e-7)


def test_a_pointer_of_20_events_a_second_gives_no_step_and_no_overshoot() -> None:
    state, path = Motion(np.zeros(3), np.zeros(3)), []
    for i in range(250):
        target = np.array([min(0.02, 0.02 * (i // 12) / 10), 0.0, 0.0])  # a new event every 48 ms
        state = follow(state, target, 0.004)
        path.append(state.position_m[0])
    steps = np.diff(path)
    assert steps.min() >= -1e-12 and max(path) <= 0.02 + 1e-12
    assert steps.max() < 0.3e-3  # the events are 2 mm apart
    assert path[-1] == pytest.approx(0.02, abs=1e-5)


def test_a_far_target_is_approached_at_the_largest_speed() -> None:
    moved = follow(Motion(np.zeros(3), np.zeros(3)), np.array([1.0, 0.0, 0.0]), 0.05)
    assert moved.position_m[0] == pytest.approx(0.05 * MAX_SPEED_M_PER_S)
    assert moved.velocity_m_per_s[0] == pytest.approx(MAX_SPEED_M_PER_S)


def test_a_press_begins_outside_and_ends_at_its_depth() -> None:
    gesture = motion.press_surface(HIT, POINTER, RADIUS_M, DEPTH_M)
    assert gesture.start_m is not None
    assert gesture.start_m @ UP == pytest.approx(0.04 + RADIUS_M + CLEARANCE_M)
    assert gesture.target_m @ UP == pytest.approx(0.04 + RADIUS_M - DEPTH_M)
    assert gesture.presses and not gesture.attach


def test_a_press_follows_the_surface_under_the_pointer_and_lifts_off_beside_it() -> None:
    gesture = motion.press_surface(HIT, POINTER, RADIUS_M, DEPTH_M)
    aside = Hit(np.array([0.0, 0.03, 0.02]), np.array([-1.0, 0.0, 0.0]))
    over = motion.slid(gesture, aside, RADIUS_M, DEPTH_M)
    np.testing.assert_allclose(over.target_m, [DEPTH_M - RADIUS_M, 0.03, 0.02])
    off = motion.slid(over, None, RADIUS_M, DEPTH_M)
    np.testing.assert_allclose(off.target_m, [-(RADIUS_M + CLEARANCE_M), 0.03, 0.02])
    np.testing.assert_allclose(motion.slid(off, None, RADIUS_M, DEPTH_M).target_m, off.target_m)


def test_held_tissue_follows_the_pointer_up_to_a_bound() -> None:
    gesture = motion.grab_surface(HIT, POINTER, RADIUS_M)
    assert gesture.attach
    near = motion.moved(gesture, POINTER + np.array([0.003, 0.0, 0.004]))
    np.testing.assert_allclose(near.target_m - gesture.base_m, [0.003, 0.0, 0.004])
    far = motion.moved(near, POINTER + np.array([0.3, 0.0, 0.4]))
    np.testing.assert_allclose(far.target_m - gesture.base_m, np.array([0.6, 0.0, 0.8]) * MAX_PULL_M)


def test_a_tool_that_is_dragged_begins_at_its_home() -> None:
    home = np.array([0.0, 0.1, 0.0])
    gesture = motion.drag_tool(POINTER, UP, glued=False)
    dragged = motion.moved(gesture, POINTER + np.array([0.01, 0.0, 0.0]))  # before the tool is acquired
    np.testing.assert_allclose(motion.at_home(dragged, home).target_m, home + np.array([0.01, 0.0, 0.0]))
    np.testing.assert_allclose(
        motion.moved(motion.at_home(gesture, home), POINTER + np.array([0.0, 0.0, 0.5])).target_m,
        home + np.array([0.0, 0.0, 0.5]),
    )
    glued = motion.at_home(motion.drag_tool(POINTER, UP, glued=True), home)
    np.testing.assert_allclose(
        motion.moved(glued, POINTER + np.array([0.0, 0.0, 0.5])).target_m,
        home + np.array([0.0, 0.0, MAX_PULL_M]),
    )


def test_a_patch_is_pressed_in_and_moved_along() -> None:
    gesture = motion.press_patch(np.zeros(3), POINTER, UP, DEPTH_M)
    np.testing.assert_allclose(gesture.target_m, [0.0, 0.0, -DEPTH_M])
    np.testing.assert_allclose(
        motion.moved(gesture, POINTER + np.array([0.002, 0.0, 0.0])).target_m, [0.002, 0.0, -DEPTH_M]
    )
