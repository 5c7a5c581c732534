"""Fixtures that more than one room's tests use."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import fields, replace

import numpy as np
import pytest

from palpate.model_file import ReducedModel, SurfaceAccuracy, SurfaceModel, ToolShape
from palpate_server.diagnostics.sample_model import spring_mass_model
from palpate_server.diagnostics.sample_surface import half_space_model

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
def make_surface_model() -> Callable[..., SurfaceModel]:
    """A half-space that is touched by `tip` and, with two tools, 12 mm beside it by `tip1`; its stated errors are zero."""

    def make(n_tools: int = 1, softness: float = 1.0, friction: float = 0.3) -> SurfaceModel:
        tools = [
            ToolShape(f"tip{i}" if i else "tip", 0.005, friction, (0.012 * i, 0.0, 0.02))
            for i in range(n_tools)
        ]
        model = half_space_model(
            tools, 13, young_pa=1e4 / softness, prony=((0.5, 0.3), (0.005, 0.5)), n_modes=6
        )
        zeros = dict.fromkeys((f.name for f in fields(SurfaceAccuracy)), 0.0)
        accuracy = SurfaceAccuracy(**zeros | {"error_map": np.zeros(model.n_points, np.float32)})
        return replace(
            model, n_nodes=model.n_points, accuracy=accuracy, config_sha256="5f" * 32, built_with="the tests"
        )

    return make


@pytest.fixture(scope="session")
def make_spring_mass_model() -> Callable[..., ReducedModel]:
    return spring_mass_model
