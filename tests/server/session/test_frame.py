"""Frames of clients: what is refused, and where a tool's home is."""

from __future__ import annotations

import numpy as np
import pytest

from palpate_server.session.frame import IDENTITY, ClientFrame, read_frame


def test_what_is_missing_or_none_is_that_of_the_identity() -> None:
    assert read_frame(None) == read_frame({}) == read_frame({"rotation": None, "scale": None}) == IDENTITY
    assert read_frame({"scale": 2, "client_origin_m": [1, 2, 3]}) == ClientFrame(
        scale=2.0, client_origin_m=(1.0, 2.0, 3.0)
    )


@pytest.mark.parametrize(
    ("frame", "error"),
    [
        ([1], TypeError),
        ({"origin_m": [0, 0, 0]}, TypeError),
        ({1: 2}, TypeError),
        ({"rotation": [[1, 0, 0], [0, 1, 0]]}, TypeError),
        ({"rotation": [[1, 0, 0], [0, 1, 0], [0, 0, True]]}, TypeError),
        ({"rotation": [[1, 0, 0], [0, 1, 0], [0, 0, 2]]}, ValueError),
        ({"rotation": [[1e300, 0, 0], [0, 1, 0], [0, 0, 1]]}, ValueError),
        ({"rotation": [[1, 0, 0], [0, 1, 0], [0, 0, -1]]}, ValueError),
        ({"scale": "2"}, TypeError),
        ({"scale": 0}, ValueError),
        ({"scale": 2**64 - 1}, ValueError),
        ({"client_origin_m": [0, 0]}, TypeError),
        ({"client_origin_m": [0, 0, float("nan")]}, TypeError),
        ({"client_origin_m": [0, 0, 10.1]}, ValueError),
        ({"model_origin_m": [0, 0, -10.1]}, ValueError),
    ],
)
def test_what_can_be_no_frame_is_named(frame: object, error: type[Exception]) -> None:
    with pytest.raises(error, match=r"frame .*expected"):
        read_frame(frame)


def test_a_home_is_where_the_frame_maps_to_the_start() -> None:
    angle = 0.3
    c, s = np.cos(angle), np.sin(angle)
    frame = ClientFrame(((c, -s, 0.0), (s, c, 0.0), (0.0, 0.0, 1.0)), 3.0, (0.1, 0.2, 0.3), (0.01, 0.0, 0.05))
    start = np.array([0.03, -0.01, 0.04])
    home = np.array(frame.home_m(start))
    in_model = frame.model_origin_m + 3.0 * np.array(frame.rotation) @ (home - frame.client_origin_m)
    np.testing.assert_allclose(in_model, start, rtol=0, atol=1e-15)


def test_the_home_in_the_identity_frame_is_the_start_to_the_last_bit() -> None:
    assert IDENTITY.home_m((0.1, -0.7, 1e-3)) == (0.1, -0.7, 1e-3)


def test_a_bridge_that_names_both_origins_has_its_home_at_its_own_to_the_last_bit() -> None:
    start = (0.1, -0.7, 1e-3)
    frame = ClientFrame(scale=3.0, client_origin_m=(0.02, 0.0, -0.3), model_origin_m=start)
    assert frame.home_m(start) == (0.02, 0.0, -0.3)
