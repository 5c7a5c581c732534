"""The simulated device against the exact theory of a sampled, delayed spring."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.optimize import brentq

from device_trace import Trace, steady_trace, trace_of
from palpate.model_file import ReducedModel, StateSpace
from palpate_server.diagnostics.round_trips import ReceivedForce
from palpate_server.realtime import shared_memory
from simulated_device import Handle, comes_to_rest, press

PERIOD_S = 1e-3
TICKS = 8000
REACH_M = 0.005 * np.minimum(1.0, np.arange(TICKS) / 400)
HANDLE = Handle(mass_kg=0.1, damping_n_s_per_m=1.0)
DAMPING = HANDLE.damping_n_s_per_m + HANDLE.hand_n_s_per_m


def loop_matrix(stiffness: float, late: int) -> np.ndarray:
    """The loop of a handle in a hand and a spring whose force is held between ticks and `late` of them old.

    State: position, velocity, and the `late` positions before, newest first; (2 + late, 2 + late)
    """
    rates = np.zeros((3, 3))  # position, velocity, force of the spring
    rates[0, 1] = 1.0
    rates[1] = np.array([-HANDLE.hand_n_per_m, -DAMPING, -1.0]) / HANDLE.mass_kg
    held = expm(rates * PERIOD_S)
    matrix = np.zeros((2 + late, 2 + late))
    matrix[:2, :2] = held[:2, :2]
    matrix[:2, -1] = held[:2, 2] * stiffness
    matrix[2, 0] = 1.0
    matrix[3:, 2:-1] = np.eye(late - 1)
    return matrix


def critical_stiffness(late: int) -> float:
    """Above it the loop is unstable, N/m."""

    def growth(stiffness: float) -> float:
        return float(np.abs(np.linalg.eigvals(loop_matrix(stiffness, late))).max()) - 1.0

    return float(brentq(growth, 1.0, 1e5))


@pytest.fixture
def spring(make_spring_mass_model: Callable[..., ReducedModel]) -> Callable[[float], ReducedModel]:
    def make(stiffness: float) -> ReducedModel:
        discrete = StateSpace(
            np.zeros(0), np.zeros(0), np.zeros((0, 3)), np.zeros((3, 0)), stiffness * np.eye(3)
        )
        return replace(make_spring_mass_model(), discrete=discrete)

    return make


@pytest.mark.parametrize("late", [1, 2, 3])
def test_a_handle_on_a_delayed_spring_moves_as_the_sampled_loop_does(
    spring: Callable[[float], ReducedModel], late: int
) -> None:
    stiffness = 0.5 * critical_stiffness(late)
    motion = press(spring(stiffness), HANDLE, REACH_M, steady_trace(TICKS, late), 0.0)
    begin = 500  # the hand has arrived and the force has faded in
    assert motion[begin - late :, 0].min() > 0
    matrix = loop_matrix(stiffness, late)
    rest = HANDLE.hand_n_per_m * REACH_M[-1] / (HANDLE.hand_n_per_m + stiffness)
    state = np.array([*motion[begin], *motion[begin - late : begin, 0][::-1]])
    state -= rest * np.array([1.0, 0.0, *np.ones(late)])
    expected = []
    for _ in range(500):
        expected.append(state[:2] + np.array([rest, 0.0]))
        state = matrix @ state
    assert np.ptp(np.array(expected)[:, 0]) > 1e-6
    # Rounding: some 1e-16 of some millimeters and of their velocities a tick, not amplified by a stable loop.
    np.testing.assert_allclose(motion[begin : begin + 500], expected, rtol=0, atol=1e-11)


@pytest.mark.parametrize("late", [1, 2, 3])
def test_a_spring_is_unstable_above_the_stiffness_at_which_an_eigenvalue_leaves_the_unit_circle(
    spring: Callable[[float], ReducedModel], late: int
) -> None:
    critical = critical_stiffness(late)
    for share, stable in ((0.85, True), (1.15, False)):
        motion = press(spring(share * critical), HANDLE, REACH_M, steady_trace(TICKS, late), 0.0)
        assert comes_to_rest(motion[:, 0]) == stable


@pytest.mark.parametrize("late", [1, 2, 3])
def test_colgate_and_schenkels_bound_is_inside_the_stable_region_and_close_to_its_edge_for_a_spring(
    late: int,
) -> None:
    delay = PERIOD_S / 2 + late * PERIOD_S
    bound = DAMPING / delay
    critical = critical_stiffness(late)
    assert bound < critical
    # A force K x held and late turns its phase by w times the delay: it takes K sin(w delay) / w of the damping away, which the
    # bound has as K delay, and is weaker by (wT)²/24 for being held.
    squared = (critical + HANDLE.hand_n_per_m) / HANDLE.mass_kg
    assert critical == pytest.approx(bound * (1 + squared * delay**2 / 6), rel=squared * PERIOD_S**2 / 12)


@pytest.mark.parametrize("late", [1, 2, 3])
def test_a_measured_trace_with_an_even_delay_gives_exactly_what_that_delay_gives(
    make_spring_mass_model: Callable[..., ReducedModel], late: int
) -> None:
    sent = [k * 1_000_000 for k in range(800)]
    # Half a millisecond before the device's tick at which the force is the newest, in a server long since started.
    heard = [
        ReceivedForce(sent_ns + late * 1_000_000 - 500_000, 5000 + k, sent_ns + 200_000, k + 1, 50_000)
        for k, sent_ns in enumerate(sent)
    ]
    measured = press(make_spring_mass_model(), HANDLE, REACH_M[:800], trace_of(sent, heard), 4.0)
    steady = press(make_spring_mass_model(), HANDLE, REACH_M[:800], steady_trace(800, late), 4.0)
    np.testing.assert_array_equal(measured, steady)


def test_a_command_that_the_server_never_used_is_never_felt_and_a_lost_force_never_rendered(
    spring: Callable[[float], ReducedModel],
) -> None:
    steady = steady_trace(400, 1)
    used = steady.used.copy()
    used[300] = 299  # held: command 300 was superseded
    rendered = steady.rendered.copy()
    rendered[351] = rendered[350]  # lost: once more the force before
    motion = press(spring(200.0), HANDLE, REACH_M[:400], replace(steady, used=used, rendered=rendered), 0.0)[
        :, 0
    ]
    undisturbed = press(spring(200.0), HANDLE, REACH_M[:400], steady, 0.0)[:, 0]
    apart = motion != undisturbed
    assert not apart[:302].any()
    # The position after a tick with a force that is too small by dF is off by (dF / m) T²/2, but for damping and hand.
    missing = 200.0 * (undisturbed[300] - undisturbed[299])
    assert motion[302] - undisturbed[302] == pytest.approx(missing / 0.1 * PERIOD_S**2 / 2, rel=0.01)
    lost_only = press(spring(200.0), HANDLE, REACH_M[:400], replace(steady, rendered=rendered), 0.0)[:, 0]
    missing = 200.0 * (undisturbed[350] - undisturbed[349])
    assert not (lost_only != undisturbed)[:352].any()
    assert lost_only[352] - undisturbed[352] == pytest.approx(missing / 0.1 * PERIOD_S**2 / 2, rel=0.01)


def test_outside_the_tissue_the_handle_is_free_though_forces_are_still_under_way(
    spring: Callable[[float], ReducedModel],
) -> None:
    reach = np.where(np.arange(1000) < 500, 0.005, -0.005)
    motion = press(spring(300.0), HANDLE, reach, steady_trace(1000, 3), 0.0)
    left = 500 + int(np.argmax(motion[500:, 0] <= 0))
    assert motion[left - 3 : left, 0].min() > 0
    free = expm(
        np.array([[0.0, 1.0], [-HANDLE.hand_n_per_m / HANDLE.mass_kg, -DAMPING / HANDLE.mass_kg]]) * PERIOD_S
    )
    for before, after in zip(motion[left : left + 3], motion[left + 1 : left + 4], strict=True):
        expected = free @ (before - [-0.005, 0.0]) + [-0.005, 0.0]
        np.testing.assert_allclose(after, expected, rtol=1e-12)


def test_the_server_is_told_which_force_was_rendered_so_that_it_counts_the_ports_energy_despite_the_delay(
    spring: Callable[[float], ReducedModel], monkeypatch: pytest.MonkeyPatch
) -> None:
    memories: list[shared_memory.Memory] = []
    make_memory = shared_memory.make_memory

    def keep(*arguments: Any) -> shared_memory.Memory:
        memories.append(make_memory(*arguments))
        return memories[-1]

    monkeypatch.setattr(shared_memory, "make_memory", keep)
    late, begin, end = 3, 500, 900
    motion = press(spring(300.0), HANDLE, REACH_M[:1000], steady_trace(1000, late), 0.0)
    energy_j = memories[0].ring.ports["energy_j"][:, 0]
    depth, rendered = motion[:, 0], 300.0 * motion[:, 0]  # the tick that answers a position has its number
    taken_in = np.sum(rendered[begin - late : end - late] * np.diff(depth[begin : end + 1]))
    counted = energy_j[end] - energy_j[begin]
    assert abs(taken_in) > 1e-8
    assert counted == pytest.approx(taken_in, rel=1e-9)


def test_between_uneven_ticks_the_handle_moves_on_as_long_as_it_really_took() -> None:
    durations = np.array([0.0, 1e-5, 1e-3, 0.07])
    rates = np.array([[0.0, 1.0], [-HANDLE.hand_n_per_m / HANDLE.mass_kg, -DAMPING / HANDLE.mass_kg]])
    np.testing.assert_allclose(
        HANDLE.propagators(durations), [expm(rates * duration) for duration in durations], rtol=0, atol=1e-12
    )


def test_passivity_control_stills_a_spring_that_vibrates_without_it(
    spring: Callable[[float], ReducedModel],
) -> None:
    model = spring(1.5 * critical_stiffness(1))
    trace = steady_trace(TICKS, 1)
    assert not comes_to_rest(press(model, HANDLE, REACH_M, trace, 0.0)[:, 0])
    assert comes_to_rest(press(model, HANDLE, REACH_M, trace, 4.0)[:, 0])


def test_creep_and_a_single_disturbance_are_no_vibration_and_a_small_steady_one_is() -> None:
    time_s = np.arange(TICKS) * PERIOD_S
    creep = 1e-3 * (1 - np.exp(-time_s / 2))
    wave = np.sin(2 * np.pi * 30 * time_s)
    knock = 1e-3 * wave * np.exp(-np.maximum(time_s - 7.3, 0) / 0.05) * (time_s > 7.3)
    assert comes_to_rest(creep + knock)
    assert comes_to_rest(3e-4 * time_s)
    assert comes_to_rest(creep + 1e-3 * wave * np.exp(-time_s))
    assert not comes_to_rest(creep + 2e-5 * wave)
    assert not comes_to_rest(np.where(time_s < 6, creep, np.inf))


def test_a_trace_can_be_cut_anywhere_and_its_commands_are_counted_from_there() -> None:
    steady: Trace = steady_trace(100, 2)
    piece = steady.piece(40, 30)
    np.testing.assert_array_equal(piece.device_ns, steady.device_ns[40:70])
    np.testing.assert_array_equal(piece.rendered, np.arange(30))
    np.testing.assert_array_equal(piece.used, np.maximum(np.arange(30) - 2, -1))
    np.testing.assert_array_equal(piece.ages_ns(), 2_000_000)
    with pytest.raises(ValueError, match="no ticks from 90 to 120"):
        steady.piece(90, 30)
