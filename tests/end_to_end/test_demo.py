"""`palpate demo` on a body that builds in a second: it ends with forces and a picture, and does not build twice."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from matplotlib.image import imread

from palpate.demo import run_demo


class Stages:
    """The stages that were announced."""

    def __init__(self) -> None:
        self.names: list[str] = []

    def __call__(self, name: str) -> None:
        self.names.append(name)

    def note(self, text: str) -> None:
        pass

    def warn(self, text: str) -> None:
        pass


def test_the_demonstration_ends_with_forces_and_a_picture_and_builds_once(
    tmp_path: Path, slab_scene: Callable[..., str]
) -> None:
    scene = tmp_path / "slab.toml"
    scene.write_text(slab_scene())
    first = Stages()
    demo = run_demo(scene, tmp_path / "out", 1.0, first)
    assert any(name.startswith("reduction") for name in first.names)
    assert demo.client["contract_broken"] == []
    inward = -np.asarray(demo.model.contacts[0].normal)
    assert np.max(demo.touch.force_n @ inward) > 0.05
    assert np.max(demo.touch.displacement_m @ inward) > 0.004
    assert demo.error_in_band < 0.1
    picture = imread(demo.picture)
    assert picture.shape[0] > 500
    assert picture.shape[1] > 1000
    assert np.std(picture[..., :3]) > 0.05  # not blank

    again = Stages()
    run_demo(scene, tmp_path / "out", 0.2, again)
    assert not any(name.startswith("reduction") for name in again.names)

    scene.write_text(slab_scene(("tip", 0.03, 0.015)))
    changed = Stages()
    run_demo(scene, tmp_path / "out", 0.2, changed)
    assert any(name.startswith("reduction") for name in changed.names)
