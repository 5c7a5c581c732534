"""Which points of a surface carry a tool: those with enough neighbors under it."""

from __future__ import annotations

import numpy as np
import pytest

from palpate.model_file import ToolShape
from palpate.model_file.contact_size import carried_share, carries, point_spacings, vertex_areas
from palpate_server.diagnostics.sample_surface import half_space_model
from palpate_server.simulation import Simulation


def grid(count: int, spacing_m: float) -> tuple[np.ndarray, np.ndarray]:
    model = half_space_model([ToolShape("tip", 0.005, 0.0, (0.0, 0.0, 0.1))], count, spacing_m)
    return model.points, model.triangles


def test_the_spacing_of_a_square_grid_is_found_inside_it() -> None:
    points, triangles = grid(9, 3e-3)
    assert vertex_areas(points, triangles).sum() == pytest.approx((8 * 3e-3) ** 2)
    inside = np.abs(points[:, :2]).max(axis=1) < 7e-3
    np.testing.assert_allclose(point_spacings(points, triangles)[inside], 3e-3, rtol=1e-12)


def test_the_share_of_the_surface_that_carries_a_tool_is_one_of_area() -> None:
    """Two squares of the same area, one with points every 3 mm and one with points every 12 mm."""
    fine, triangles = grid(17, 3e-3)
    coarse, few = grid(5, 12e-3)
    points = np.vstack([fine, coarse + np.array([0.1, 0.0, 0.0])])
    both = np.vstack([triangles, few + len(fine)])
    np.testing.assert_array_equal(
        carries(point_spacings(points, both), 5e-3), np.arange(len(points)) < len(fine)
    )
    assert carried_share(points, both, 5e-3) == pytest.approx(0.5)
    assert carried_share(fine, triangles, 5e-3) == 1
    assert carried_share(fine, triangles, 2e-3) == 0


def test_a_tool_is_held_between_points_that_carry_it() -> None:
    tip = ToolShape("tip", 0.005, 0.0, (0.0, 0.0, 0.02))
    model = half_space_model([tip], 8, 3.6e-3)  # the origin is in the middle of a square
    assert np.all(carries(point_spacings(model.points, model.triangles), tip.radius_m))
    simulation = Simulation(model)
    for height in np.linspace(6e-3, 4e-3, 200):
        reaction = simulation.step({"tip": (0.0, 0.0, height)})["tip"]
    assert reaction.n_points == 4
    assert reaction.force_n[2] > 0
