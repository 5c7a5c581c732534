"""A scene with a tool becomes a surface model: the whole chain against finite elements, and what it warns of and refuses."""

from __future__ import annotations

import tomllib
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import skfem
from skfem.helpers import ddot, eye, sym_grad, trace

from palpate.build_surface import build_surface_model
from palpate.model_file import SurfaceModel, load_model, save_model, stiffened
from palpate.model_file.contact_size import blunted_error
from palpate.report import accuracy_text
from palpate.scene.schema import check_config
from palpate.scene.tissues import PRESETS
from palpate.stage_cache import StageCache
from palpate_server.simulation import Simulation

SIDE_M, HEIGHT_M, RADIUS_M = 0.06, 0.04, 0.016

SCENE: dict[str, Any] = tomllib.loads(f"""
name = "block"
[geometry]
shape = "box"
upper_m = [{SIDE_M}, {SIDE_M}, {HEIGHT_M}]
counts = [9, 9, 7]
[material]
preset = "liver"
[[fixed]]
region = "plane"
point_m = [0.0, 0.0, 0.001]
normal = [0.0, 0.0, -1.0]
[surface]
modes = 60
band_hz = [0.0, 15.0]
[[tool]]
name = "tip"
radius_m = {RADIUS_M}
friction = 0.3
""")


class _Progress:
    def __init__(self) -> None:
        self.stages: list[str] = []
        self.warnings: list[str] = []

    def __call__(self, stage: str) -> None:
        self.stages.append(stage)

    def note(self, text: str) -> None:
        pass

    def warn(self, text: str) -> None:
        self.warnings.append(text)


@pytest.fixture(scope="module")
def built() -> tuple[SurfaceModel, _Progress]:
    progress = _Progress()
    return build_surface_model(check_config(SCENE, "block"), Path(), progress), progress


def _compliance_by_finite_elements(contact_radius_m: float) -> float:
    """Work-conjugate displacement under the pressure of Hertz on the middle of the top, over its force, m/N.

    Quadratic hexahedra on a quarter of the block, graded towards the contact.
    """
    across = SIDE_M / 2 * np.linspace(0, 1, 6) ** 1.3
    mesh = skfem.MeshHex.init_tensor(across, across, HEIGHT_M * (1 - np.linspace(1, 0, 6) ** 1.3))
    basis = skfem.Basis(mesh, skfem.ElementVector(skfem.ElementHex2()), intorder=4)
    material = PRESETS["liver"]
    lame, mu = material.lame_lambda_pa, material.shear_modulus_pa

    @skfem.BilinearForm
    def stiffness(u: Any, v: Any, w: Any) -> Any:
        strain = sym_grad(u)
        return ddot(2 * mu * strain + eye(lame * trace(strain), 3), sym_grad(v))

    @skfem.LinearForm
    def pressure(v: Any, w: Any) -> Any:
        squared = (w.x[0] ** 2 + w.x[1] ** 2) / contact_radius_m**2
        return 3 / (2 * np.pi * contact_radius_m**2) * np.sqrt(np.maximum(0, 1 - squared)) * v[2]

    top = skfem.FacetBasis(
        mesh, basis.elem, facets=mesh.facets_satisfying(lambda x: np.isclose(x[2], HEIGHT_M)), intorder=8
    )
    load = pressure.assemble(top)
    held = np.concatenate(
        [
            basis.get_dofs(lambda x: np.isclose(x[2], 0.0)).all(),
            basis.get_dofs(lambda x: np.isclose(x[0], 0.0)).all(["u^1"]),
            basis.get_dofs(lambda x: np.isclose(x[1], 0.0)).all(["u^2"]),
        ]
    )
    solution = skfem.solve(*skfem.condense(stiffness.assemble(basis), load, D=np.unique(held)))
    force = 4 * load[basis.get_dofs(elements=True).all(["u^3"])].sum()
    return float(4 * load @ solution / force**2)


def test_a_block_is_as_compliant_as_by_finite_elements(built: tuple[SurfaceModel, _Progress]) -> None:
    model, _ = built
    middle = int(np.argmin(np.linalg.norm(model.points - [SIDE_M / 2, SIDE_M / 2, HEIGHT_M], axis=1)))
    radius = model.accuracy.contact_radius_m
    distance = np.linalg.norm(model.points - model.points[middle], axis=1)
    weights = np.sqrt(np.maximum(0, 1 - (distance / radius) ** 2))
    weights /= weights.sum()
    vertical = slice(2, None, 3)
    modal = (weights @ model.shapes[:, 2]) ** 2 @ (1 / model.squared_frequencies)
    found = modal + weights @ model.residual[vertical, vertical] @ weights
    # Nine points, 7.5 mm apart, stand for the contact; the pressure of Hertz with their mean of r², 2/5 a², is wider.
    effective = float(np.sqrt(weights @ distance**2 / 0.4))
    assert found == pytest.approx(_compliance_by_finite_elements(effective), rel=0.1)


def test_the_model_is_judged_written_read_and_told(
    built: tuple[SurfaceModel, _Progress], tmp_path: Path
) -> None:
    model, progress = built
    accuracy = model.accuracy
    assert accuracy.error_static < 1e-4
    assert 0 < accuracy.error_in_band_median <= accuracy.error_in_working_area <= accuracy.error_in_band < 1
    assert accuracy.error_in_band == pytest.approx(float(accuracy.error_map.max()))
    assert model.n_modes == 60
    assert min(accuracy.passivity_margin, accuracy.passivity_margin_sampled) >= 0
    assert not accuracy.error_map[model.held].any()
    assert np.all(accuracy.error_map[~model.held] > 0)
    save_model(model, tmp_path / "block.npz")
    read = load_model(tmp_path / "block.npz")
    assert isinstance(read, SurfaceModel)
    np.testing.assert_array_equal(read.residual, model.residual)
    text = accuracy_text(read, verbose=True)
    assert "322 points to touch, 60 modes" in text
    assert "near enough on 100 %" in text
    assert "points of all" not in text
    assert "at a sample of up to 204 points" in text
    assert "never given out" in text
    assert not progress.warnings
    assert progress.stages[-4:] == ["modes", "static responses", "exact compliance", "evidence"]


def test_a_tool_that_slides_over_an_edge_is_never_pulled_and_its_force_makes_no_jump(
    built: tuple[SurfaceModel, _Progress],
) -> None:
    model, _ = built
    simulation, depth, motion = Simulation(model), 2e-3, 7e-5
    middle, touching = SIDE_M / 2, HEIGHT_M + RADIUS_M
    down = [(middle, middle, z) for z in np.arange(touching + 5e-4, touching - depth, -motion)]
    across = [(x, middle, touching - depth) for x in np.arange(middle, SIDE_M + 1.5 * RADIUS_M, motion)]
    felt = [simulation.step({"tip": position})["tip"] for position in down + across]
    force = np.array([one.force_n for one in felt])
    assert min(one.force_n @ one.normal for one in felt) >= 0
    assert np.linalg.norm(force[len(down)]) > 0.05  # N: it was in contact before the edge
    assert felt[-1].n_points == 0 and not np.any(force[-1])
    # Nothing is stiffer than the points of a whole contact in one tick; friction comes with the normal force.
    largest = 2 * model.accuracy.largest_stiffness_n_per_m * motion
    assert np.max(np.linalg.norm(np.diff(force, axis=0), axis=1)) < largest


def test_a_tool_that_begins_inside_is_not_thrown_out_and_gets_no_energy(
    built: tuple[SurfaceModel, _Progress],
) -> None:
    model, _ = built
    simulation = Simulation(model)
    for height in np.arange(-4e-3, 2e-3, 5e-5):
        reaction = simulation.step({"tip": (SIDE_M / 2, SIDE_M / 2, HEIGHT_M + RADIUS_M + height)})["tip"]
        assert np.linalg.norm(reaction.force_n) < 1e-3
    assert reaction.work_j >= -1e-9 and reaction.n_points == 0


def test_another_prony_series_changes_nothing_but_itself() -> None:
    """Shapes, frequencies and residual belong to the elastic body."""
    small = SCENE | {"geometry": SCENE["geometry"] | {"counts": [5, 5, 4]}}
    slow = small | {"material": {"preset": "liver", "gamma": [2.0], "tau_s": [0.05]}}
    one, other = (build_surface_model(check_config(s, "block"), Path()) for s in (small, slow))
    np.testing.assert_array_equal(one.residual, other.residual)
    np.testing.assert_array_equal(one.shapes, other.shapes)
    assert other.gamma.tolist() == [2.0]


def test_the_model_of_a_body_that_is_three_times_as_stiff_is_the_stiffened_one() -> None:
    small = SCENE | {"geometry": SCENE["geometry"] | {"counts": [5, 5, 4]}}
    soft_pa = PRESETS["liver"].youngs_modulus_pa
    stiff = small | {"material": {"preset": "liver", "youngs_modulus_pa": 3 * soft_pa}}
    one, other = (build_surface_model(check_config(s, "block"), Path()) for s in (small, stiff))
    made = stiffened(one, 3.0)
    np.testing.assert_allclose(made.squared_frequencies, other.squared_frequencies, rtol=1e-7)
    # Of two modes of one frequency each mixture is right; the compliance of all modes together is one.
    compliance, expected = (
        np.einsum("pck,qdk,k->pcqd", m.shapes, m.shapes, 1 / m.squared_frequencies) for m in (made, other)
    )
    np.testing.assert_allclose(compliance, expected, atol=1e-5 * np.abs(expected).max())
    np.testing.assert_allclose(made.residual, other.residual, atol=1e-5 * np.abs(other.residual).max())
    assert made.band_hz == (0.0, pytest.approx(15.0 * 3**0.5)) and made.stiffness_factor == 3.0


def test_a_tool_that_is_too_small_for_the_points_is_warned_of_with_its_number() -> None:
    tool = SCENE["tool"][0] | {"radius_m": 0.004}
    scene = SCENE | {"geometry": SCENE["geometry"] | {"counts": [5, 5, 4]}, "tool": [tool]}
    progress = _Progress()
    model = build_surface_model(check_config(scene, "block"), Path(), progress)
    assert any("tool 'tip': radius_m = 0.004 touches about 0.1" in text for text in progress.warnings)
    blunted = blunted_error(model.points, model.triangles, 0.004)[~model.held]
    assert blunted.min() > 0.3
    assert np.all(model.accuracy.error_map[~model.held] >= blunted.astype(np.float32))
    text = accuracy_text(model)
    assert "near enough on 0 %" in text
    assert "elsewhere it acts as a blunter one, of up to 2" in text
    text = accuracy_text(replace(model, accuracy=replace(model.accuracy, passivity_margin=-1e-4)))
    assert "never given out" not in text
    assert "can be given out" in text


def test_modes_that_end_within_the_band_are_refused() -> None:
    scene = SCENE | {"geometry": SCENE["geometry"] | {"counts": [5, 5, 4]}, "surface": {"modes": 2}}
    with pytest.raises(
        ValueError, match=r"surface\.modes = 2 reach .* Hz: expected modes beyond the end of surface\.band_hz"
    ):
        build_surface_model(check_config(scene, "block"), Path())


def test_a_body_that_does_not_fit_is_refused_before_it_is_assembled(monkeypatch: pytest.MonkeyPatch) -> None:
    sizes = {"SC_PAGE_SIZE": 4096, "SC_PHYS_PAGES": 2**16}  # 256 MiB
    monkeypatch.setattr("palpate.memory.os.sysconf", sizes.__getitem__)
    progress = _Progress()
    with pytest.raises(
        MemoryError,
        match=r"567 nodes, 322 of them on the surface, needs about 0\.\d GiB, this machine has 0\.2",
    ):
        build_surface_model(check_config(SCENE, "block"), Path(), progress)
    assert progress.stages == ["node cloud"]


def test_vectors_are_added_until_the_tolerance_is_kept_and_a_second_build_takes_its_stages_from_the_cache(
    tmp_path: Path,
) -> None:
    small = {
        "geometry": SCENE["geometry"] | {"counts": [6, 6, 5]},
        "surface": {"band_hz": [0.0, 15.0], "tolerance": 0.03},
    }
    config = check_config(SCENE | small, "block")
    cache, first, second = StageCache.open(tmp_path / "cache"), _Progress(), _Progress()
    model = build_surface_model(config, Path(), first, cache)
    assert "Ritz vectors" in first.stages
    assert model.accuracy.error_in_working_area <= 0.03
    n_true = int(np.count_nonzero(model.squared_frequencies < (2 * np.pi * 16.5) ** 2))
    assert model.n_modes > n_true + 24
    again = build_surface_model(config, Path(), second, cache)
    assert "Ritz vectors" not in second.stages
    for name in ("squared_frequencies", "shapes", "residual"):
        np.testing.assert_array_equal(getattr(again, name), getattr(model, name))
    assert again.accuracy.error_in_band == model.accuracy.error_in_band
