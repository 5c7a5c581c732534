"""Fixtures that more than one room's tests use."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import pytest

from palpate.model_file import ReducedModel
from palpate_server.diagnostics.sample_model import spring_mass_model

SLAB = """
name = "slab"
[geometry]
shape = "box"
upper_m = [0.06, 0.06, 0.03]
counts = [7, 7, 4]
jitter = 0.1
[material]
preset = "liver"
[[fixed]]
region = "plane"
point_m = [0.0, 0.0, 0.0001]
normal = [0.0, 0.0, -1.0]
"""


@pytest.fixture(scope="session", autouse=True)
def no_stages_of_earlier_builds(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """`palpate build` keeps its stages in a folder of this session."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))
        yield


@pytest.fixture(scope="session")
def slab_scene() -> Callable[..., str]:
    """A bonded slab that builds in a second, with a contact for each (name, x, radius), m, on its upper side."""

    def scene(*contacts: tuple[str, float, float], more: str = "") -> str:
        tables = (
            f'[[contact]]\nname = "{name}"\npoint_m = [{x}, 0.03, 0.03]\nradius_m = {radius}\n'
            for name, x, radius in contacts or [("tip", 0.03, 0.011)]
        )
        return SLAB + "".join(tables) + more

    return scene


@pytest.fixture(scope="session")
def make_spring_mass_model() -> Callable[..., ReducedModel]:
    return spring_mass_model
