"""Frames of clients: what is refused, and where a tool's home is."""

from __future__ import annotations

import numpy as np
import pytest

from palpate_client import Frame
from palpate_client.wire import MalformedMessage
from palpate_server.errors import Refused
from palpate_server.session.fields import frame_in


def test_what_is_missing_or_none_is_that_of_the_identity() -> None:
    for frame in (None, {}, {"rotation": None, "scale": None}):
        assert frame_in({"frame": frame}) == frame_in({}) == Frame()
    assert frame_in({"frame": {"scale": 2, "client_origin_m": [1, 2, 3]}}) == Frame(
        scale=2.0, client_origin_m=(1.0, 2.0, 3.0)
    )


@pytest.mark.parametrize(
    ("frame", "reason"),
    [
        ([1], "wrong_type"),
        ({"origin_m": [0, 0, 0]}, "wrong_type"),
        ({1: 2}, "wrong_type"),
        ({"rotation": [[1, 0, 0], [0, 1, 0]]}, "wrong_type"),
        ({"rotation": [[1, 0, 0], [0, 1, 0], [0, 0, True]]}, "wrong_type"),
        ({"rotation": [[1, 0, 0], [0, 1, 0], [0, 0, 2]]}, "out_of_range"),
        ({"rotation": [[1e300, 0, 0], [0, 1, 0], [0, 0, 1]]}, "out_of_range"),
        ({"rotation": [[1, 0, 0], [0, 1, 0], [0, 0, -1]]}, "out_of_range"),
        ({"scale": "2"}, "wrong_type"),
        ({"scale": 0}, "out_of_range"),
        ({"scale": 2**64 - 1}, "out_of_range"),
        ({"client_origin_m": [0, 0]}, "wrong_type"),
        ({"client_origin_m": [0, 0, float("nan")]}, "out_of_range"),
        ({"client_origin_m": [0, 0, 10.1]}, "out_of_range"),
        ({"model_origin_m": [0, 0, -10.1]}, "out_of_range"),
    ],
)
def test_what_can_be_no_frame_is_named(frame: object, reason: str) -> None:
    with pytest.raises((MalformedMessage, Refused), match=r"frame .*expected") as caught:
        frame_in({"frame": frame})
    assert caught.value.reason == reason


def test_a_home_is_where_the_frame_maps_to_the_start() -> None:
    angle = 0.3
    c, s = np.cos(angle), np.sin(angle)
    frame = Frame(((c, -s, 0.0), (s, c, 0.0), (0.0, 0.0, 1.0)), 3.0, (0.1, 0.2, 0.3), (0.01, 0.0, 0.05))
    start = np.array([0.03, -0.01, 0.04])
    home = np.array(frame.point_at_client(start))
    in_model = frame.model_origin_m + 3.0 * np.array(frame.rotation) @ (home - frame.client_origin_m)
    np.testing.assert_allclose(in_model, start, rtol=0, atol=1e-15)


def test_the_home_in_the_identity_frame_is_the_start_to_the_last_bit() -> None:
    assert Frame().point_at_client((0.1, -0.7, 1e-3)) == (0.1, -0.7, 1e-3)


def test_a_bridge_that_names_both_origins_has_its_home_at_its_own_to_the_last_bit() -> None:
    start = (0.1, -0.7, 1e-3)
    frame = Frame(scale=3.0, client_origin_m=(0.02, 0.0, -0.3), model_origin_m=start)
    assert frame.point_at_client(start) == (0.02, 0.0, -0.3)
