"""`palpate demo` on bodies that build in seconds: it ends with forces and a picture, and does not build twice."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from matplotlib.image import imread

from palpate.demo import run_demo
from palpate.demo.patch import Poke
from palpate.demo.surface import Slide
from palpate.plots import in_band


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


def assert_is_a_picture(path: Path) -> None:
    picture = imread(path)
    assert picture.shape[0] > 500
    assert picture.shape[1] > 1000
    assert np.std(picture[..., :3]) > 0.05  # not blank


def test_the_demonstration_ends_with_forces_and_a_picture_and_builds_once(
    tmp_path: Path, slab_scene: Callable[..., str]
) -> None:
    scene = tmp_path / "slab.toml"
    scene.write_text(slab_scene())
    first = Stages()
    demo = run_demo(scene, tmp_path / "out", 1.0, first)
    poke = demo.touch
    assert isinstance(poke, Poke)
    assert any(name.startswith("reduction") for name in first.names)
    assert poke.client["contract_broken"] == []
    inward = -np.asarray(poke.model.contacts[0].normal)
    assert np.max(poke.touch.force_n @ inward) > 0.05
    assert np.max(poke.touch.displacement_m @ inward) > 0.004
    assert poke.error_in_band < 0.1
    assert_is_a_picture(demo.picture)

    again = Stages()
    run_demo(scene, tmp_path / "out", 0.2, again)
    assert not any(name.startswith("reduction") for name in again.names)

    scene.write_text(slab_scene(("tip", 0.03, 0.015)))
    changed = Stages()
    run_demo(scene, tmp_path / "out", 0.2, changed)
    assert any(name.startswith("reduction") for name in changed.names)


BLOCK = """
name = "block"
[geometry]
shape = "box"
upper_m = [0.06, 0.06, 0.03]
counts = [10, 10, 5]
[material]
preset = "liver"
[[fixed]]
region = "plane"
point_m = [0.0, 0.0, 0.001]
normal = [0.0, 0.0, -1.0]
[surface]
modes = 80
band_hz = [0.0, 10.0]
[[tool]]
name = "tip"
radius_m = 0.01
friction = 0.3
home_m = [0.052, 0.03, 0.06]
"""


def test_a_tool_presses_slides_and_lets_go_and_nothing_ever_pulls_it(tmp_path: Path) -> None:
    scene = tmp_path / "block.toml"
    scene.write_text(BLOCK)
    demo = run_demo(scene, tmp_path / "out", 2.0, Stages())
    slide = demo.touch
    assert isinstance(slide, Slide)
    assert slide.client["contract_broken"] == []
    for felt in (slide.felt, slide.full):
        # Neither along the contact's normal nor along the outward one of the block's top.
        assert felt.normal_n.min() >= 0
        assert felt.force_n[:, 2].min() >= 0
        assert felt.normal_n.max() > 0.05
        assert not felt.force_n[-1].any()
        velocity = np.gradient(felt.position_m, felt.time_s, axis=0)
        far_from_edges = np.abs(felt.position_m[:, 0] - 0.03) < 0.012
        sliding = (np.linalg.norm(velocity, axis=1) > 0.02) & far_from_edges & (felt.n_points > 0)
        assert np.count_nonzero(sliding) > 20  # 480, fewer where the machine held the client up
        power = np.einsum("ti,ti->t", felt.force_n, velocity)[sliding]
        assert power.mean() < 0  # friction is against the motion
        np.testing.assert_allclose(felt.work_j, felt.stored_j + felt.dissipated_j, atol=1e-9)
        assert np.all(felt.work_j >= -1e-9)
    touched = slide.felt.position_m[slide.felt.n_points > 0]
    assert np.ptp(touched, axis=0).max() > 0.03
    lines = "\n".join(slide.lines())
    assert "never a pull" in lines
    assert f"{1e3 * slide.felt.work_j[-1]:.3f} mJ of work by the tool = " in lines
    # Of the normal force. Along the surface, a point of the reference sticks and slips in alternate ticks while sliding begins,
    # since nearly all of its compliance is in modes that are stepped: 4 to 7 % of the largest force, and 0.3 % without friction.
    difference = slide.felt.force_n - slide.full.force_n
    normal_n = in_band(difference, slide.model.band_hz, slide.model.period_s)[:, 2]
    largest_n = np.linalg.norm(slide.full.force_n, axis=1).max()
    assert np.abs(normal_n).max() < slide.model.accuracy.error_in_working_area * largest_n
    assert slide.error_in_band < 0.2
    assert_is_a_picture(demo.picture)
