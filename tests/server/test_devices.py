"""Device profiles and the warnings about models that are too stiff for them."""

from __future__ import annotations

import pytest

from palpate_server.devices import PROFILES, limits_for, stiffness_warnings
from palpate_server.safety import Limits

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
