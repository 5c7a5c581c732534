"""From a client's frame to the model's, against the client library's way back."""

from __future__ import annotations

import math

import numpy as np
import pytest

from palpate_client import Force, Frame
from palpate_client.messages import NO_TOUCH
from palpate_view.frames import force_in_model, point_in_model, tool_state

TURN = ((0.0, 0.0, 1.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0))
FRAME = Frame(TURN, 2.0, (0.01, 0.0, -0.02), (0.1, 0.2, 0.3))


def force(position: tuple[float, ...], force_n: tuple[float, ...], stored_j: float = 0.0) -> Force:
    touch = NO_TOUCH._replace(stored_j=stored_j)
    return Force(1, 0, 1, 0, 0, 0, position, force_n, 1.0, 0.0, 0, touch)


def test_a_point_comes_back() -> None:
    point = (0.3, -0.2, 0.15)
    np.testing.assert_allclose(
        point_in_model(FRAME.message(), FRAME.point_at_client(point)), point, atol=1e-15
    )


def test_power_is_the_same_on_both_sides() -> None:
    step, at_client = np.array([1e-3, 2e-3, -1e-3]), np.array([0.5, -0.25, 1.0])
    before, after = (point_in_model(FRAME.message(), p) for p in (np.zeros(3), step))
    assert force_in_model(FRAME.message(), at_client) @ (after - before) == pytest.approx(at_client @ step)


def test_the_sphere_hangs_on_its_spring() -> None:
    # Pushed out of the tissue along z with 1.4 N at 700 N/m: the sphere is 2 mm outside of the device.
    tool, stored_j = {"frame": Frame().message(), "stiffness_n_per_m": 700.0}, 0.5 * 1.4**2 / 700
    state = tool_state(force((0.0, 0.0, -0.002), (0.0, 0.0, 1.4), stored_j), tool)
    np.testing.assert_allclose(state.device_m, [0.0, 0.0, -0.002])
    np.testing.assert_allclose(state.tip_m, np.zeros(3), atol=1e-15)
    limited = tool_state(force((0.0, 0.0, -0.002), (0.0, 0.0, 0.7), stored_j), tool)
    np.testing.assert_allclose(limited.tip_m, np.zeros(3), atol=1e-15)


def test_the_spring_is_scaled_with_the_frame() -> None:
    # At the client the spring is 1 mm long; one meter there is two in the model.
    state = tool_state(
        force((0.01, 0.0, -0.02), (0.0, 0.7, 0.0), 0.5 * 0.7**2 / 700),
        {"frame": FRAME.message(), "stiffness_n_per_m": 700.0},
    )
    np.testing.assert_allclose(state.tip_m - state.device_m, 0.002 * np.asarray(TURN) @ [0.0, 1.0, 0.0])
    assert math.isclose(float(np.linalg.norm(state.force_n)), 0.35)


def test_the_tip_of_a_patch_is_where_the_device_is() -> None:
    state = tool_state(
        force((0.0, 0.0, -0.002), (0.0, 0.0, 1.0)), {"frame": Frame().message(), "stiffness_n_per_m": None}
    )
    np.testing.assert_array_equal(state.tip_m, state.device_m)
