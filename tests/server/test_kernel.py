"""The compiled step against the same model written as dense matrices."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from palpate.model import ReducedModel
from palpate_server import kernel


@pytest.mark.parametrize(("n_contacts", "n_modes"), [(1, 1), (1, 60), (10, 60)])
def test_block_diagonal_steps_equal_dense_matrix_products(
    make_spring_mass_model: Callable[..., ReducedModel], n_contacts: int, n_modes: int
) -> None:
    system = make_spring_mass_model(n_contacts, n_modes).discrete
    a, b, c, d = system.dense_a(), system.b, system.c, system.d
    random = np.random.default_rng(0)
    state = np.zeros(system.order)
    expected_state = np.zeros(system.order)
    force = np.zeros(len(c))
    b_transposed = np.ascontiguousarray(b.T)
    size = np.abs(c).max() * np.abs(b).max() * system.order + np.abs(d).max()
    for _ in range(200):
        displacement = random.normal(size=(b.shape[1],))
        kernel.output(c, d, state, displacement, force)
        np.testing.assert_allclose(force, c @ expected_state + d @ displacement, rtol=0, atol=1e-13 * size)
        kernel.update(system.diagonal, system.cross, b_transposed, state, displacement)
        expected_state = a @ expected_state + b @ displacement
    scale = np.abs(expected_state).max()
    np.testing.assert_allclose(state, expected_state, rtol=0, atol=1e-12 * scale)


def test_a_step_does_not_change_its_input() -> None:
    state, displacement = np.ones(2), np.full(3, 0.5)
    c, d, b_transposed, force = np.ones((3, 2)), np.ones((3, 3)), np.ones((3, 2)), np.zeros(3)
    kernel.output(c, d, state, displacement, force)
    np.testing.assert_array_equal(state, 1.0)
    kernel.update(np.ones(2), np.zeros(2), b_transposed, state, displacement)
    np.testing.assert_array_equal(displacement, 0.5)


@pytest.mark.parametrize("shape", [(0,), (200,), (30, 200), (5, 7), (3, 0)])
def test_an_aligned_copy_begins_on_a_cache_line_and_holds_the_same_numbers(shape: tuple[int, ...]) -> None:
    values = np.random.default_rng(0).normal(size=shape)
    for original in (values, np.asfortranarray(values)):  # rows and columns first
        copy = kernel.aligned(original)
        np.testing.assert_array_equal(copy, values)
        assert copy.size == 0 or copy.ctypes.data % 64 == 0
        assert copy.flags.c_contiguous
        assert copy.flags.writeable
        assert not np.shares_memory(copy, original)
