"""Which points are near one along the surface."""

from __future__ import annotations

import numpy as np
import pytest

from palpate.model_file.contact_size import point_spacing
from palpate_server.coupling.near_points import NONE, TooManyPoints, near_points

# A strip of squares, 1 m wide, with one long one at its end.
X = np.array([0.0, 1.0, 2.0, 3.0, 13.0])
POINTS = np.concatenate([np.stack([X, np.full(5, y), np.zeros(5)], 1) for y in (0.0, 1.0)])
TRIANGLES = np.array([t for i in range(4) for t in ((i, i + 1, i + 5), (i + 1, i + 6, i + 5))], np.int32)


def near(point: int, reach_m: float) -> set[int]:
    row = near_points(POINTS, TRIANGLES, reach_m, 10)[point]
    return set(row[row != NONE].tolist())


def test_points_within_the_reach_are_near_and_the_nearest_comes_first() -> None:
    assert near(0, 2.1) == {0, 1, 2, 5, 6}
    assert near_points(POINTS, TRIANGLES, 2.1, 10)[0, 0] == 0


def test_a_point_that_an_edge_connects_is_near_however_far_it_is() -> None:
    assert near(4, 2.1) == {3, 4, 8, 9}
    assert near(4, 0.5) == {3, 4, 8, 9}


def test_a_longer_reach_has_more_points_and_the_shortest_the_direct_neighbors() -> None:
    assert len(near(2, 3.5)) == 8
    assert near(0, 0.1) == {0, 1, 5}


def test_more_points_than_there_is_room_for_are_counted() -> None:
    with pytest.raises(TooManyPoints) as raised:
        near_points(POINTS, TRIANGLES, 20.0, 4)
    assert raised.value.count == 10


def test_the_spacing_is_the_root_of_the_area_of_a_point() -> None:
    spacing = point_spacing(POINTS, TRIANGLES)
    assert np.sum(spacing**2) == pytest.approx(13.0)
    assert spacing[1] == pytest.approx(np.sqrt(3 / 6))
    np.testing.assert_array_equal(point_spacing(POINTS, np.zeros((0, 3), np.int32)), 0)
