"""The tick, driven by hand: the test says when commands arrive and when deadlines pass."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Iterator

import numpy as np
import pytest
from numba import njit

from palpate.model_file import ReducedModel, StateSpace
from palpate_server.realtime import atomics, safety, scheduler, shared_memory
from palpate_server.realtime.clock import monotonic_ns
from palpate_server.realtime.native_image import Image, make_image
from palpate_server.realtime.safety import Flags, Limits

FREE = Limits(1e6, 1e12, 1e6, 1e6, 0.0)  # limits that nothing here reaches
PERIOD_NS = 1_000_000


def now_ns(memory: shared_memory.Memory) -> int:
    """When the next tick begins: a period after the last one, however long the test takes."""
    return (1000 + int(memory.counters[shared_memory.TICKS])) * PERIOD_NS


def command(
    memory: shared_memory.Memory, sequence: int, target: tuple[float, float, float], age_ns: int = 0
) -> None:
    lease = int(memory.commands.lease[0])
    scheduler.write_command(
        memory.commands, 0, sequence, 7, now_ns(memory) - age_ns, -1, lease, target, (0.0, 0.0, 0.0)
    )


def tick(memory: shared_memory.Memory) -> tuple[int, np.ndarray, np.ndarray, float]:
    """Run one tick; its flags, applied displacement, force and scale."""
    scheduler.repeat_tick(make_image(memory), now_ns(memory))
    row = (scheduler.records_written(memory.shared) - 1) % shared_memory.RECORDS
    motion = memory.record_motion[row, 0]
    flags = int(memory.record_inputs[row, 0, shared_memory.CONTACT_FLAGS])
    return flags, motion[0:3].copy(), motion[3:6].copy(), float(motion[shared_memory.SCALE])


@pytest.fixture
def memory(make_spring_mass_model: Callable[..., ReducedModel]) -> shared_memory.Memory:
    model = make_spring_mass_model()
    return shared_memory.make_memory(model.discrete, model.period_s, [FREE], 1 / 30)


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
    echoed = memory.record_inputs[:3, 0, :3]
    np.testing.assert_array_equal(echoed[0, :2], (1, 7))
    np.testing.assert_array_equal(echoed[1:], -1)


def test_forces_are_the_discrete_models_response_to_the_applied_displacements(
    memory: shared_memory.Memory, make_spring_mass_model: Callable[..., ReducedModel]
) -> None:
    system = make_spring_mass_model().discrete
    state = np.zeros(system.order)
    for i in range(500):
        command(memory, i, (1e-3 * np.sin(0.1 * i), 2e-3 * np.cos(0.03 * i), 1e-4 * i))
        _, applied, force, scale = tick(memory)
        expected = system.c @ state + system.d @ applied
        state = system.dense_a() @ state + system.b @ applied
        np.testing.assert_allclose(force, scale * expected, rtol=0, atol=1e-12)
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
        model.discrete, model.period_s, [FREE._replace(max_speed_m_per_s=0.5)], 1 / 30
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
    memory.model.state[0] = np.nan
    flags, _, force, scale = tick(memory)
    assert flags & Flags.FAULT
    assert scale == 0
    np.testing.assert_array_equal(force, 0)
    assert memory.counters[shared_memory.FAULTS] == 1
    flags, _, force, _ = tick(memory)
    assert not flags & Flags.FAULT
    assert np.all(np.isfinite(force))


def test_commands_and_forces_are_in_the_holders_frame(
    memory: shared_memory.Memory, make_spring_mass_model: Callable[..., ReducedModel]
) -> None:
    system = make_spring_mass_model().discrete
    rotation = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    scale, origin = 2.0, np.array([0.1, 0.0, 0.0])
    scheduler.set_frame(make_image(memory), 0, rotation, scale, origin)
    state = np.zeros(system.order)
    for i in range(300):
        position = origin + 1e-3 * np.sin(0.1 * i) * np.array([1.0, 0.5, -0.2])
        command(memory, i, tuple(position))
        _, applied, force, fade = tick(memory)
        np.testing.assert_allclose(applied, position)
        displacement = scale * rotation @ (applied - origin)
        expected = scale * rotation.T @ (system.c @ state + system.d @ displacement)
        state = system.dense_a() @ state + system.b @ displacement
        np.testing.assert_allclose(force, fade * expected, rtol=0, atol=1e-11)


USUAL = Limits(10.0, 2000.0, 1.0, 0.1, 0.0)
SPRING_N_PER_M = 1000.0


@pytest.fixture
def spring() -> shared_memory.Memory:
    """A spring without memory: what it gives is the displacement of this very tick."""
    nothing = np.zeros(2), np.zeros(2), np.zeros((2, 3)), np.zeros((3, 2))
    return shared_memory.make_memory(StateSpace(*nothing, SPRING_N_PER_M * np.eye(3)), 1e-3, [USUAL], 1 / 30)


def hand_over(memory: shared_memory.Memory, scale: float, origin: tuple[float, float, float]) -> None:
    """What acquiring does: silence, then the next holder's frame."""
    image = make_image(memory)
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
    np.testing.assert_allclose(force, (0.0, 0.0, 1e-3 * SPRING_N_PER_M))
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
    scheduler.reset(make_image(spring))
    command(spring, 299, (0.0, 0.0, 0.05))
    _, _, before, _ = tick(spring)
    assert spring.energy[0] == 0  # the device has not moved
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
    image = make_image(spring)
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
        shared_memory.make_memory(model.discrete, model.period_s, [usual, usual], 1 / 30) for _ in range(2)
    )
    huge = (sign * 1.797e308,) * 3
    for i in range(300):
        now = now_ns(memory)
        good = (0.0, 0.0, 1e-3)
        for m in (memory, undisturbed):
            scheduler.write_command(m.commands, 1, i, 7, now, -1, 0, good, (0.0, 0.0, 0.0))
            scheduler.write_command(m.commands, 0, i, 7, now, -1, 0, good, (0.0, 0.0, 0.0))
        if i >= 250:
            scheduler.write_command(memory.commands, 0, i, 7, now - 5_000_000, -1, 0, huge, huge)
        for m in (memory, undisturbed):
            tick(m)
    row = (scheduler.records_written(memory.shared) - 1) % shared_memory.RECORDS
    np.testing.assert_array_equal(memory.record_motion[row, 0, 0:3], (0.0, 0.0, 1e-3))
    np.testing.assert_array_equal(memory.record_motion[row], undisturbed.record_motion[row])
    assert np.any(memory.record_motion[row, 1, 3:6])
    assert memory.counters[shared_memory.FAULTS] == 0


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
        scheduler.write_command(memory.commands, 0, 1, 7, arrival, -1, 0, (1e-3, 0.0, 0.0), (0.1, 0.0, 0.0))
        _, applied, *_ = tick(memory)
        assert applied[0] == pytest.approx(1e-3 + carried_m, rel=1e-12)


def test_energy_counts_the_force_that_the_device_was_rendering(memory: shared_memory.Memory) -> None:
    forces, positions = [], []
    expected = 0.0
    for i in range(100):
        position = (0.0, 0.0, 1e-3 * np.sin(0.2 * i))
        rendered = i - 3 if i >= 3 else -1  # a device that is three ticks behind
        scheduler.write_command(
            memory.commands, 0, i, 7, now_ns(memory), rendered, 0, position, (0.0, 0.0, 0.0)
        )
        _, applied, force, _ = tick(memory)
        if i:
            step = applied[2] - positions[-1]
            expected += (forces[rendered] if rendered >= 0 else forces[-1]) * step
        forces.append(force[2])
        positions.append(applied[2])
    row = (scheduler.records_written(memory.shared) - 1) % shared_memory.RECORDS
    np.testing.assert_allclose(memory.record_motion[row, 0, shared_memory.ENERGY_J], expected, rtol=1e-9)


def test_energy_is_that_of_the_device_also_while_the_tip_is_let_after_it_slowly(
    spring: shared_memory.Memory,
) -> None:
    """A limit of the speed makes of a passive spring one that gives out energy: the observer has to see it."""
    spring.limits[0, shared_memory.MAX_SPEED] = 0.17
    spring.limits[0, shared_memory.MAX_FORCE] = spring.limits[0, shared_memory.MAX_FORCE_RATE] = 1e6
    energy, force, before = 0.0, np.zeros(3), 0.0
    limited = False
    for i in range(3000):
        position = 0.008 * np.sin(2 * np.pi * 5 * i * 1e-3)
        command(spring, i, (0.0, 0.0, position))
        energy += force[2] * (position - before)
        before = position
        flags, _, force, _ = tick(spring)
        limited = limited or bool(flags & Flags.SPEED_LIMITED)
    assert limited
    assert energy < -0.1
    np.testing.assert_allclose(spring.energy[0], energy, rtol=1e-9)


def test_a_command_of_a_hold_that_is_over_is_not_carried_out(memory: shared_memory.Memory) -> None:
    now = now_ns(memory)
    scheduler.forget_command(memory.commands, 0)
    scheduler.write_command(memory.commands, 0, 5, 7, now, -1, 0, (0.0, 0.0, 1e-3), (0.0, 0.0, 0.0))
    flags, applied, _, scale = tick(memory)
    assert flags == Flags.STALE
    np.testing.assert_array_equal(applied, 0)
    scheduler.write_command(memory.commands, 0, 1, 7, now, -1, 1, (0.0, 0.0, 1e-3), (0.0, 0.0, 0.0))
    flags, applied, _, scale = tick(memory)
    assert scale > 0
    np.testing.assert_array_equal(applied, (0.0, 0.0, 1e-3))


def test_a_change_that_is_withdrawn_is_not_made(memory: shared_memory.Memory) -> None:
    image = make_image(memory)
    scheduler.set_limits(image, 0, np.full(5, 2.0))
    assert scheduler.withdraw_change(image)
    tick(memory)
    np.testing.assert_array_equal(memory.limits[0], FREE)
    scheduler.set_limits(image, 0, np.full(5, 2.0))
    tick(memory)
    assert not scheduler.withdraw_change(image)
    np.testing.assert_array_equal(memory.limits[0], 2.0)


def test_a_client_that_hovers_at_the_surface_does_not_leave_the_state_to_decay_for_ever(
    memory: shared_memory.Memory,
) -> None:
    for i in range(300):
        command(memory, i, (0.0, 0.0, 1e-3))
        tick(memory)
    for i in range(300, 20_000):
        command(memory, i, (0.0, 0.0, 0.0))
        tick(memory)
        if not np.any(memory.model.state):
            break
    assert not np.any(memory.model.state)
    assert memory.counters[shared_memory.AT_REST_SINCE] == -1  # somebody is there


def test_reset_puts_the_model_to_rest_and_lets_the_force_fade_in_again(
    memory: shared_memory.Memory, make_spring_mass_model: Callable[..., ReducedModel]
) -> None:
    for i in range(250):
        command(memory, i, (0.0, 0.0, 1e-3))
        tick(memory)
    assert np.any(memory.model.state)
    scheduler.reset(make_image(memory))
    assert scheduler.changed_at(make_image(memory)) == -1
    command(memory, 250, (0.0, 0.0, 1e-3))
    flags, applied, _, scale = tick(memory)
    assert scheduler.changed_at(make_image(memory)) == 250
    np.testing.assert_allclose(memory.force[0], make_spring_mass_model().discrete.d @ applied, rtol=1e-12)
    assert flags & Flags.SOFT_START
    assert scale < 0.01


def test_another_model_is_faded_in_where_it_settles(
    memory: shared_memory.Memory, make_spring_mass_model: Callable[..., ReducedModel]
) -> None:
    position = (1e-3, -2e-3, 3e-3)
    running = make_spring_mass_model().discrete
    for i in range(300):
        if i == 250:  # the soft start is over: the running model has settled too
            memory.model.state[:] = shared_memory.make_model(running, np.array(position)).state
        command(memory, i, position)
        *_, before, _ = tick(memory)
    other = make_spring_mass_model(1, 7).discrete
    following = shared_memory.make_model(other, np.array(position))
    settled = following.state.copy()
    np.testing.assert_allclose(other.dense_a() @ settled + other.b @ np.array(position), settled, atol=1e-15)

    image = make_image(memory)
    fading = memory._replace(next_model=following, fade=np.array([0.0, 0.01]))
    scheduler.exchange(image, make_image(fading))
    forces = [before]
    for i in range(300, 400):
        command(memory, i, position)
        scheduler.repeat_tick(image, now_ns(memory))
        forces.append(memory.device_force[0].copy())
    final = other.c @ settled + other.d @ np.array(position)
    np.testing.assert_allclose(forces[-1], final, rtol=1e-9)
    expected = before + np.linspace(0, 1, 101)[:, None] * (final - before)
    np.testing.assert_allclose(forces, expected, rtol=0, atol=1e-6 * np.abs(final).max())

    done = memory._replace(model=following, snapshot_state=np.zeros(other.order))
    scheduler.exchange(image, make_image(done))
    command(memory, 400, position)
    scheduler.repeat_tick(image, now_ns(memory))
    np.testing.assert_allclose(memory.device_force[0], final, rtol=1e-9)


def test_an_early_command_waits_for_the_tick_and_a_second_one_replaces_it(
    memory: shared_memory.Memory,
) -> None:
    now = time.monotonic_ns()
    memory.shared[shared_memory.DEADLINE_NS] = now + PERIOD_NS - 100_000
    command(memory, 1, (0.0, 0.0, 1e-3))
    assert scheduler.tick_on_arrival(make_image(memory), now) == 0
    command(memory, 2, (0.0, 0.0, 2e-3))
    assert scheduler.tick_on_arrival(make_image(memory), now + PERIOD_NS * 6 // 10) == 1
    assert memory.record_inputs[0, 0, shared_memory.SEQUENCE] == 2
    assert (
        scheduler.tick_on_arrival(make_image(memory), now + PERIOD_NS * 7 // 10) == 0
    )  # one tick each period


def test_deadlines_settle_a_quarter_of_a_period_behind_steady_arrivals(memory: shared_memory.Memory) -> None:
    start = time.monotonic_ns()
    for offset in (0, 170_000, 480_000, 730_000, 999_000):
        memory.shared[shared_memory.DEADLINE_NS] = start + offset
        ticks = 0
        for i in range(600):
            ticks += scheduler.tick_on_arrival(make_image(memory), start + i * PERIOD_NS)
        phase = (memory.shared[shared_memory.DEADLINE_NS] - start) % PERIOD_NS
        assert abs(phase - PERIOD_NS // 4) < PERIOD_NS // 50
        assert abs(ticks - 600) <= 1


def test_a_burst_moves_the_deadlines_no_more_than_one_command_does(memory: shared_memory.Memory) -> None:
    image = make_image(memory)
    now = time.monotonic_ns()
    memory.shared[shared_memory.DEADLINE_NS] = now + PERIOD_NS * 7 // 10  # too early for the tick to run
    for _ in range(100):
        assert scheduler.tick_on_arrival(image, now) == 0
    assert memory.shared[shared_memory.DEADLINE_NS] == now + PERIOD_NS * 7 // 10 - 2_000


def test_a_released_tissue_comes_to_rest_exactly_and_a_touch_ends_that(memory: shared_memory.Memory) -> None:
    assert memory.counters[shared_memory.AT_REST_SINCE] == 0
    for i in range(300):
        command(memory, i, (0.0, 0.0, 1e-3))
        tick(memory)
        assert memory.counters[shared_memory.AT_REST_SINCE] == -1
    scheduler.forget_command(memory.commands, 0)
    for _ in range(20_000):
        tick(memory)
        if memory.counters[shared_memory.AT_REST_SINCE] >= 0:
            break
        assert np.any(memory.model.state)
    np.testing.assert_array_equal(memory.model.state, 0)
    ticks = int(memory.counters[shared_memory.TICKS])
    assert memory.counters[shared_memory.AT_REST_SINCE] == ticks
    np.testing.assert_array_less(np.abs(memory.record_motion[ticks - 500 : ticks, 0, 3:6]), 1e-9)
    tick(memory)
    np.testing.assert_array_equal(memory.model.state, 0)
    assert memory.counters[shared_memory.AT_REST_SINCE] == ticks
    command(memory, 300, (0.0, 0.0, 1e-3))
    tick(memory)
    assert memory.counters[shared_memory.AT_REST_SINCE] == -1


def test_ticks_with_a_client_and_those_with_a_new_command_are_counted(memory: shared_memory.Memory) -> None:
    tick(memory)
    np.testing.assert_array_equal(memory.tallies, [[0, 0]])
    for i in range(10):
        command(memory, i, (0.0, 0.0, 0.0))
        tick(memory)
        tick(memory)  # without a new one
    np.testing.assert_array_equal(memory.tallies, [[20, 10]])
    scheduler.forget_command(memory.commands, 0)
    tick(memory)
    np.testing.assert_array_equal(memory.tallies, [[20, 10]])


def test_missed_ticks_are_made_up_for_and_too_many_are_skipped(memory: shared_memory.Memory) -> None:
    now = time.monotonic_ns()
    memory.shared[shared_memory.DEADLINE_NS] = now - 5 * PERIOD_NS - PERIOD_NS // 2
    assert scheduler.tick_on_arrival(make_image(memory), now) == 6
    assert memory.counters[shared_memory.CAUGHT_UP_TICKS] == 5
    flags = memory.record_inputs[:6, 0, shared_memory.CONTACT_FLAGS]
    np.testing.assert_array_equal(flags & int(Flags.CAUGHT_UP) > 0, [True] * 5 + [False])

    memory.shared[shared_memory.DEADLINE_NS] = now - 100 * PERIOD_NS - PERIOD_NS // 2
    assert scheduler.tick_on_arrival(make_image(memory), now) == scheduler.MAX_CATCH_UP
    assert memory.counters[shared_memory.SKIPPED_TICKS] == 101 - scheduler.MAX_CATCH_UP
    assert 0 < memory.shared[shared_memory.DEADLINE_NS] - now < PERIOD_NS


def test_the_deadline_loop_steps_once_each_period_of_wall_time(
    memory: shared_memory.Memory, stop_threads: Callable[[shared_memory.Memory, threading.Thread], None]
) -> None:
    wake = os.eventfd(0)
    memory.shared[shared_memory.DEADLINE_NS] = start = time.monotonic_ns()
    thread = threading.Thread(target=scheduler.run_at_deadlines, args=(make_image(memory), wake))
    stop_threads(memory, thread)
    thread.start()
    wait_for_ticks(memory, 400)
    scheduler.stop(memory.shared)
    thread.join()
    stopped = memory.shared[shared_memory.DEADLINE_NS]  # of the first tick that did not run
    ticks = memory.counters[shared_memory.TICKS] + memory.counters[shared_memory.SKIPPED_TICKS]
    assert ticks == (stopped - start) // PERIOD_NS
    assert stopped - time.monotonic_ns() <= PERIOD_NS
    os.close(wake)


def wait_for_ticks(memory: shared_memory.Memory, count: int) -> None:
    give_up = time.monotonic() + 120  # the first one may have to be compiled
    while memory.counters[shared_memory.TICKS] < count:
        assert time.monotonic() < give_up, f"{memory.counters[shared_memory.TICKS]} ticks of {count}"
        time.sleep(0.005)


def test_the_deadline_loop_goes_on_while_python_is_busy(
    memory: shared_memory.Memory, stop_threads: Callable[[shared_memory.Memory, threading.Thread], None]
) -> None:
    wake = os.eventfd(0)
    thread = threading.Thread(target=scheduler.run_at_deadlines, args=(make_image(memory), wake))
    stop_threads(memory, thread)
    memory.shared[shared_memory.DEADLINE_NS] = time.monotonic_ns()
    thread.start()
    wait_for_ticks(memory, 1)
    before = int(memory.counters[shared_memory.TICKS])
    sum(range(50_000_000))  # one call that holds the GIL for a second
    assert memory.counters[shared_memory.TICKS] - before > 100
    scheduler.stop(memory.shared)
    thread.join()
    os.close(wake)


@njit(nogil=True)
def _write_pairs(commands: shared_memory.Commands, n: int) -> None:
    for i in range(n):
        pair = (float(i), float(i), float(i))
        scheduler.write_command(commands, 0, i, i, i, -1, 0, pair, pair)


@njit(nogil=True)
def _count_torn(commands: shared_memory.Commands, n: int) -> tuple[int, int]:
    torn = whole = 0
    for _ in range(n):
        version = atomics.begin_read(commands.versions, 0)
        sequence = commands.integers[shared_memory.NEWEST, 0, 0]
        arrival = commands.integers[shared_memory.NEWEST, 0, 2]
        x, z = commands.motion[shared_memory.NEWEST, 0, 0], commands.motion[shared_memory.NEWEST, 0, 2]
        if atomics.is_whole(commands.versions, 0, version):
            whole += 1
            if not (sequence == arrival and x == z and x == float(sequence)):
                torn += 1
    return torn, whole


def test_a_reader_never_sees_half_a_command(memory: shared_memory.Memory) -> None:
    _write_pairs(memory.commands, 1)
    _count_torn(memory.commands, 1)
    writer = threading.Thread(target=_write_pairs, args=(memory.commands, 20_000_000))
    writer.start()
    torn, whole = 0, 0
    while writer.is_alive():
        more_torn, more_whole = _count_torn(memory.commands, 100_000)
        torn, whole = torn + more_torn, whole + more_whole
    writer.join()
    assert whole > 1000
    assert torn == 0


@njit(nogil=True)
def _write_to_both(commands: shared_memory.Commands, first: int, stop: int) -> None:
    for i in range(first, stop):
        now = monotonic_ns()
        there = (0.0, 0.0, 1e-3 * (i % 2))
        scheduler.stage_command(commands, 1, i, 7, now, -1, 0, there, there)
        scheduler.write_command(commands, 0, i, 7, now, -1, 0, there, there)


@njit(nogil=True)
def _run_ticks(image: Image, n: int) -> None:
    for _ in range(n):
        scheduler.repeat_tick(image, monotonic_ns())


def test_no_tick_comes_between_two_contacts_of_a_command(
    make_spring_mass_model: Callable[..., ReducedModel],
) -> None:
    model = make_spring_mass_model(2)
    memory = shared_memory.make_memory(model.discrete, model.period_s, [FREE, FREE], 1 / 30)
    image = make_image(memory)
    _write_to_both(memory.commands, 0, 1)
    _run_ticks(image, 1)
    enough = threading.Event()

    def write() -> None:
        first = 1
        while not enough.is_set():
            _write_to_both(memory.commands, first, first + 10_000)
            first += 10_000

    writer = threading.Thread(target=write, daemon=True)
    writer.start()
    seen: set[int] = set()
    give_up = time.monotonic() + 60
    try:
        while len(seen) < 1000:
            assert time.monotonic() < give_up
            _run_ticks(image, 1000)
            rows = (scheduler.records_written(memory.shared) - 1 - np.arange(1000)) % shared_memory.RECORDS
            sequences = memory.record_inputs[rows, :, shared_memory.SEQUENCE]
            np.testing.assert_array_equal(sequences[:, 0], sequences[:, 1])
            np.testing.assert_array_equal(memory.newest_integers[0], memory.newest_integers[1])
            np.testing.assert_array_equal(memory.target[0], memory.target[1])
            seen |= set(sequences[:, 0].tolist())
    finally:
        enough.set()
        writer.join()


def test_a_command_that_is_staged_waits_for_the_rest_and_for_a_lease_that_still_holds(
    make_spring_mass_model: Callable[..., ReducedModel],
) -> None:
    model = make_spring_mass_model(2)
    memory = shared_memory.make_memory(model.discrete, model.period_s, [FREE, FREE], 1 / 30)
    image, still = make_image(memory), (0.0, 0.0, 0.0)

    def sequences() -> list[int]:
        scheduler.repeat_tick(image, time.monotonic_ns())
        row = (scheduler.records_written(memory.shared) - 1) % shared_memory.RECORDS
        return list(memory.record_inputs[row, :, shared_memory.SEQUENCE])

    scheduler.stage_command(memory.commands, 0, 1, 7, 1, -1, 0, still, still)
    assert sequences() == [-1, -1]
    scheduler.write_command(memory.commands, 1, 1, 7, 1, -1, 0, still, still)
    assert sequences() == [1, 1]
    scheduler.write_command(memory.commands, 1, 2, 7, 1, -1, 0, still, still)
    assert sequences() == [1, 2]  # what was staged once is handed over once
    scheduler.stage_command(memory.commands, 0, 3, 7, 1, -1, 0, still, still)
    scheduler.forget_command(memory.commands, 0)
    scheduler.write_command(memory.commands, 1, 3, 7, 1, -1, 0, still, still)
    assert sequences() == [-1, 3]


def test_a_snapshot_belongs_to_one_tick(make_spring_mass_model: Callable[..., ReducedModel]) -> None:
    model = make_spring_mass_model()
    memory = shared_memory.make_memory(model.discrete, model.period_s, [FREE], 1e-3)
    system: StateSpace = model.discrete
    expected = np.zeros(system.order)
    state, applied = np.zeros(system.order), np.zeros((1, 3))
    for i in range(50):
        command(memory, i, (1e-3 * i, 0.0, 0.0))
        tick(memory)
        assert scheduler.read_snapshot(make_image(memory), state, applied) == i
        np.testing.assert_allclose(state, expected, rtol=1e-12, atol=1e-18)
        expected = system.dense_a() @ expected + system.b @ applied.ravel()


def test_a_force_that_is_no_number_never_reaches_the_device_and_the_next_client_starts_clean(
    memory: shared_memory.Memory,
) -> None:
    """The last check before the wire, whatever the terms of a contact were: here a limit that is not a number."""
    image = make_image(memory)
    broken = np.array(FREE._replace(max_damping_n_s_per_m=float("nan")))
    scheduler.set_limits(image, 0, broken)
    faults = memory.counters[shared_memory.FAULTS]
    for i in range(300):
        command(memory, i, (1e-3 * np.sin(0.3 * i), 0.0, 0.0))
        _, _, force, _ = tick(memory)
        assert np.all(np.isfinite(force))
    seen = memory.counters[shared_memory.FAULTS] - faults
    assert seen > 0
    scheduler.set_limits(image, 0, np.array(FREE))
    for i in range(300, 600):
        command(memory, i, (1e-3 * np.sin(0.3 * i), 0.0, 0.0))
        flags, _, force, scale = tick(memory)
        assert np.all(np.isfinite(force))
    assert not flags & Flags.FAULT
    assert scale == 1
    assert np.any(force)
