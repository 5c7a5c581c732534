"""`palpate demo` on a body that builds in a second: it ends with forces and a picture, and does not build twice."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.image import imread

from palpate.demo import run_demo

SLAB = """
name = "slab"
[geometry]
shape = "box"
upper_m = [0.06, 0.06, 0.03]
counts = [7, 7, 4]
[material]
preset = "liver"
[[fixed]]
region = "plane"
point_m = [0.0, 0.0, 0.0001]
normal = [0.0, 0.0, -1.0]
[[contact]]
name = "tip"
point_m = [0.03, 0.03, 0.03]
radius_m = 0.011
"""


class Stages:
    """The stages that were announced."""

    def __init__(self) -> None:
        self.names: list[str] = []

    def __call__(self, name: str) -> None:
        self.names.append(name)

    def note(self, text: str) -> None:
        pass


def test_the_demonstration_ends_with_forces_and_a_picture_and_builds_once(tmp_path: Path) -> None:
    scene = tmp_path / "slab.toml"
    scene.write_text(SLAB)
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
    run_demo(scene, tmp_path / "out", 1.0, again)
    assert not any(name.startswith("reduction") for name in again.names)

    scene.write_text(SLAB.replace("radius_m = 0.011", "radius_m = 0.015"))
    changed = Stages()
    run_demo(scene, tmp_path / "out", 1.0, changed)
    assert any(name.startswith("reduction") for name in changed.names)
