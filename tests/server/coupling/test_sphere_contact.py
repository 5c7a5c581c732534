"""Contact against closed forms: Hertz, friction, relaxation, first touch; tracking in deep and fast motion; state and memory."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from palpate.model_file import SurfaceModel, ToolShape
from palpate_client.wire import Flags
from palpate_server.diagnostics.sample_surface import half_space_model
from palpate_server.simulation import Reaction, Simulation
from surface_indentation import LINES, around, hertz, pressed, ripple, slid, sneddon

Floats = NDArray[np.float64]

YOUNG_PA = 1e4
DEPTHS_M = 1e-3 * np.array([0.5, 0.75, 1.0, 1.5, 2.0, 2.5, 3.0])


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


def test_a_sphere_pressed_into_a_block_feels_hertz_and_deeper_sneddon() -> None:
    """Radius 5 mm, 0.5 to 3 mm deep. Hertz stands for a paraboloid, which the sphere leaves as it gets deeper."""
    found, radii = pressed(DEPTHS_M)
    exact = np.array([sneddon(depth) for depth in DEPTHS_M])
    np.testing.assert_allclose(found, exact[:, 0], rtol=0.04)
    np.testing.assert_allclose(radii, exact[:, 1], rtol=0.1)
    shallow = DEPTHS_M <= 2.5e-3
    of_paraboloid = np.array([hertz(depth) for depth in DEPTHS_M])
    np.testing.assert_allclose(found[shallow], of_paraboloid[shallow, 0], rtol=0.05)
    np.testing.assert_allclose(radii, of_paraboloid[:, 1], rtol=0.15)
    assert np.polyfit(np.log(DEPTHS_M), np.log(found), 1)[0] == pytest.approx(1.5, abs=0.05)


def test_a_sphere_is_one_until_it_is_pressed_in_by_its_radius() -> None:
    found, _ = pressed(np.array([4e-3, 5e-3]))
    np.testing.assert_allclose(found, [sneddon(4e-3)[0], sneddon(5e-3)[0]], rtol=0.03)


def test_a_body_that_gives_way_as_a_whole_is_felt_as_a_spring_in_series() -> None:
    """A dome that is pressed away under the tip: contact is between the tip and the dome where it has come to."""
    radius, dome, spring, depth = 8e-3, 25e-3, 60.0, 4e-3
    flat = half_space_model(one_tool(radius), 17, 1.5e-3, YOUNG_PA, n_modes=1)
    flat = replace(flat, shapes=np.zeros_like(flat.shapes))
    x, y, _ = flat.points.T
    points = np.stack([x, y, np.sqrt(dome**2 - x**2 - y**2) - dome], axis=1)
    held = replace(flat, points=points, normals=(points + np.array([0.0, 0.0, dome])) / dome)
    moves = np.tile(np.eye(3), (flat.n_points, 1))
    loose = replace(held, residual=(held.residual + moves @ moves.T / spring).astype(np.float32))

    def pressed_in(model: SurfaceModel, depth: float) -> tuple[float, Floats]:
        """The force, N, and the displacement of all points, (n, 3), m, at rest."""
        way = straight((0.0, 0.0, radius), (0.0, 0.0, radius - depth), 100)
        simulation = Simulation(model, 1e6)
        path(simulation, way)
        reaction = path(simulation, np.repeat(way[-1:], 200, axis=0))[-1]
        return float(reaction.force_n[2]), simulation.positions() - points

    force, moved = pressed_in(loose, depth)
    away = depth / 2
    for _ in range(6):
        expected, within = pressed_in(held, depth - away)
        away = -float(np.mean((moved - within)[:, 2]))
    assert 1e-3 < away < 0.8 * depth
    np.testing.assert_allclose(
        moved - within, np.tile([0.0, 0.0, -away], (len(points), 1)), atol=0.005 * away
    )
    assert force == pytest.approx(expected, rel=0.005)


def check_ripple(way_m: float) -> None:
    """The contact is 1.7 spacings in radius."""
    spacing, depth = 2e-3, 3e-3
    model = around(way_m, spacing)
    for line in LINES:
        assert ripple(slid(model, spacing, depth, line, way_m)) < 0.02, line


def test_the_force_of_a_sliding_tip_hardly_ripples() -> None:
    check_ripple(0.012)


@pytest.mark.slow
def test_the_force_of_a_sliding_tip_hardly_ripples_over_40_mm() -> None:
    check_ripple(0.04)


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


@pytest.mark.parametrize("of_limit", [0.5, 0.85, 1.2, 2.0])
def test_a_tool_pushed_at_an_angle_sticks_up_to_the_angle_of_friction(of_limit: float) -> None:
    """Mindlin & Deresiewicz 1953: where both forces grow in proportion below the limit, nothing slips, and the ways are
    as (2 - nu) / (2 (1 - nu)) times the forces, 3/2 for nu = 1/2.
    """
    friction, radius, depth = 0.4, 20e-3, 0.8e-3
    simulation = Simulation(half_space_model(one_tool(radius, friction), 15, 1e-3, YOUNG_PA), 1e6)
    aside = 1.5 * of_limit * friction * depth
    pushed = path(simulation, straight((0.0, 0.0, radius), (aside, 0.0, radius - depth), 200))[-1]
    assert bool(pushed.flags & Flags.SLIDING) == (of_limit > 1)
    assert -pushed.force_n[0] / pushed.force_n[2] == pytest.approx(friction * min(of_limit, 1.0), rel=0.05)


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


def test_a_fast_sweep_feels_what_a_slow_one_does() -> None:
    """0.5 m/s beside 0.05 m/s on an elastic half-space: all points are found before they are penetrated."""
    found = []
    for n in (600, 60):
        simulation = Simulation(half_space_model(one_tool(), 15, 3e-3, YOUNG_PA))
        path(simulation, straight((-0.015, 0.0, 6e-3), (-0.015, 0.0, 2e-3), 100))
        found.append(forces(path(simulation, straight((-0.015, 0.0, 2e-3), (0.015, 0.0, 2e-3), n)))[:, 2])
    slow, fast = found[0][9::10], found[1]
    assert np.abs(fast - slow).max() < 0.05 * slow.max()


def test_a_tip_between_points_that_are_far_apart_is_blunter_and_touches() -> None:
    """A sphere of 5 mm fits between points 12 mm apart; it presses as one of 16.6 mm, the smallest that they carry."""
    lifted = half_space_model(one_tool(), 9, 0.012, YOUNG_PA)
    for x, y in ((0.0, 0.0), (6e-3, 0.0), (6e-3, 6e-3), (5e-3, 3e-3)):
        simulation = Simulation(lifted)
        pushed = path(simulation, straight((x, y, 6e-3), (x, y, 0.0), 120))  # 5 mm deep
        assert pushed[-1].n_points >= 1
        assert largest_step(pushed) < 0.05 * pushed[-1].force_n[2]
        blunt = replace(lifted, tools=(ToolShape("tip", 0.0166, 0.0, (0.0, 0.0, 0.03)),))
        as_blunt = path(Simulation(blunt), straight((x, y, 0.0176), (x, y, 0.0116), 120))
        assert pushed[-1].force_n[2] == pytest.approx(as_blunt[-1].force_n[2], rel=0.03)


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


def test_a_state_that_was_not_saved_is_refused(soft: SurfaceModel) -> None:
    simulation = Simulation(soft)
    path(simulation, straight((0.0, 0.0, 5e-3), (0.0, 0.0, 2e-3), 60))
    state = simulation.save()
    rng = np.random.default_rng(0)
    for wrong in (
        state[1:],
        np.full_like(state, np.nan),
        rng.normal(size=state.size),
        np.full_like(state, 1e300),
    ):
        with pytest.raises(ValueError, match="state"):
            simulation.restore(wrong)
    np.testing.assert_array_equal(simulation.save(), state)


def test_one_tool_feels_another_press() -> None:
    tools = [ToolShape(name, 5e-3, 0.0, (x, 0.0, 6e-3)) for name, x in (("a", -6e-3), ("b", 6e-3))]
    simulation = Simulation(half_space_model(tools, 13, 3e-3, YOUNG_PA))
    for z in np.linspace(6e-3, 4e-3, 50):
        alone = simulation.step({"a": (-6e-3, 0.0, z)})["a"].force_n[2]
    for z in np.linspace(6e-3, 2e-3, 100):
        both = simulation.step({"a": (-6e-3, 0.0, 4e-3), "b": (6e-3, 0.0, z)})["a"].force_n[2]
    assert both < 0.95 * alone


@pytest.mark.parametrize(
    "position",
    [
        (0.0, 0.0),
        (0.0, 0.0, np.nan),
        1.0,
        "123",
        b"abc",
        ["1", "2", "3"],
        {1: 2},
        [1j, 0, 0],
        [10**400, 0, 0],
    ],
)
def test_a_position_is_three_finite_numbers(soft: SurfaceModel, position: object) -> None:
    with pytest.raises(ValueError, match=r"position of 'tip' is .*: expected three finite numbers, in m"):
        Simulation(soft).step({"tip": position})  # type: ignore[dict-item]


def test_an_unknown_tool_is_named(soft: SurfaceModel) -> None:
    with pytest.raises(ValueError, match=r"'top' is not a tool of the model: expected one of \['tip'\]"):
        Simulation(soft).step({"top": (0.0, 0.0, 0.0)})


def test_a_tool_that_is_near_more_points_than_it_can_follow_is_refused_with_the_numbers() -> None:
    """Else it would press some of them only, and be softer than it is."""
    model = half_space_model(one_tool(), 21, 3e-3)
    close_together = replace(model, points=0.1 * model.points)
    with pytest.raises(ValueError, match=r"radius_m = 0.005 is near 441 points .* expected at most 400"):
        Simulation(close_together)
