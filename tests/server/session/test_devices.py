"""Device profiles and the warnings about models that are too stiff for them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from dense_form import dense_a
from palpate.model_file import ReducedModel
from palpate_server.realtime.safety import Limits
from palpate_server.session.devices import PROFILES, Device, limits_for, stiffness_warnings, warnings_for

GENERIC = PROFILES["generic"]


def test_the_tighter_of_server_and_device_holds() -> None:
    ceiling = Limits(5.0, 2000.0, 1.0, 0.06, 0.0)
    limits = limits_for(PROFILES["omega"], ceiling)
    assert limits == Limits(5.0, 2000.0, 1.0, 0.06, 30.0)
    limits = limits_for(PROFILES["touch"], ceiling)
    assert limits.max_force_n == 3.3


def test_every_profile_says_where_its_numbers_are_from_and_the_generic_one_is_below_all() -> None:
    for profile in PROFILES.values():
        assert profile.source
        assert profile.max_force_n >= GENERIC.max_force_n
        assert profile.max_stiffness_n_per_m >= GENERIC.max_stiffness_n_per_m
        assert profile.max_damping_n_s_per_m >= GENERIC.max_damping_n_s_per_m


def test_the_device_families_of_the_field_have_a_profile() -> None:
    families = {"touch", "phantom-omni", "omega", "delta", "sigma", "lambda", "falcon", "inverse3", "generic"}
    assert families <= PROFILES.keys()


@pytest.mark.parametrize(
    ("stiffness", "round_trip", "damping", "count"),
    [
        (600.0, None, None, 0),
        (800.0, None, None, 1),
        (600.0, 0.0, 0.31, 0),  # K T / 2 = 0.3 N s/m
        (600.0, 0.0, 0.29, 1),
        (600.0, 0.001, 0.31, 1),  # a delay of a period: K (T/2 + D) = 0.9 N s/m
        (600.0, 0.001, 0.91, 0),
        (800.0, 0.001, 0.1, 2),
    ],
)
def test_a_stiffness_beyond_the_device_or_colgates_condition_is_warned_about(
    stiffness: float, round_trip: float | None, damping: float | None, count: int
) -> None:
    assert len(stiffness_warnings(GENERIC, stiffness, 1e-3, round_trip, damping)) == count


def test_a_model_that_can_give_out_energy_is_warned_about(
    make_spring_mass_model: Callable[..., ReducedModel],
) -> None:
    model = make_spring_mass_model()
    device = Device(replace(GENERIC, max_stiffness_n_per_m=1e9))
    assert warnings_for(device, model, 0, 1.0) == []
    accuracy = replace(model.accuracy, passive_up_to_hz=425.0, largest_energy_out_j=1.6e-4)
    (warning,) = warnings_for(device, replace(model, accuracy=accuracy), 0, 1.0)
    assert "425 Hz" in warning
    assert "0.16 mJ" in warning


def test_the_sample_model_is_passive_at_every_frequency(
    make_spring_mass_model: Callable[..., ReducedModel],
) -> None:
    """As its accuracy report says. By the dense response: no sinusoid gets energy out."""
    model = make_spring_mass_model(2, 20)
    system, a = model.discrete, dense_a(model.discrete)
    for theta in np.linspace(0, np.pi, 300):
        g = system.c @ np.linalg.solve(np.exp(1j * theta) * np.eye(len(a)) - a, system.b) + system.d
        least = np.linalg.eigvalsh((g - g.conj().T) / 2j)[0]
        assert least >= -1e-12 * np.linalg.norm(g, 2)
