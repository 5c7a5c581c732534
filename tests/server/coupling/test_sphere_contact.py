"""Contact against closed forms: Hertz, friction, relaxation, first touch; tracking in deep and fast motion; state and memory."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from palpate.model_file import SurfaceModel, ToolShape
from palpate_client.wire import Flags
from palpate_server.diagnostics.sample_surface import half_space_model
from palpate_server.simulation import Reaction, Simulation

Floats = NDArray[np.float64]

YOUNG_PA = 1e4
PLANE_STRAIN_PA = YOUNG_PA / 0.75  # E / (1 - nu²)


def one_tool(radius: float = 5e-3, friction: float = 0.0) -> list[ToolShape]:
    return [ToolShape("tip", radius, friction, (0.0, 0.0, radius + 1e-3))]


def path(simulation: Simulation, positions: Floats) -> list[Reaction]:
    return [simulation.step({"tip": position})["tip"] for position in positions]


def straight(start: tuple[float, ...], end: tuple[float, ...], n: int) -> Floats:
    return np.linspace(start, end, n + 1)[1:]


def forces(reactions: list[Reaction]) -> Floats:
    return np.array([reaction.force_n for reaction in reactions])


def largest_step(reactions: list[Reaction]) -> float:
    return float(np.linalg.norm(np.diff(forces(reactions), axis=0), axis=1).max())


def test_a_sphere_pressed_into_a_block_feels_hertz() -> None:
    """Contact radii of 3 to 6 spacings and depths up to a twentieth of the radius, where Hertz's theory holds."""
    radius, spacing = 20e-3, 1e-3
    simulation = Simulation(half_space_model(one_tool(radius), 19, spacing, YOUNG_PA), 1e6)
    depths = np.linspace(0.3e-3, 1.0e-3, 8)
    path(simulation, straight((0.0, 0.0, radius + 1e-4), (0.0, 0.0, radius - 0.2e-3), 60))
    found, touched = [], []
    for depth in depths:
        reactions = path(
            simulation, straight((0.0, 0.0, radius - depth + 1e-4), (0.0, 0.0, radius - depth), 20)
        )
        found.append(reactions[-1].force_n[2])
        touched.append(reactions[-1].n_points)
    expected = 4 / 3 * PLANE_STRAIN_PA * np.sqrt(radius) * depths**1.5
    np.testing.assert_allclose(found, expected, rtol=0.05)
    assert np.polyfit(np.log(depths), np.log(found), 1)[0] == pytest.approx(1.5, abs=0.05)
    contact_radius = np.sqrt(np.array(touched) / np.pi) * spacing
    np.testing.assert_allclose(contact_radius, np.sqrt(radius * depths), rtol=0.15)


def test_sliding_friction_is_coulombs_on_a_flat_contact() -> None:
    """The contact is so flat, a fiftieth of the radius, that what a slope adds is below 3 %."""
    friction, radius = 0.4, 0.1
    simulation = Simulation(half_space_model(one_tool(radius, friction), 15, 3e-3, YOUNG_PA), 1e5)
    z = radius - 0.4e-3
    path(simulation, straight((0.0, 0.0, radius), (0.0, 0.0, z), 50))
    stuck = path(simulation, straight((0.0, 0.0, z), (2e-5, 0.0, z), 5))
    assert not stuck[-1].flags & Flags.SLIDING
    assert abs(stuck[-1].force_n[0]) < friction * stuck[-1].force_n[2]
    sliding = path(simulation, straight((2e-5, 0.0, z), (3e-3, 0.0, z), 200))[-50:]
    assert all(reaction.flags & Flags.SLIDING for reaction in sliding)
    ratio = -forces(sliding)[:, 0] / forces(sliding)[:, 2]
    np.testing.assert_allclose(ratio, friction, rtol=0.03)


def test_a_tool_dragged_in_a_circle_loses_energy() -> None:
    simulation = Simulation(half_space_model(one_tool(5e-3, 0.3), 13, 3e-3, YOUNG_PA))
    angle = np.linspace(0, 2 * np.pi, 401)[1:]
    circle = np.stack([4e-3 * np.cos(angle), 4e-3 * np.sin(angle), np.full(400, 4e-3)], 1)
    path(simulation, straight((4e-3, 0.0, 6e-3), (4e-3, 0.0, 4e-3), 50))
    first = path(simulation, circle)[-1]
    second = path(simulation, circle)
    normal = np.mean(forces(second)[:, 2])
    lost = second[-1].work_j - first.work_j
    assert lost > 0.8 * 0.3 * normal * 2 * np.pi * 4e-3
    assert second[-1].dissipated_j > first.dissipated_j


def test_the_first_touch_is_no_jump() -> None:
    simulation = Simulation(half_space_model(one_tool(), 11, 3e-3, YOUNG_PA), 700.0)
    reactions = path(simulation, straight((0.0, 0.0, 6e-3), (0.0, 0.0, 2e-3), 40))  # 0.1 m/s
    assert reactions[-1].n_points > 1
    assert largest_step(reactions) <= 0.2


@pytest.fixture(scope="module")
def soft() -> SurfaceModel:
    prony = ([0.5, 0.3], [0.58, 0.004])
    return half_space_model(one_tool(friction=0.3), 15, 3e-3, 3e3, prony=prony, n_modes=20)


def test_a_deep_poke_is_neither_lost_nor_thrown_out(soft: SurfaceModel) -> None:
    """29 mm with a tip of 5 mm: the force grows all the way, and no tick changes it by more than 0.1 N."""
    simulation = Simulation(soft)
    inward = path(simulation, straight((2e-4, 1e-4, 5e-3), (2e-4, 1e-4, -24e-3), 580))
    assert all(reaction.n_points > 0 for reaction in inward[10:])
    heights = forces(inward)[::58, 2]
    assert np.all(np.diff(heights) > 0)
    held = path(simulation, np.tile([2e-4, 1e-4, -24e-3], (100, 1)))
    outward = path(simulation, straight((2e-4, 1e-4, -24e-3), (2e-4, 1e-4, 8e-3), 640))
    assert largest_step(inward + held + outward) < 0.1
    assert outward[-1].n_points == 0
    assert forces(outward)[:, 2].min() >= 0


def test_a_fast_sweep_does_not_lose_the_contact(soft: SurfaceModel) -> None:
    simulation = Simulation(soft)
    path(simulation, straight((-0.015, 0.0, 5e-3), (-0.015, 0.0, 2e-3), 60))
    sweep = path(simulation, straight((-0.015, 0.0, 2e-3), (0.015, 0.0, 2e-3), 30))  # 1 m/s
    assert all(reaction.n_points > 0 for reaction in sweep)


def test_a_tool_that_begins_inside_is_not_thrown_out(soft: SurfaceModel) -> None:
    simulation = Simulation(soft)
    reactions = path(simulation, np.tile([0.0, 0.0, -3e-3], (200, 1)))
    assert np.abs(forces(reactions)).max() < 1e-6
    deeper = path(simulation, straight((0.0, 0.0, -3e-3), (0.0, 0.0, -4e-3), 20))
    assert deeper[-1].force_n[2] > 0  # it resists going deeper


def test_a_grip_pulls_and_lets_go_without_a_jump(soft: SurfaceModel) -> None:
    simulation = Simulation(soft)
    pressed = path(simulation, straight((0.0, 0.0, 5e-3), (0.0, 0.0, 2e-3), 60))
    simulation.attach("tip")
    pulled = path(simulation, straight((0.0, 0.0, 2e-3), (0.0, 0.0, 9e-3), 140))
    assert pulled[-1].flags & Flags.ATTACHED
    assert pulled[-1].force_n[2] < -0.02
    assert np.linalg.norm(pulled[0].force_n - pressed[-1].force_n) < 0.02
    simulation.release("tip")
    released = path(simulation, np.tile([0.0, 0.0, 9e-3], (400, 1)))
    assert largest_step(pulled[-1:] + released) < 0.1 * abs(pulled[-1].force_n[2])
    assert np.all(released[-1].force_n == 0)
    assert not released[-1].flags & (Flags.ATTACHED | Flags.IN_CONTACT)


def test_a_saved_state_continues_with_the_same_bits(soft: SurfaceModel) -> None:
    one, other = Simulation(soft), Simulation(soft)
    path(one, straight((0.0, 0.0, 5e-3), (0.0, 0.0, 2e-3), 60))
    other.restore(one.save())
    slide = straight((0.0, 0.0, 2e-3), (9e-3, 2e-3, 2e-3), 80)
    np.testing.assert_array_equal(forces(path(one, slide)), forces(path(other, slide)))
    np.testing.assert_array_equal(one.save(), other.save())
    np.testing.assert_array_equal(one.positions(), other.positions())
    assert np.abs(one.positions() - soft.points).max() > 1e-3


def test_one_tool_feels_another_press() -> None:
    tools = [ToolShape(name, 5e-3, 0.0, (x, 0.0, 6e-3)) for name, x in (("a", -6e-3), ("b", 6e-3))]
    simulation = Simulation(half_space_model(tools, 13, 3e-3, YOUNG_PA))
    for z in np.linspace(6e-3, 4e-3, 50):
        alone = simulation.step({"a": (-6e-3, 0.0, z)})["a"].force_n[2]
    for z in np.linspace(6e-3, 2e-3, 100):
        both = simulation.step({"a": (-6e-3, 0.0, 4e-3), "b": (6e-3, 0.0, z)})["a"].force_n[2]
    assert both < 0.95 * alone


@pytest.mark.parametrize("position", [(0.0, 0.0), (0.0, 0.0, np.nan), 1.0])
def test_a_position_is_three_finite_numbers(soft: SurfaceModel, position: object) -> None:
    with pytest.raises(ValueError, match=r"position of 'tip' is .*: expected three finite numbers, in m"):
        Simulation(soft).step({"tip": position})  # type: ignore[dict-item]


def test_an_unknown_tool_is_named(soft: SurfaceModel) -> None:
    with pytest.raises(ValueError, match=r"'top' is not a tool of the model: expected one of \['tip'\]"):
        Simulation(soft).step({"top": (0.0, 0.0, 0.0)})
