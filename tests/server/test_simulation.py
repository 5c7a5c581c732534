"""What `Simulation.step` takes as a position: any three numbers; all else is one error, after which nothing has changed."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from palpate.model_file import SurfaceModel
from palpate_server.simulation import Simulation


def test_a_position_may_be_an_iterator(make_surface_model: Callable[..., SurfaceModel]) -> None:
    of_array, of_iterator = (Simulation(make_surface_model()) for _ in range(2))
    for height in np.linspace(6e-3, 3e-3, 60):
        expected = of_array.step({"tip": np.array([0.0, 0.0, height])})["tip"]
        found = of_iterator.step({"tip": iter([0.0, 0.0, height])})["tip"]
    assert found.n_points > 0
    np.testing.assert_array_equal(found.force_n, expected.force_n)


@pytest.mark.parametrize(
    "position",
    [[0.0, 1.0], iter([0.0]), "abc", [[0.0], [0.0, 1.0], 2.0], [0.0, 0.0, math.nan], [0.0, 0.0, 1e300]],
)
def test_what_is_no_position_is_refused_by_the_name_of_its_tool(
    make_surface_model: Callable[..., SurfaceModel], position: Any
) -> None:
    simulation = Simulation(make_surface_model())
    before = simulation.save()
    with pytest.raises(
        ValueError, match=r"^position of 'tip' is .*: expected three finite numbers, in m, up to 1000"
    ):
        simulation.step({"tip": position})
    np.testing.assert_array_equal(simulation.save(), before)


@pytest.mark.parametrize("stiffness", [1e-310, 1e-200, 0.0, -1.0, 1e300, math.inf, math.nan])
def test_a_stiffness_without_a_usable_compliance_is_refused(
    make_surface_model: Callable[..., SurfaceModel], stiffness: float
) -> None:
    with pytest.raises(ValueError, match=r"^stiffness_n_per_m = .*: expected 1e-06 to 1e\+12"):
        Simulation(make_surface_model(), {"tip": stiffness})


def test_a_patch_model_is_refused(make_spring_mass_model: Callable[..., Any]) -> None:
    with pytest.raises(TypeError, match=r"^model is a ReducedModel: expected a SurfaceModel"):
        Simulation(make_spring_mass_model())
