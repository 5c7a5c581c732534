"""The tick, driven by hand: the test says when commands arrive and when deadlines pass."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Iterator

import numpy as np
import pytest
from numba import njit

from dense_form import dense_a
from palpate.model_file import ReducedModel, StateSpace
from palpate_client.wire import Flags
from palpate_server.bodies import state_space
from palpate_server.coupling import cross_fade, models
from palpate_server.diagnostics.sample_model import patches_of
from palpate_server.realtime import safety, scheduler, shared_memory
from palpate_server.realtime.clock import monotonic_ns
from palpate_server.realtime.native_image import Image, make_image
from palpate_server.realtime.records import RECORDS
from palpate_server.realtime.safety import Limits

FREE = Limits(1e6, 1e12, 1e6, 1e6, 0.0)  # limits that nothing here reaches
PERIOD_NS = 1_000_000


def now_ns(memory: shared_memory.Memory) -> int:
    """When the next tick begins: a period after the last one, however long the test takes."""
    return (1000 + int(memory.counters["ticks"][0])) * PERIOD_NS


Vector = tuple[float, float, float]
STILL: Vector = (0.0, 0.0, 0.0)


def write(
    memory: shared_memory.Memory,
    tool: int,
    sequence: int,
    arrival_ns: int,
    target: Vector,
    velocity: Vector = STILL,
    rendered_tick: int = -1,
    lease: int | None = None,
) -> None:
    """Put a command where the next tick finds it, whatever its numbers are."""
    held = memory.commands.lease[tool] if lease is None else lease
    memory.commands.newest[tool] = (tool, held, sequence, 7, arrival_ns, rendered_tick, target, velocity, 0)


def command(
    memory: shared_memory.Memory, sequence: int, target: tuple[float, float, float], age_ns: int = 0
) -> None:
    write(memory, 0, sequence, now_ns(memory) - age_ns, target)


@pytest.fixture(autouse=True)
def images() -> Iterator[None]:
    yield
    IMAGES.clear()


IMAGES: dict[int, tuple[shared_memory.Memory, Image]] = {}


def image_of(memory: shared_memory.Memory) -> Image:
    """It takes five milliseconds to make, so a test makes it once."""
    if id(memory) not in IMAGES:
        IMAGES[id(memory)] = memory, make_image(memory)  # with the memory, so that its id is not given again
    return IMAGES[id(memory)][1]


def repeat_tick(image: Image, now: int) -> None:
    scheduler.repeat_tick(image, now, now, False)


def tick(memory: shared_memory.Memory) -> tuple[int, np.ndarray, np.ndarray, float]:
    """Run one tick; its flags, applied position, force and scale."""
    repeat_tick(image_of(memory), now_ns(memory))
    port = newest(memory)[0]
    return int(port["flags"]), port["position_m"].copy(), port["force_n"].copy(), float(port["force_scale"])


def newest(memory: shared_memory.Memory) -> np.ndarray:
    """The records of the last tick, (n_tools,)."""
    return memory.ring.ports[(scheduler.records_written(memory.shared) - 1) % RECORDS]


def tallies(memory: shared_memory.Memory) -> list[int]:
    return [int(memory.ports[name][0]) for name in ("commanded_ticks", "fresh_ticks")]


@pytest.fixture
def memory(make_spring_mass_model: Callable[..., ReducedModel]) -> shared_memory.Memory:
    model = make_spring_mass_model()
    return shared_memory.make_memory(models.make_running(model), model.period_s, [FREE], 1 / 30)


@pytest.fixture
def stop_threads() -> Iterator[Callable[[shared_memory.Memory, threading.Thread], None]]:
    running: list[tuple[shared_memory.Memory, threading.Thread]] = []
    yield lambda memory, thread: running.append((memory, thread))
    for memory, thread in running:
        scheduler.stop(memory.shared)
        thread.join(10)
        assert not thread.is_alive()


def test_without_a_command_the_force_is_zero_and_stale_and_nothing_is_echoed(
    memory: shared_memory.Memory,
) -> None:
    command(memory, 1, (0.0, 0.0, 0.0))
    tick(memory)
    for _ in range(2):
        scheduler.forget_command(memory.commands, 0)
        flags, _, force, scale = tick(memory)
    assert flags == Flags.STALE
    assert scale == 0
    np.testing.assert_array_equal(force, 0)
    for name, echoed in (("sequence", 1), ("client_time_ns", 7)):
        np.testing.assert_array_equal(memory.ring.ports[name][:3, 0], [echoed, -1, -1])
    np.testing.assert_array_equal(memory.ring.ports["input_age_ns"][1:3, 0], -1)


def test_forces_are_the_discrete_models_response_to_the_applied_displacements(
    memory: shared_memory.Memory, make_spring_mass_model: Callable[..., ReducedModel]
) -> None:
    system = make_spring_mass_model().discrete
    state = np.zeros(system.order)
    for i in range(500):
        command(memory, i, (1e-3 * np.sin(0.1 * i), 2e-3 * np.cos(0.03 * i), 1e-4 * i))
        _, applied, force, scale = tick(memory)
        expected = system.c @ state + system.d @ applied
        state = dense_a(system) @ state + system.b @ applied
        np.testing.assert_allclose(force, -scale * expected, rtol=0, atol=1e-12)  # on the tool
    assert scale == 1


def test_force_fades_in_after_the_first_command(memory: shared_memory.Memory) -> None:
    scales = []
    for i in range(250):
        command(memory, i, (0.0, 0.0, 1e-3))
        flags, *_, scale = tick(memory)
        scales.append(scale)
        assert bool(flags & Flags.SOFT_START) == (scale < 1)
    assert np.diff(scales).max() <= PERIOD_NS / safety.SOFT_START_NS * (1 + 1e-9)
    assert scales[-1] == 1


def test_a_silent_client_is_held_then_faded_to_zero_and_withdrawn(memory: shared_memory.Memory) -> None:
    for i in range(250):
        command(memory, i, (0.0, 0.0, 1e-3))
        tick(memory)
    command(memory, 250, (0.0, 0.0, 1e-3), age_ns=safety.HOLD_NS // 2)
    tick(memory)
    flags, applied, force, scale = tick(memory)
    assert flags == Flags.HELD
    assert scale == 1
    held = np.linalg.norm(force)

    command(memory, 251, (0.0, 0.0, 1e-3), age_ns=safety.HOLD_NS + PERIOD_NS)
    forces = []
    for _ in range(round(safety.DECAY_NS / PERIOD_NS) + 1):
        flags, applied, force, scale = tick(memory)
        forces.append(np.linalg.norm(force))
        assert flags == (Flags.DECAYING if scale else Flags.STALE)
    assert forces[-1] == 0
    assert max(-np.diff([held, *forces])) < 3 * held * PERIOD_NS / safety.DECAY_NS
    assert applied[2] in (0.0, 1e-3)
    _, applied, *_ = tick(memory)
    np.testing.assert_array_equal(applied, 0)


def test_a_forgotten_client_fades_without_being_held(memory: shared_memory.Memory) -> None:
    for i in range(250):
        command(memory, i, (0.0, 0.0, 1e-3))
        tick(memory)
    scheduler.forget_command(memory.commands, 0)
    flags, applied, _, scale = tick(memory)
    assert flags == Flags.DECAYING
    assert scale < 1
    assert applied[2] == 1e-3  # the tip stays while somebody may still feel it


def test_recovery_in_the_middle_of_the_fading_goes_on_from_there(memory: shared_memory.Memory) -> None:
    for i in range(250):
        command(memory, i, (0.0, 0.0, 1e-3))
        tick(memory)
    scheduler.forget_command(memory.commands, 0)
    for _ in range(25):
        *_, before = tick(memory)
    command(memory, 1000, (0.0, 0.0, 1e-3))
    flags, _, _, after = tick(memory)
    assert 0 < before < after < before + 0.01
    assert flags == Flags.SOFT_START


def test_a_jump_is_followed_at_the_speed_limit(make_spring_mass_model: Callable[..., ReducedModel]) -> None:
    model = make_spring_mass_model()
    memory = shared_memory.make_memory(
        models.make_running(model), model.period_s, [FREE._replace(max_speed_m_per_s=0.5)], 1 / 30
    )
    depths = []
    for i in range(40):
        command(memory, i, (0.0, 0.0, 0.009))
        flags, applied, *_ = tick(memory)
        depths.append(applied[2])
        assert bool(flags & Flags.SPEED_LIMITED) == (applied[2] < 0.009)
        assert not flags & Flags.JUMPED  # it may have been on its way while the input was held
    np.testing.assert_allclose(np.diff(depths[:17]), 0.5e-3)
    assert depths[-1] == 0.009


def test_a_jump_that_no_hold_explains_fades_the_force_until_the_tip_is_there_then_softly_in(
    spring: shared_memory.Memory,
) -> None:
    for i in range(300):
        command(spring, i, (0.0, 0.0, 1e-3))
        flags, _, force, scale = tick(spring)
    assert scale == 1
    assert not flags & Flags.JUMPED
    scales, forces = [scale], [force]
    for i in range(300, 600):
        command(spring, i, (0.06, 0.0, 1e-3))  # 60 mm at 1 m/s: 60 ticks
        flags, applied, force, scale = tick(spring)
        assert bool(flags & Flags.JUMPED) == (applied[0] < 0.06)
        scales.append(scale)
        forces.append(force)
    fading, there, back = scales[:51], scales[50:60], scales[60:]
    np.testing.assert_allclose(fading, np.linspace(1, 0, 51), atol=1e-12)
    np.testing.assert_array_equal(there, 0)
    np.testing.assert_allclose(np.diff(back[:200]), 1 / 200)
    steps = np.linalg.norm(np.diff(forces, axis=0), axis=1)
    assert steps.max() <= USUAL.max_force_rate_n_per_s * 1e-3 * (1 + 1e-12)
    scheduler.forget_command(spring.commands, 0)
    for _ in range(200):  # withdrawn from as far, which is no jump of a client's
        flags, *_ = tick(spring)
        assert not flags & Flags.JUMPED


def test_a_model_that_gives_nan_is_put_to_rest_and_counted(memory: shared_memory.Memory) -> None:
    for i in range(10):
        command(memory, i, (0.0, 0.0, 1e-3))
        tick(memory)
    memory.coupling.running.patch.body.state[0] = np.nan
    flags, _, force, scale = tick(memory)
    assert flags & Flags.FAULT
    assert scale == 0
    np.testing.assert_array_equal(force, 0)
    assert memory.counters["faults"][0] == 1
    flags, _, force, _ = tick(memory)
    assert not flags & Flags.FAULT
    assert np.all(np.isfinite(force))


def test_commands_and_forces_are_in_the_holders_frame(
    memory: shared_memory.Memory, make_spring_mass_model: Callable[..., ReducedModel]
) -> None:
    system = make_spring_mass_model().discrete
    rotation = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    scale, origin = 2.0, np.array([0.1, 0.0, 0.0])
    scheduler.set_frame(image_of(memory), 0, rotation, scale, origin)
    state = np.zeros(system.order)
    for i in range(300):
        position = origin + 1e-3 * np.sin(0.1 * i) * np.array([1.0, 0.5, -0.2])
        command(memory, i, tuple(position))
        _, applied, force, fade = tick(memory)
        np.testing.assert_allclose(applied, position)
        displacement = scale * rotation @ (applied - origin)
        expected = scale * rotation.T @ (system.c @ state + system.d @ displacement)
        state = dense_a(system) @ state + system.b @ displacement
        np.testing.assert_allclose(force, -fade * expected, rtol=0, atol=1e-11)


USUAL = Limits(10.0, 2000.0, 1.0, 0.1, 0.0)
SPRING_N_PER_M = 1000.0


@pytest.fixture
def spring() -> shared_memory.Memory:
    """A spring without memory: what it gives is the displacement of this very tick."""
    nothing = np.zeros(2), np.zeros(2), np.zeros((2, 3)), np.zeros((3, 2))
    return shared_memory.make_memory(
        patches_of(StateSpace(*nothing, SPRING_N_PER_M * np.eye(3))), 1e-3, [USUAL], 1 / 30
    )


def hand_over(memory: shared_memory.Memory, scale: float, origin: tuple[float, float, float]) -> None:
    """What acquiring does: silence, then the next holder's frame."""
    image = image_of(memory)
    scheduler.forget_command(memory.commands, 0)
    for _ in range(60):
        if scheduler.is_silent(image, 0):
            break
        tick(memory)
    assert scheduler.is_silent(image, 0)
    scheduler.set_frame(image, 0, np.eye(3), scale, np.array(origin))


def test_the_next_client_starts_at_rest_whatever_the_one_before_did(spring: shared_memory.Memory) -> None:
    hand_over(spring, 1000.0, (0.0, 0.0, 0.0))
    for i in range(300):
        command(spring, i, (0.0, 0.0, 0.09))
        flags, applied, force, scale = tick(spring)
        assert np.linalg.norm(spring.displacement) <= USUAL.workspace_radius_m * (1 + 1e-12)
    assert flags & Flags.WORKSPACE_CLAMPED
    assert np.linalg.norm(force) == pytest.approx(USUAL.max_force_n)
    hand_over(spring, 1.0, (0.0, 0.0, 0.0))
    for i in range(300):
        command(spring, i, (0.0, 0.0, 0.0))
        _, applied, force, scale = tick(spring)
        np.testing.assert_array_equal(applied, 0)
        np.testing.assert_array_equal(spring.displacement, 0)
        np.testing.assert_array_equal(force, 0)
    assert scale == 1


def test_the_workspace_is_around_the_frames_origin(spring: shared_memory.Memory) -> None:
    origin = np.array([5.0, 0.0, 0.0])
    hand_over(spring, 1.0, (5.0, 0.0, 0.0))
    for i in range(300):
        command(spring, i, (5.0, 0.0, 0.0))
        flags, applied, force, _ = tick(spring)
        assert not flags & (Flags.WORKSPACE_CLAMPED | Flags.SPEED_LIMITED)
        np.testing.assert_array_equal(applied, origin)
        np.testing.assert_array_equal(force, 0)
    for i in range(300, 400):
        command(spring, i, (5.0, 0.0, 1e-3))
        _, _, force, _ = tick(spring)
    np.testing.assert_allclose(force, (0.0, 0.0, -1e-3 * SPRING_N_PER_M))
    for i in range(400, 600):
        command(spring, i, (5.5, 0.0, 0.0))
        flags, applied, *_ = tick(spring)
    assert flags & Flags.WORKSPACE_CLAMPED
    np.testing.assert_allclose(applied, (5.1, 0.0, 0.0))
    scheduler.forget_command(spring.commands, 0)
    for _ in range(200):
        _, applied, *_ = tick(spring)
    np.testing.assert_allclose(applied, origin)
    np.testing.assert_allclose(spring.displacement, 0, atol=1e-14)


def test_a_reset_puts_the_tip_to_rest_and_takes_the_force_down_at_the_allowed_rate(
    spring: shared_memory.Memory,
) -> None:
    for i in range(300):
        command(spring, i, (0.0, 0.0, 0.05))
        _, _, before, _ = tick(spring)
    assert np.linalg.norm(before) == pytest.approx(USUAL.max_force_n)
    scheduler.reset(image_of(spring))
    command(spring, 299, (0.0, 0.0, 0.05))
    _, _, before, _ = tick(spring)
    assert spring.ports["energy_j"][0] == 0  # the device has not moved
    for i in range(300, 320):
        command(spring, i, (0.0, 0.0, 0.0))
        flags, applied, force, _ = tick(spring)
        assert not flags & Flags.SPEED_LIMITED  # it is there, it need not go there
        np.testing.assert_array_equal(applied, 0)
        assert np.linalg.norm(force - before) <= USUAL.max_force_rate_n_per_s * 1e-3 * (1 + 1e-12)
        before = force
    np.testing.assert_array_equal(force, 0)


@pytest.mark.parametrize("soft_start_ticks", [20, 100, 300])
@pytest.mark.parametrize("lowered_to_n", [USUAL.max_force_n, 0.01])
def test_the_slowest_allowed_rate_lets_every_force_fade_in_time_and_stale_means_zero(
    spring: shared_memory.Memory, soft_start_ticks: int, lowered_to_n: float
) -> None:
    """The model's force is far above the largest one, so that it stands at its limit while its scale already falls."""
    image = image_of(spring)
    for i in range(soft_start_ticks):
        command(spring, i, (0.0, 0.0, 0.1))
        _, _, before, _ = tick(spring)
    slowest = safety.least_force_rate(USUAL.max_force_n)
    terms = USUAL._replace(max_force_n=lowered_to_n, max_force_rate_n_per_s=slowest)
    scheduler.set_limits(image, 0, np.array(terms))
    scheduler.forget_command(spring.commands, 0)
    ticks = 0
    while np.any(before):
        flags, _, force, _ = tick(spring)
        ticks += 1
        assert np.linalg.norm(force - before) <= slowest * 1e-3 + 1e-12
        assert bool(flags & Flags.STALE) == (not np.any(force))
        assert bool(flags & Flags.DECAYING) == bool(np.any(force))
        before = force
        assert safety.HOLD_NS + ticks * PERIOD_NS < 100_000_000
    assert ticks <= safety.DECAY_NS // PERIOD_NS + 1


@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_extreme_numbers_hold_the_tip_and_leave_another_contact_alone(
    make_spring_mass_model: Callable[..., ReducedModel], sign: float
) -> None:
    """What the wire refuses must do no harm in the loop either: here displacement and velocity overflow together."""
    model = make_spring_mass_model(2)
    usual = Limits(10.0, 2000.0, 1.0, 0.1, 0.0)
    memory, undisturbed = (
        shared_memory.make_memory(models.make_running(model), model.period_s, [usual, usual], 1 / 30)
        for _ in range(2)
    )
    huge = (sign * 1.797e308,) * 3
    for i in range(300):
        now = now_ns(memory)
        good = (0.0, 0.0, 1e-3)
        for m in (memory, undisturbed):
            write(m, 1, i, now, good)
            write(m, 0, i, now, good)
        if i >= 250:
            write(memory, 0, i, now - 5_000_000, huge, huge)
        for m in (memory, undisturbed):
            tick(m)
    for name in ("position_m", "force_n", "force_scale", "energy_j"):
        np.testing.assert_array_equal(newest(memory)[name], newest(undisturbed)[name])
    np.testing.assert_array_equal(newest(memory)["position_m"][0], (0.0, 0.0, 1e-3))
    assert np.any(newest(memory)["force_n"][1])
    assert memory.counters["faults"][0] == 0


@pytest.mark.parametrize("size", [1e160, 1.797e308, float("inf"), float("nan")])
def test_a_target_without_a_finite_length_is_not_followed(memory: shared_memory.Memory, size: float) -> None:
    command(memory, 0, (0.0, 0.0, 1e-3))
    tick(memory)
    command(memory, 1, (size, -size, size))
    flags, applied, force, _ = tick(memory)
    assert flags & Flags.WORKSPACE_CLAMPED
    np.testing.assert_array_equal(applied, (0.0, 0.0, 1e-3))
    assert np.all(np.isfinite(force))


def test_a_velocity_carries_the_displacement_on_between_commands(memory: shared_memory.Memory) -> None:
    for age_ns, carried_m in ((4_000_000, 0.4e-3), (10_000_000, 0.5e-3)):  # at 0.1 m/s, and no more than 5 ms
        arrival = now_ns(memory) - age_ns
        write(memory, 0, 1, arrival, (1e-3, 0.0, 0.0), (0.1, 0.0, 0.0))
        _, applied, *_ = tick(memory)
        assert applied[0] == pytest.approx(1e-3 + carried_m, rel=1e-12)


def test_energy_counts_the_force_that_the_device_was_rendering(memory: shared_memory.Memory) -> None:
    forces, positions = [], []
    expected = 0.0
    for i in range(100):
        position = (0.0, 0.0, 1e-3 * np.sin(0.2 * i))
        rendered = i - 3 if i >= 3 else -1  # a device that is three ticks behind
        write(memory, 0, i, now_ns(memory), position, rendered_tick=rendered)
        _, applied, force, _ = tick(memory)
        if i:
            step = applied[2] - positions[-1]
            expected -= (forces[rendered] if rendered >= 0 else forces[-1]) * step
        forces.append(force[2])
        positions.append(applied[2])
    np.testing.assert_allclose(newest(memory)["energy_j"][0], expected, rtol=1e-9)


def test_energy_is_that_of_the_device_also_while_the_tip_is_let_after_it_slowly(
    spring: shared_memory.Memory,
) -> None:
    """A limit of the speed makes of a passive spring one that gives out energy: the observer has to see it."""
    spring.settings["max_speed_m_per_s"] = 0.17
    spring.settings["max_force_n"] = spring.settings["max_force_rate_n_per_s"] = 1e6
    energy, force, before = 0.0, np.zeros(3), 0.0
    limited = False
    for i in range(3000):
        position = 0.008 * np.sin(2 * np.pi * 5 * i * 1e-3)
        command(spring, i, (0.0, 0.0, position))
        energy -= force[2] * (position - before)
        before = position
        flags, _, force, _ = tick(spring)
        limited = limited or bool(flags & Flags.SPEED_LIMITED)
    assert limited
    assert energy < -0.1
    np.testing.assert_allclose(spring.ports["energy_j"][0], energy, rtol=1e-9)


def test_a_command_of_a_hold_that_is_over_is_not_carried_out(memory: shared_memory.Memory) -> None:
    now = now_ns(memory)
    scheduler.forget_command(memory.commands, 0)
    write(memory, 0, 5, now, (0.0, 0.0, 1e-3), lease=0)
    flags, applied, _, scale = tick(memory)
    assert flags == Flags.STALE
    np.testing.assert_array_equal(applied, 0)
    write(memory, 0, 1, now, (0.0, 0.0, 1e-3), lease=1)
    flags, applied, _, scale = tick(memory)
    assert scale > 0
    np.testing.assert_array_equal(applied, (0.0, 0.0, 1e-3))


def test_a_change_that_is_withdrawn_is_not_made(memory: shared_memory.Memory) -> None:
    image = image_of(memory)
    scheduler.set_limits(image, 0, np.full(5, 2.0))
    assert scheduler.withdraw_change(image)
    tick(memory)
    assert memory.settings[0].tolist()[:5] == FREE
    scheduler.set_limits(image, 0, np.full(5, 2.0))
    tick(memory)
    assert not scheduler.withdraw_change(image)
    assert memory.settings[0].tolist()[:5] == (2.0,) * 5


def test_a_client_that_hovers_at_the_surface_does_not_leave_the_state_to_decay_for_ever(
    memory: shared_memory.Memory,
) -> None:
    for i in range(300):
        command(memory, i, (0.0, 0.0, 1e-3))
        tick(memory)
    for i in range(300, 20_000):
        command(memory, i, (0.0, 0.0, 0.0))
        tick(memory)
        if not np.any(memory.coupling.running.patch.body.state):
            break
    assert not np.any(memory.coupling.running.patch.body.state)


def test_reset_puts_the_model_to_rest_and_lets_the_force_fade_in_again(
    memory: shared_memory.Memory, make_spring_mass_model: Callable[..., ReducedModel]
) -> None:
    for i in range(250):
        command(memory, i, (0.0, 0.0, 1e-3))
        tick(memory)
    assert np.any(memory.coupling.running.patch.body.state)
    scheduler.reset(image_of(memory))
    assert not scheduler.is_changed(image_of(memory))
    command(memory, 250, (0.0, 0.0, 1e-3))
    flags, applied, _, scale = tick(memory)
    assert scheduler.is_changed(image_of(memory))
    assert memory.ring.ticks["change"][250]
    np.testing.assert_allclose(memory.force[0], -make_spring_mass_model().discrete.d @ applied, rtol=1e-12)
    assert flags & Flags.SOFT_START
    assert scale < 0.01


def test_another_model_is_faded_in_where_it_settles(
    memory: shared_memory.Memory, make_spring_mass_model: Callable[..., ReducedModel]
) -> None:
    position = (1e-3, -2e-3, 3e-3)
    running = make_spring_mass_model().discrete
    for i in range(300):
        if i == 250:  # the soft start is over: the running model has settled too
            memory.coupling.running.patch.body.state[:] = state_space.make_body(
                running, np.array(position)
            ).state
        command(memory, i, position)
        *_, before, _ = tick(memory)
    other = make_spring_mass_model(1, 7).discrete
    following = patches_of(other, np.array([position]))
    fading = cross_fade.to_another(memory.coupling, following, 0.01)
    settled = following.patch.body.state.copy()
    np.testing.assert_allclose(dense_a(other) @ settled + other.b @ np.array(position), settled, atol=1e-15)

    image = image_of(memory)
    with_both = shared_memory.with_coupling(memory, fading)
    scheduler.exchange(image, image_of(with_both))
    forces = [before]
    for i in range(300, 400):
        command(memory, i, position)
        repeat_tick(image, now_ns(memory))
        forces.append(newest(memory)["force_n"][0].copy())
    final = -(other.c @ settled + other.d @ np.array(position))
    np.testing.assert_allclose(forces[-1], final, rtol=1e-9)
    expected = before + np.linspace(0, 1, 101)[:, None] * (final - before)
    np.testing.assert_allclose(forces, expected, rtol=0, atol=1e-6 * np.abs(final).max())

    done = shared_memory.with_coupling(memory, cross_fade.after(fading))
    scheduler.exchange(image, image_of(done))
    command(memory, 400, position)
    repeat_tick(image, now_ns(memory))
    np.testing.assert_allclose(newest(memory)["force_n"][0], final, rtol=1e-9)


def arrive(memory: shared_memory.Memory, sequence: int, arrival_ns: int, depth_m: float = 0.0) -> int:
    """A command comes at this time; the ticks that ran, or minus the reason."""
    lease = memory.commands.lease[0]
    memory.commands.incoming[0] = (0, lease, sequence, 7, arrival_ns, -1, (0.0, 0.0, depth_m), STILL, 0)
    return int(scheduler.arrive(image_of(memory), 1))


def test_an_early_command_waits_for_the_tick_and_a_second_one_replaces_it(
    memory: shared_memory.Memory,
) -> None:
    now = time.monotonic_ns()
    memory.shared[shared_memory.DEADLINE_NS] = now + PERIOD_NS - 100_000
    assert arrive(memory, 1, now, 1e-3) == 0
    assert arrive(memory, 2, now + PERIOD_NS * 6 // 10, 2e-3) == 1
    assert memory.ring.ports["sequence"][0, 0] == 2
    assert arrive(memory, 3, now + PERIOD_NS * 7 // 10) == 0  # one tick each period


@pytest.mark.parametrize(
    ("sequence", "depth_m", "reason"),
    [
        (5, 0.0, "old_sequence"),
        (6, float("nan"), "not_finite"),
        (6, float("-inf"), "not_finite"),
        (6, 1000.1, "out_of_range"),
    ],
)
def test_a_command_is_refused_for_its_numbers_and_leaves_nothing_behind(
    memory: shared_memory.Memory, sequence: int, depth_m: float, reason: str
) -> None:
    now = time.monotonic_ns()
    memory.shared[shared_memory.DEADLINE_NS] = now + PERIOD_NS
    assert arrive(memory, 5, now, 1e-3) == 0
    before = memory.commands.newest.copy()
    assert scheduler.REFUSALS[-arrive(memory, sequence, now + PERIOD_NS, depth_m)] == reason
    assert memory.commands.newest.tobytes() == before.tobytes()
    assert memory.counters["ticks"][0] == 0
    scheduler.forget_command(memory.commands, 0)
    assert arrive(memory, 5, now, 1e-3) == 0  # in the next hold a client may count anew


def test_deadlines_settle_a_quarter_of_a_period_behind_steady_arrivals(memory: shared_memory.Memory) -> None:
    start = time.monotonic_ns()
    sequence = 0
    for offset in (0, 170_000, 480_000, 730_000, 999_000):
        memory.shared[shared_memory.DEADLINE_NS] = start + offset
        ticks = 0
        for i in range(600):
            sequence += 1
            ticks += arrive(memory, sequence, start + i * PERIOD_NS)
        phase = (memory.shared[shared_memory.DEADLINE_NS] - start) % PERIOD_NS
        assert abs(phase - PERIOD_NS // 4) < PERIOD_NS // 50
        assert abs(ticks - 600) <= 1


def test_a_burst_moves_the_deadlines_no_more_than_one_command_does(memory: shared_memory.Memory) -> None:
    now = time.monotonic_ns()
    memory.shared[shared_memory.DEADLINE_NS] = now + PERIOD_NS * 7 // 10  # too early for the tick to run
    for sequence in range(100):
        assert arrive(memory, sequence, now) == 0
    assert memory.shared[shared_memory.DEADLINE_NS] == now + PERIOD_NS * 7 // 10 - 2_000


def test_a_released_tissue_comes_to_rest_exactly(memory: shared_memory.Memory) -> None:
    for i in range(300):
        command(memory, i, (0.0, 0.0, 1e-3))
        tick(memory)
    scheduler.forget_command(memory.commands, 0)
    for _ in range(20_000):
        tick(memory)
        if not np.any(memory.coupling.running.patch.body.state):
            break
    np.testing.assert_array_equal(memory.coupling.running.patch.body.state, 0)
    ticks = int(memory.counters["ticks"][0])
    np.testing.assert_array_less(np.abs(memory.ring.ports["force_n"][ticks - 500 : ticks]), 1e-9)
    tick(memory)
    np.testing.assert_array_equal(memory.coupling.running.patch.body.state, 0)


def test_ticks_with_a_client_and_those_with_a_new_command_are_counted(memory: shared_memory.Memory) -> None:
    tick(memory)
    assert tallies(memory) == [0, 0]
    for i in range(10):
        command(memory, i, (0.0, 0.0, 0.0))
        tick(memory)
        tick(memory)  # without a new one
    assert tallies(memory) == [20, 10]
    scheduler.forget_command(memory.commands, 0)
    tick(memory)
    assert tallies(memory) == [20, 10]


def test_missed_ticks_are_made_up_for_and_too_many_are_skipped(memory: shared_memory.Memory) -> None:
    now = time.monotonic_ns()
    memory.shared[shared_memory.DEADLINE_NS] = now - 5 * PERIOD_NS - PERIOD_NS // 2
    assert arrive(memory, 1, now) == 6
    assert memory.counters["caught_up_ticks"][0] == 5
    flags = memory.ring.ports["flags"][:6, 0]
    np.testing.assert_array_equal(flags & int(Flags.CAUGHT_UP) > 0, [True] * 5 + [False])

    memory.shared[shared_memory.DEADLINE_NS] = now - 100 * PERIOD_NS - PERIOD_NS // 2
    assert arrive(memory, 2, now) == scheduler.MAX_CATCH_UP
    assert memory.counters["skipped_ticks"][0] == 101 - scheduler.MAX_CATCH_UP
    assert 0 < memory.shared[shared_memory.DEADLINE_NS] - now < PERIOD_NS


def test_the_deadline_loop_steps_once_each_period_of_wall_time(
    memory: shared_memory.Memory, stop_threads: Callable[[shared_memory.Memory, threading.Thread], None]
) -> None:
    wake = os.eventfd(0)
    memory.shared[shared_memory.DEADLINE_NS] = start = time.monotonic_ns()
    thread = threading.Thread(target=scheduler.run_at_deadlines, args=(image_of(memory), wake))
    stop_threads(memory, thread)
    thread.start()
    wait_for_ticks(memory, 400)
    scheduler.stop(memory.shared)
    thread.join()
    stopped = memory.shared[shared_memory.DEADLINE_NS]  # of the first tick that did not run
    ticks = memory.counters["ticks"][0] + memory.counters["skipped_ticks"][0]
    assert ticks == (stopped - start) // PERIOD_NS
    assert stopped - time.monotonic_ns() <= PERIOD_NS
    os.close(wake)


def wait_for_ticks(memory: shared_memory.Memory, count: int) -> None:
    give_up = time.monotonic() + 120  # the first one may have to be compiled
    while memory.counters["ticks"][0] < count:
        assert time.monotonic() < give_up, f"{memory.counters['ticks'][0]} ticks of {count}"
        time.sleep(0.005)


def test_the_deadline_loop_goes_on_while_python_is_busy(
    memory: shared_memory.Memory, stop_threads: Callable[[shared_memory.Memory, threading.Thread], None]
) -> None:
    wake = os.eventfd(0)
    thread = threading.Thread(target=scheduler.run_at_deadlines, args=(image_of(memory), wake))
    stop_threads(memory, thread)
    memory.shared[shared_memory.DEADLINE_NS] = time.monotonic_ns()
    thread.start()
    wait_for_ticks(memory, 1)
    before = int(memory.counters["ticks"][0])
    sum(range(50_000_000))  # one call that holds the GIL for a second
    assert memory.counters["ticks"][0] - before > 100
    scheduler.stop(memory.shared)
    thread.join()
    os.close(wake)


@njit(nogil=True)
def _write_to_all(image: Image, incoming: np.ndarray, first: int, stop: int) -> None:
    """Messages for all tools, every number of which is the sequence."""
    for i in range(first, stop):
        for tool in range(incoming.shape[0]):
            command = incoming[tool]
            command.tool = tool
            command.sequence = command.arrival_ns = i
            for j in range(3):
                command.position_m[j] = command.velocity_m_per_s[j] = i * 1e-9
        scheduler.hand_over(image, incoming.shape[0])


def _run_ticks(image: Image, n: int) -> None:
    for _ in range(n):
        repeat_tick(image, monotonic_ns())


def test_no_tick_sees_half_a_message_of_several_tools(
    make_spring_mass_model: Callable[..., ReducedModel],
) -> None:
    model = make_spring_mass_model(2)
    memory = shared_memory.make_memory(models.make_running(model), model.period_s, [FREE, FREE], 1 / 30)
    image = image_of(memory)
    incoming = memory.commands.incoming
    _write_to_all(image, incoming, 0, 1)
    _run_ticks(image, 1)
    enough = threading.Event()

    def write_on() -> None:
        first = 1
        while not enough.is_set():
            _write_to_all(image, incoming, first, first + 10_000)
            first += 10_000

    writer = threading.Thread(target=write_on, daemon=True)
    writer.start()
    seen: set[int] = set()
    give_up = time.monotonic() + 60
    try:
        while len(seen) < 1000:
            assert time.monotonic() < give_up
            _run_ticks(image, 1000)
            rows = (scheduler.records_written(memory.shared) - 1 - np.arange(1000)) % RECORDS
            ports = memory.ring.ports[rows]
            np.testing.assert_array_equal(ports["sequence"][:, 0], ports["sequence"][:, 1])
            for name in ("target_m", "velocity_m_per_s"):
                expected = np.broadcast_to(ports["sequence"][..., None] * 1e-9, ports[name].shape)
                np.testing.assert_array_equal(ports[name], expected)
            seen |= set(ports["sequence"][:, 0].tolist())
    finally:
        enough.set()
        writer.join()


def test_a_snapshot_belongs_to_one_tick(make_spring_mass_model: Callable[..., ReducedModel]) -> None:
    model = make_spring_mass_model()
    memory = shared_memory.make_memory(models.make_running(model), model.period_s, [FREE], 1e-3)
    system: StateSpace = model.discrete
    expected = np.zeros(system.order)
    state, applied = np.zeros(system.order), np.zeros((1, 3))
    for i in range(50):
        command(memory, i, (1e-3 * i, 0.0, 0.0))
        tick(memory)
        assert scheduler.read_snapshot(image_of(memory), state, applied) == i
        np.testing.assert_allclose(state, expected, rtol=1e-12, atol=1e-18)
        expected = dense_a(system) @ expected + system.b @ applied.ravel()


def test_a_force_that_is_no_number_never_reaches_the_device_and_the_next_client_starts_clean(
    memory: shared_memory.Memory,
) -> None:
    """The last check before the wire, whatever the terms of a contact were: here a limit that is not a number."""
    image = image_of(memory)
    broken = np.array(FREE._replace(max_damping_n_s_per_m=float("nan")))
    scheduler.set_limits(image, 0, broken)
    faults = memory.counters["faults"][0]
    for i in range(300):
        command(memory, i, (1e-3 * np.sin(0.3 * i), 0.0, 0.0))
        _, _, force, _ = tick(memory)
        assert np.all(np.isfinite(force))
    seen = memory.counters["faults"][0] - faults
    assert seen > 0
    scheduler.set_limits(image, 0, np.array(FREE))
    for i in range(300, 600):
        command(memory, i, (1e-3 * np.sin(0.3 * i), 0.0, 0.0))
        flags, _, force, scale = tick(memory)
        assert np.all(np.isfinite(force))
    assert not flags & Flags.FAULT
    assert scale == 1
    assert np.any(force)


def test_a_record_says_how_a_tool_of_a_patch_touches_and_what_work_it_did(
    spring: shared_memory.Memory,
) -> None:
    """A bare spring: its energy is known. The record's work less what was withheld is the work against the force sent."""
    home = np.array((0.1, 0.0, 0.0))
    hand_over(spring, 2.0, (0.1, 0.0, 0.0))
    rendered, steps, applied = 0.0, 0.0, home.copy()
    for i in range(400):
        depth = 1e-3 * np.sin(2 * np.pi * i / 300)
        command(spring, i, tuple(home - (0.0, 0.0, depth)))
        tick(spring)
        record = newest(spring)
        position, force = record["position_m"][0].copy(), record["force_n"][0]
        rendered -= force @ (position - applied)
        steps += float(np.sum((position - applied) ** 2))
        applied = position
    work, withheld = record["work_j"][0], record["withheld_j"][0]
    assert work - withheld == pytest.approx(rendered, rel=1e-12)
    # The sum of K x_n (x_n - x_(n-1)) is 1/2 K x^2 and half of K times the squared steps; twice as far in the model.
    energy = 0.5 * SPRING_N_PER_M * 2.0**2 * (np.sum((applied - home) ** 2) + steps)
    assert work == pytest.approx(energy, rel=1e-9)
    assert withheld > 0  # the soft start
    assert record["penetration_m"][0] == pytest.approx((home - applied)[2])
    assert record["n_contact_points"][0] == 1
    assert not record["flags"][0] & (Flags.IN_CONTACT | Flags.SLIDING | Flags.ATTACHED)
    scheduler.forget_command(spring.commands, 0)
    scheduler.reset(make_image(spring))
    tick(spring)
    assert newest(spring)["work_j"][0] == 0.0
