"""Fixtures that more than one room's tests use."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from palpate.model import ReducedModel
from palpate_server.sample_model import spring_mass_model


@pytest.fixture(scope="session")
def make_spring_mass_model() -> Callable[..., ReducedModel]:
    return spring_mass_model
