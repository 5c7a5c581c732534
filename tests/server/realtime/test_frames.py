"""Frames carry displacement and force without adding energy."""

from __future__ import annotations

import math

import numpy as np
from scipy.spatial.transform import Rotation

from palpate_server.realtime import frames


def test_the_identity_changes_no_bit() -> None:
    position = np.array([0.1, -1 / 3, 1e-17])
    displacement, force = np.empty(3), np.empty(3)
    frames.to_model(np.eye(3), 1.0, np.zeros(3), position, displacement)
    np.testing.assert_array_equal(displacement, position)
    frames.to_device(np.eye(3), 1.0, position, force)
    np.testing.assert_array_equal(force, position)


def test_power_is_the_same_on_both_sides() -> None:
    random = np.random.default_rng(0)
    for _ in range(20):
        rotation = Rotation.random(random_state=random).as_matrix()
        scale, home = float(random.uniform(0.1, 10)), random.normal(size=3)
        before, after, model_force = random.normal(size=(3, 3))
        model_before, model_after, force = np.empty((3, 3))
        frames.to_model(rotation, scale, home, before, model_before)
        frames.to_model(rotation, scale, home, after, model_after)
        frames.to_device(rotation, scale, model_force, force)
        assert math.isclose(
            force @ (after - before), model_force @ (model_after - model_before), rel_tol=1e-9
        )
