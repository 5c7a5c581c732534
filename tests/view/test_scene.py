"""Where the camera, the shaft and the arrow are."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from palpate_view.scene import arrow, camera_position, rotation_to


@pytest.mark.parametrize("axis", [(0, 0, 1), (0, 0, -1), (1, 0, 0), (0.6, -0.64, 0.48)])
def test_the_shaft_turns_to_its_axis(axis: tuple[float, float, float]) -> None:
    turned = Rotation.from_quat(rotation_to(np.array(axis, float)), scalar_first=True).apply([0.0, 0.0, 1.0])
    np.testing.assert_allclose(turned, axis, atol=1e-12)


def test_the_arrow_grows_with_the_force_up_to_a_bound() -> None:
    size = 0.1
    one, two, many = (np.linalg.norm(arrow(np.array([0.0, f, 0.0]), size)) for f in (1.0, 2.0, 100.0))
    assert two == pytest.approx(2 * one) and many == pytest.approx(0.9 * size)


@pytest.mark.parametrize("normal", [(0, 0, 1), (0, 0, -1), (0, -1, 0), (0.8, 0.6, 0)])
@pytest.mark.parametrize("aspect", [0.5, 1.0, 1.8])
def test_the_organ_is_in_the_picture_and_the_tool_before_it(
    normal: tuple[float, float, float], aspect: float
) -> None:
    center, size, fov = np.array([0.1, 0.0, -0.05]), 0.12, math.radians(60)
    away = camera_position(center, size, np.array(normal, float), aspect, fov) - center
    half = math.atan(math.tan(fov / 2) * min(1.0, aspect))
    assert np.linalg.norm(away) * math.sin(half) >= size / 2  # the ball around the organ fits
    assert away[2] > 0
    if normal[2] == 0:
        assert away @ normal > 0
