"""Where the points of a surface are near enough for a tool, and how much blunter it acts elsewhere."""

from __future__ import annotations

import numpy as np
import pytest

from palpate.model_file import ToolShape
from palpate.model_file.contact_size import (
    blunted_error,
    carried_share,
    coarse_advice,
    point_areas,
    point_spacing,
    ripple_note,
)
from palpate_server.diagnostics.sample_surface import half_space_model
from palpate_server.simulation import Simulation


def grid(count: int, spacing_m: float) -> tuple[np.ndarray, np.ndarray]:
    model = half_space_model([ToolShape("tip", 0.005, 0.0, (0.0, 0.0, 0.1))], count, spacing_m)
    return model.points, model.triangles


def test_the_spacing_of_a_square_grid_is_found_inside_it() -> None:
    points, triangles = grid(9, 3e-3)
    assert point_areas(points, triangles).sum() == pytest.approx((8 * 3e-3) ** 2)
    inside = np.abs(points[:, :2]).max(axis=1) < 11e-3
    np.testing.assert_allclose(point_spacing(points, triangles)[inside], 3e-3, rtol=1e-12)


def test_the_share_of_the_surface_with_points_near_enough_is_one_of_area() -> None:
    """Two squares of the same area, one with points every 3 mm and one with points every 12 mm."""
    fine, triangles = grid(17, 3e-3)
    coarse, few = grid(5, 12e-3)
    points = np.vstack([fine, coarse + np.array([0.1, 0.0, 0.0])])
    both = np.vstack([triangles, few + len(fine)])
    assert carried_share(points, both, 5e-3) == pytest.approx(0.5, abs=0.02)  # a corner stands for less
    assert carried_share(fine, triangles, 5e-3) == 1
    assert coarse_advice(fine, triangles, 5e-3) is None
    text = coarse_advice(points, both, 5e-3)
    assert text is not None
    assert text.startswith(
        "where points are far apart, as outside the working areas, a tip of radius_m = 0.005 acts as a blunter one, of up to 0.017 m"
    )


def test_the_error_of_a_blunter_tool_is_that_of_its_force_in_the_simulation() -> None:
    """Points 6 mm apart: a tip of 5 mm acts as one of 8.3 mm, which meets 29 % more force at a depth (Hertz)."""
    forces = {}
    for radius_m, spacing_m in ((0.005, 1.5e-3), (0.005, 6e-3)):
        tip = ToolShape("tip", radius_m, 0.0, (0.0, 0.0, 0.1))
        model = half_space_model([tip], 19 if spacing_m < 2e-3 else 13, spacing_m)
        simulation = Simulation(model, 1e5)
        for depth in np.linspace(0.0, 2e-3, 300):
            forces[spacing_m] = simulation.step({"tip": (0.0, 0.0, radius_m - depth)})["tip"].force_n[2]
        expected = blunted_error(model.points, model.triangles, radius_m).max()
    assert expected == pytest.approx(np.sqrt(6 * np.sqrt(6 / np.pi) / 5) - 1)
    # A single point is in contact: coarse points are felt beside it.
    assert forces[6e-3] / forces[1.5e-3] - 1 == pytest.approx(expected, abs=0.25)


def test_a_tool_is_held_between_points_that_are_near_enough() -> None:
    tip = ToolShape("tip", 0.005, 0.0, (0.0, 0.0, 0.02))
    model = half_space_model([tip], 8, 3.6e-3)  # the origin is in the middle of a square
    assert carried_share(model.points, model.triangles, tip.radius_m) == 1
    simulation = Simulation(model)
    for height in np.linspace(6e-3, 4e-3, 200):
        reaction = simulation.step({"tip": (0.0, 0.0, height)})["tip"]
    assert reaction.n_points == 4
    assert reaction.force_n[2] > 0


@pytest.mark.parametrize(
    ("spacing_m", "noted"), [(0.004, False), (0.003, True), (0.0022, True), (0.002, False)]
)
def test_a_tip_that_feels_the_points_while_it_slides_is_told_of(spacing_m: float, noted: bool) -> None:
    """Radius 5 mm: too few points at 4 mm, which is warned of; the contact has 1.2, 1.6 and 1.8 spacings at 3, 2.2 and 2 mm."""
    text = ripple_note(0.005, spacing_m)
    assert (text is not None) == noted
    assert text is None or "ripples by up to 6 %, by less than 2 % with a spacing_m of 0.0021" in text
