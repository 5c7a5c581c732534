"""The compiled step against the same model written as dense matrices."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from numba import njit

from dense_form import dense_a
from palpate.model_file import ReducedModel, StateSpace
from palpate_server.bodies import state_space
from palpate_server.coupling.models import make_running
from palpate_server.diagnostics.sample_model import spring_mass_model
from palpate_server.realtime import scheduler, shared_memory
from palpate_server.realtime.dot import LANES, dot
from palpate_server.realtime.native_image import make_image
from palpate_server.realtime.safety import Limits


@pytest.mark.parametrize(("n_contacts", "n_modes"), [(1, 1), (1, 60), (10, 60)])
def test_block_diagonal_steps_equal_dense_matrix_products(
    make_spring_mass_model: Callable[..., ReducedModel], n_contacts: int, n_modes: int
) -> None:
    system = make_spring_mass_model(n_contacts, n_modes).discrete
    a, b, c, d = dense_a(system), system.b, system.c, system.d
    body = state_space.make_body(system)
    random = np.random.default_rng(0)
    expected_state = np.zeros(system.order)
    size = np.abs(c).max() * np.abs(b).max() * system.order + np.abs(d).max()
    for _ in range(200):
        displacement = random.normal(size=(b.shape[1],))
        state_space.output(body, displacement)
        np.testing.assert_allclose(
            body.force, c @ expected_state + d @ displacement, rtol=0, atol=1e-13 * size
        )
        state_space.update(body, displacement)
        expected_state = a @ expected_state + b @ displacement
    scale = np.abs(expected_state).max()
    np.testing.assert_allclose(body.state, expected_state, rtol=0, atol=1e-12 * scale)


def test_a_step_does_not_change_its_input() -> None:
    displacement = np.full(3, 0.5)
    body = state_space.make_body(
        StateSpace(np.ones(2), np.zeros(2), np.ones((2, 3)), np.ones((3, 2)), np.ones((3, 3)))
    )
    body.state[:] = 1.0
    state_space.output(body, displacement)
    np.testing.assert_array_equal(body.state, 1.0)
    state_space.update(body, displacement)
    np.testing.assert_array_equal(displacement, 0.5)


@pytest.mark.parametrize("shape", [(0,), (200,), (30, 200), (5, 7), (3, 0)])
def test_an_aligned_copy_begins_on_a_cache_line_and_holds_the_same_numbers(shape: tuple[int, ...]) -> None:
    values = np.random.default_rng(0).normal(size=shape)
    for original in (values, np.asfortranarray(values)):  # rows and columns first
        copy = state_space.aligned(original)
        np.testing.assert_array_equal(copy, values)
        assert copy.size == 0 or copy.ctypes.data % 64 == 0
        assert copy.flags.c_contiguous
        assert copy.flags.writeable
        assert not np.shares_memory(copy, original)


def summed_in_the_stated_order(first: np.ndarray, second: np.ndarray) -> float:
    """What `dot` promises, with one rounded operation of numpy's at a time."""
    products = first * second
    whole = len(products) // LANES * LANES
    lanes = np.zeros(LANES)
    for i in range(0, whole, LANES):
        lanes = lanes + products[i : i + LANES]
    while len(lanes) > 1:
        lanes = lanes[: len(lanes) // 2] + lanes[len(lanes) // 2 :]
    total = lanes[0]
    for product in products[whole:]:
        total = total + product
    return float(total)


@njit
def compiled_dot(first: np.ndarray, second: np.ndarray) -> float:
    return dot(first, second)


def test_a_dot_product_is_summed_in_the_stated_order() -> None:
    random = np.random.default_rng(3)
    differs_from_another_order = 0
    for size in [*range(70), 200, 201, 607]:
        first, second = random.normal(size=(2, size))
        result = compiled_dot(first, second)
        assert result == summed_in_the_stated_order(first, second)
        differs_from_another_order += result != sum(first * second)
    assert differs_from_another_order > 20


def test_every_force_is_rounded_the_same_wherever_its_code_was_compiled() -> None:
    """Ticks, in which the kernel is compiled into other code, against the same operations one at a time."""
    model = spring_mass_model(2, 50)
    system = model.discrete
    memory = shared_memory.make_memory(
        make_running(model), model.period_s, [Limits(1e6, 1e12, 1e6, 1e6, 0.0)] * 2, 1 / 30
    )
    image = make_image(memory)
    random = np.random.default_rng(4)
    state = np.zeros(system.order)
    for tick in range(500):
        now = (tick + 1) * 1_000_000
        displacement = 1e-3 * random.normal(size=6)
        for contact in range(2):
            target = displacement[3 * contact : 3 * contact + 3]
            memory.commands.newest[contact] = (contact, 0, tick, 0, now, -1, target, (0.0, 0.0, 0.0), 0)
        scheduler.repeat_tick(image, now, now, False)
        force = [
            summed_in_the_stated_order(c, state) + summed_in_the_stated_order(d, displacement)
            for c, d in zip(system.c, system.d, strict=True)
        ]
        np.testing.assert_array_equal(memory.force.ravel(), np.negative(force))
        partner = state.reshape(-1, 2)[:, ::-1].ravel()
        following = system.diagonal * state + system.cross * partner
        for column, u in zip(system.b.T, displacement, strict=True):
            following = following + column * u
        state = following
    np.testing.assert_array_equal(memory.coupling.running.patch.body.state, state)
    assert np.all(memory.force != 0.0)
