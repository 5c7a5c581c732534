"""Frames: what is accepted, and that they carry displacement and force without adding energy."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from palpate_server.realtime import frames
from palpate_server.realtime.frames import IDENTITY, Frame, read_frame


def test_the_identity_changes_no_bit() -> None:
    position = np.array([0.1, -1 / 3, 1e-17])
    displacement, force = np.empty(3), np.empty(3)
    rotation, origin = np.array(IDENTITY.rotation), np.array(IDENTITY.origin_m)
    frames.to_model(rotation, IDENTITY.scale, origin, position, displacement)
    np.testing.assert_array_equal(displacement, position)
    frames.to_device(rotation, IDENTITY.scale, position, force)
    np.testing.assert_array_equal(force, position)


def test_power_is_the_same_on_both_sides() -> None:
    random = np.random.default_rng(0)
    for _ in range(20):
        rotation = Rotation.random(random_state=random).as_matrix()
        scale, origin = float(random.uniform(0.1, 10)), random.normal(size=3)
        before, after, model_force = random.normal(size=(3, 3))
        model_before, model_after, force = np.empty((3, 3))
        frames.to_model(rotation, scale, origin, before, model_before)
        frames.to_model(rotation, scale, origin, after, model_after)
        frames.to_device(rotation, scale, model_force, force)
        assert math.isclose(
            force @ (after - before), model_force @ (model_after - model_before), rel_tol=1e-9
        )


def test_a_missing_field_is_that_of_the_identity() -> None:
    assert read_frame(None) == IDENTITY
    assert read_frame({}) == IDENTITY
    assert read_frame({"scale": 2}) == Frame(scale=2.0)


@pytest.mark.parametrize(
    ("value", "named", "error"),
    [
        ([], "frame", TypeError),
        ({"rotate": 1}, "rotate", TypeError),
        ({"scale": 0}, "scale", ValueError),
        ({"scale": math.nan}, "scale", TypeError),
        ({"scale": True}, "scale", TypeError),
        ({"scale": 1e300}, "scale", ValueError),
        ({"scale": 1e-9}, "scale", ValueError),
        ({"origin_m": [1e308, 0, 0]}, "origin_m", ValueError),
        ({"origin_m": [0, 0]}, "origin_m", TypeError),
        ({"origin_m": [0, 0, math.inf]}, "origin_m", TypeError),
        ({"rotation": [[1, 0, 0], [0, 1, 0]]}, "rotation", TypeError),
        ({"rotation": [[1, 0, 0], [0, 1, 0], [0, 0, -1]]}, "rotation", ValueError),
        ({"rotation": [[1, 0, 0], [0, 1, 0], [0, 0.1, 1]]}, "rotation", ValueError),
        ({"rotation": [[2, 0, 0], [0, 1, 0], [0, 0, 1]]}, "rotation", ValueError),
        ({"rotation": "none"}, "rotation", TypeError),
    ],
)
def test_a_frame_that_is_none_is_refused_by_the_name_of_its_field(
    value: object, named: str, error: type[Exception]
) -> None:
    with pytest.raises(error, match=named):
        read_frame(value)
