"""Places on a part of a surface."""

from __future__ import annotations

import numpy as np

from palpate.geometry.places_apart import places_apart

SIDE_M, SPACING_M = 0.1, 0.002


def _square() -> np.ndarray:
    axis = np.arange(-SIDE_M / 2, SIDE_M / 2 + 1e-9, SPACING_M)
    x, y = np.meshgrid(axis, axis)
    return np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)


def test_places_in_a_disc_are_well_inside_it_and_apart() -> None:
    points, radius = _square(), 0.03
    from_middle = np.linalg.norm(points - [0.005, 0.0, 0.0], axis=1)
    inside, beyond = points[from_middle < radius], points[from_middle >= radius]
    places = inside[places_apart(inside, beyond, 3)]
    from_middle = np.linalg.norm(places - [0.005, 0.0, 0.0], axis=1)
    assert from_middle[0] < SPACING_M
    assert np.all(from_middle < 2 / 3 * radius + SPACING_M)
    pairs = np.linalg.norm(places[:, None] - places, axis=2)[np.triu_indices(3, 1)]
    assert (
        pairs.min() > 2 / 3 * radius - 2 * SPACING_M
    )  # the middle, and two ends of a diameter of two thirds


def test_places_on_a_part_without_an_edge_reach_its_ends() -> None:
    places = _square()[places_apart(_square(), np.zeros((0, 3)), 5)]
    assert np.abs(places[0]).max() < SPACING_M
    np.testing.assert_allclose(np.abs(places[1:, :2]), SIDE_M / 2)
