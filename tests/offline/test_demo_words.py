"""What the demonstration of a surface model says is what the server sent, whatever that is."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from palpate.demo.surface import Slide, _felt, _Sent, row_of
from palpate.model_file import SurfaceModel
from palpate_client import Surface
from palpate_client.wire import FORCE_FIELDS, PER_TICK


def message(tick: int, **values: Any) -> dict[str, Any]:
    """A force message of two tools; values of the second one, and of the tissue."""
    sent: dict[str, Any] = {"tick": tick}
    for name, (width, kind) in FORCE_FIELDS.items():
        zero = [kind(0)] * 3 if width == 3 else kind(0)
        if width == PER_TICK:
            sent[name] = values.get(name, sent.get(name, zero))
        else:
            sent[name] = [zero, values.get(name, zero)]
    return sent


@pytest.fixture
def sent() -> _Sent:
    """Four ticks of five; the surface of the third."""
    up = {"normal": [0.0, 0.0, 1.0], "n_contact_points": 7, "force_scale": 1.0}
    energies = {"tissue_stored_j": 2e-4, "tissue_dissipated_j": 3e-5, "stored_j": 1e-5, "dissipated_j": 1e-6}
    work = sum(energies.values())
    forces = [
        message(100),
        message(101, force_n=[0.0, 0.1, 0.5], **up),
        message(103, force_n=[0.0, 0.1, 1.5], work_j=work, **up, **energies),
        message(104, work_j=work, **energies),
    ]
    surfaces = [Surface(101, 0, [0.0]), Surface(102, 0, [1.0, 2.0, 3.0])]
    return _Sent([row_of(message, 1) for message in forces], surfaces, 700.0, {})


@pytest.fixture
def lines(sent: _Sent, make_surface_model: Callable[..., SurfaceModel]) -> Callable[..., str]:
    """The words about what was sent, with some of it changed."""

    def of(**changes: Any) -> str:
        felt, _ = _felt(sent, 1e-3)
        felt = replace(felt, **changes)
        return "\n".join(
            Slide(make_surface_model(), {}, felt, felt, sent.displacement_m(), 1, 0.02, 0.01).lines()
        )

    return of


def test_forces_points_and_energies_are_those_of_the_messages(sent: _Sent) -> None:
    felt, scale = _felt(sent, 1e-3)
    np.testing.assert_allclose(felt.time_s, [0, 1e-3, 2e-3, 3e-3, 4e-3])
    np.testing.assert_allclose(felt.force_n[:, 2], [0, 0.5, 1.0, 1.5, 0])
    np.testing.assert_array_equal(felt.n_points, [0, 7, 7, 7, 0])
    np.testing.assert_allclose(felt.stored_j[3:], 2.1e-4)
    np.testing.assert_allclose(felt.dissipated_j[3:], 3.1e-5)
    np.testing.assert_allclose(felt.work_j[3:], 2.41e-4)
    np.testing.assert_array_equal(scale, [0, 1, 1, 1, 0])
    np.testing.assert_array_equal(sent.displacement_m(), [[1.0, 2.0, 3.0]])


def test_what_was_measured_is_said(lines: Callable[..., str]) -> None:
    said = lines()
    assert "1 of 5 ticks did not come" in said
    assert "7 points at most; force along its normal +0.500 to +1.500 N, never a pull" in said
    assert "0.241 mJ of work by the tool = 0.210 stored + 0.031 dissipated" in said


def test_a_pull_a_balance_that_is_off_and_no_contact_are_said_too(lines: Callable[..., str]) -> None:
    pulled = np.zeros((5, 3))
    pulled[:, 2] = [0.0, 0.5, -0.25, 1.5, 0.0]
    said = lines(force_n=pulled, stored_j=np.zeros(5))
    assert "-0.250 to +1.500 N, a pull (ticks: 1)" in said
    assert "never" not in said
    assert "is not 0.000 stored" in said
    assert "contact       none" in lines(n_points=np.zeros(5, int))


def test_energies_are_those_before_the_server_counted_anew(lines: Callable[..., str]) -> None:
    assert "0.100 mJ of work by the tool" in lines(work_j=np.array([0.0, 5e-5, 1e-4, 0.0, 0.0]))
