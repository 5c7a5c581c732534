"""A lobe that is thinner than the radius of the tip: pressed on its face and on its edge, it is neither lost nor burst through."""

from __future__ import annotations

import tomllib
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from palpate.build_surface import build_surface_model
from palpate.model_file import SurfaceModel
from palpate.scene.schema import check_config
from palpate_server.simulation import Reaction, Simulation

Floats = NDArray[np.float64]

LENGTH_M, WIDTH_M, THICKNESS_M, RADIUS_M = 0.02, 0.03, 0.006, 0.008
MOTION_M = 2e-5  # in a tick
PUSHED_OUT_M = 2e-5  # of old penetration, in a tick at most

LOBE = f"""
name = "lobe"
[geometry]
shape = "box"
upper_m = [{LENGTH_M}, {WIDTH_M}, {THICKNESS_M}]
counts = [5, 6, 3]
[material]
preset = "liver"
[[fixed]]
region = "plane"
point_m = [0.001, 0.0, 0.0]
normal = [-1.0, 0.0, 0.0]
[surface]
modes = 60
band_hz = [0.0, 5.0]
[[tool]]
name = "tip"
radius_m = {RADIUS_M}
friction = 0.3
"""


@pytest.fixture(scope="module")
def lobe() -> SurfaceModel:
    return build_surface_model(check_config(tomllib.loads(LOBE), "lobe"), Path())


def through(simulation: Simulation, *places_m: tuple[float, float, float]) -> list[list[Reaction]]:
    """The reactions on each straight leg from one place to the next."""
    legs = []
    for start, end in zip(np.array(places_m)[:-1], np.array(places_m)[1:], strict=True):
        n = int(np.ceil(np.linalg.norm(end - start) / MOTION_M))
        legs.append([simulation.step({"tip": place})["tip"] for place in np.linspace(start, end, n + 1)[1:]])
    return legs


def check_no_burst(model: SurfaceModel, reactions: list[Reaction]) -> None:
    """No step of the force is larger than that of a contact that is as stiff as any, with its friction; nothing pulls."""
    force = np.array([reaction.force_n for reaction in reactions])
    steps = np.linalg.norm(np.diff(force, axis=0), axis=1)
    assert steps.max() < 2 * model.accuracy.largest_stiffness_n_per_m * (MOTION_M + PUSHED_OUT_M)
    assert min(reaction.force_n @ reaction.normal for reaction in reactions) >= 0


def test_a_tip_presses_a_face_by_more_than_the_thickness_and_slides_off_the_end(lobe: SurfaceModel) -> None:
    y, z = WIDTH_M / 2, THICKNESS_M + RADIUS_M
    near_the_end, beyond = LENGTH_M - 0.006, LENGTH_M + 2 * RADIUS_M
    deep = z - THICKNESS_M - 2e-3
    places = ((near_the_end, y, z + 1e-3), (near_the_end, y, deep), (beyond, y, deep), (beyond, y, z))
    simulation = Simulation(lobe)
    down, along, up = through(simulation, *places)
    assert all(reaction.n_points > 0 for reaction in down[len(down) // 2 :])
    assert down[-1].force_n[2] > 0.02
    assert np.ptp(simulation.positions()[:, 2]) >= THICKNESS_M
    in_contact = np.array([reaction.n_points > 0 for reaction in along])
    end = np.flatnonzero(in_contact)[-1]
    assert np.all(in_contact[: int(0.5 * end)])
    assert not np.any(up[-1].force_n)
    check_no_burst(lobe, down + along + up)


def test_a_tip_presses_the_edge_of_a_lobe(lobe: SurfaceModel) -> None:
    y, z, x = WIDTH_M / 2, THICKNESS_M / 2, LENGTH_M + RADIUS_M
    simulation = Simulation(lobe)
    inward, outward = through(simulation, (x + 1e-3, y, z), (x - 5e-3, y, z), (x + 1e-3, y, z))
    assert all(reaction.n_points > 0 for reaction in inward[100:])
    depths = np.array([reaction.force_n[0] for reaction in inward])
    assert np.all(np.diff(depths[::20]) >= 0)
    assert depths[-1] > 0.05
    assert not np.any(outward[-1].force_n)
    check_no_burst(lobe, inward + outward)
