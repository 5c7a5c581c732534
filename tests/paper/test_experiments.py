"""The regenerated figures of the paper: their parts against analytic results, and the command in a real process."""

from __future__ import annotations

import csv
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import dblquad, solve_ivp

from palpate.lti.frequencies import all_frequencies, spectral_norms
from palpate.lti.stepping import step_through
from palpate.modes.dense import elastic_modes
from palpate.scene.material import PronySeries
from palpate_paper import convergence, finite_elements, membrane, membrane_frequencies, orders, spot_load
from palpate_paper.examples import (
    CUBE_MATERIAL,
    PERIOD_S,
    SQUARE_PRONY,
    center_of,
    pulse,
    square,
    with_drag,
)
from palpate_paper.membranes import disc_membrane, square_membrane
from palpate_paper.methods import ALL, HOM, MT, MT_STATICS, OF_THE_PAPER, TBR, Method
from palpate_paper.stepping import sampled
from palpate_paper.study import Comparison, Study, ranking


@pytest.fixture(scope="module")
def study() -> Study:
    return Study(quick=True)


def reproduce(*arguments: str, folder: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "palpate", "reproduce", *arguments],
        cwd=folder,
        capture_output=True,
        text=True,
        timeout=240,
        check=False,
    )


def test_reproduce_writes_a_plot_and_a_table_of_each_figure_and_shows_its_stages(tmp_path: Path) -> None:
    done = reproduce("--quick", "--figure", "2", "--figure", "8", "--out", "figures", folder=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "figure 2" in done.stdout and "figure 8" in done.stdout
    images = tmp_path / "figures" / "images" / "paper"
    assert sorted(p.name for p in images.iterdir()) == [
        "figure_02.csv",
        "figure_02.png",
        "figure_08.csv",
        "figure_08.png",
    ]
    assert not (tmp_path / "figures" / "paper.md").exists()  # a page of two figures would not be the page
    for name in ("figure_02.png", "figure_08.png"):
        assert (images / name).read_bytes().startswith(b"\x89PNG")
    with (images / "figure_08.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert {r["method"] for r in rows} >= {"HOM", "MT", "TBR"}
    assert all(float(r["stepping_s"]) > 0 for r in rows)


def test_a_figure_that_the_paper_does_not_have_is_refused_in_one_line(tmp_path: Path) -> None:
    done = reproduce("--figure", "1", folder=tmp_path)
    assert done.returncode == 2
    assert "figure 1: expected numbers from 2 to 16" in done.stderr
    assert list(tmp_path.iterdir()) == []


def test_the_transform_of_the_spot_is_its_fourier_integral() -> None:
    radius, k = 0.4, 7.0

    def integrand(r: float, angle: float) -> float:
        return float(r * spot_load.spot(np.array(r), radius) * np.cos(k * r * np.cos(angle)))

    expected, _ = dblquad(integrand, 0, 2 * np.pi, 0, radius)
    assert spot_load.spot_transform(np.array([k]), radius)[0] == pytest.approx(expected, rel=1e-7)


def test_modal_histories_solve_the_equation_of_motion_with_memory() -> None:
    mu, gamma, tau = 30.0, 1.0, 1.0

    def motion(t: float, y: list[float]) -> list[float]:
        q, v, z = y
        load = t / 10 if t < 0.2 else 0.0
        return [v, load - mu * (q + gamma * z), v - z / tau]

    solved = solve_ivp(motion, (0, 1), [0, 0, 0], rtol=1e-10, atol=1e-14, max_step=0.01)
    history = spot_load.modal_history(np.array([mu]), PronySeries((gamma,), (tau,)), 0.1, 10)
    assert history[-1, 0] == pytest.approx(solved.y[0, -1], rel=1e-5)


def test_the_series_of_the_square_satisfies_the_boundary_and_has_the_spots_mean() -> None:
    axis = np.linspace(0, 1, 81)
    points = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    _, shapes, load = spot_load.square_modes(points, 0.4)
    pressure = shapes @ load  # the modal expansion of the spot itself
    expected = spot_load.spot(np.linalg.norm(points - 0.5, axis=1), 0.4)
    assert np.max(np.abs(pressure - expected)) < 1e-3 * expected.max()


def test_drag_adds_c_s_to_every_mode() -> None:
    cloud = disc_membrane(60)
    modes = elastic_modes(membrane.conservative(cloud, [center_of(cloud)]))
    system = with_drag(modes, 0.3)
    s = np.array([0.1 + 2j, 3j, 1.0])
    b = modes.input_coupling[:, 0]
    expected = modes.direct_stiffness[0, 0] - np.sum(
        b**2 / (s[:, None] ** 2 + 0.3 * s[:, None] + modes.squared_frequencies), axis=1
    )
    assert np.allclose(system.transfer(s)[:, 0, 0], expected, rtol=1e-10)
    assert system.n_states == 2 * modes.n_modes
    assert system.spectral_abscissa == pytest.approx(-0.15)


def test_the_compiled_loop_steps_the_exact_response() -> None:
    example = square(9)
    stepped = step_through(sampled(example.system, PERIOD_S), example.inputs)[0]
    exact = example.system.response(example.inputs, PERIOD_S)
    assert np.max(np.abs(stepped - exact)) < 1e-10 * np.max(np.abs(exact))


def test_the_pulse_is_the_papers() -> None:
    u = pulse(0.4)
    assert u[100] == pytest.approx(0.01)
    assert u[199] == pytest.approx(0.0199)
    assert np.all(u[200:] == 0)


def over_time(errors: list[convergence.Error], method: str) -> np.ndarray:
    """(n_clouds,), from the coarsest to the finest."""
    return np.array([e.over_time for e in errors if e.method == method])


def test_deflections_on_lattices_converge_at_second_order_but_for_linear_collocation() -> None:
    # Second order is theory for linear elements, for first derivatives of linear consistency on even nodes and for
    # second ones of quadratic consistency there. The next term of the error is (k h)² times the first, k = pi / a being
    # the wave number of a spot of radius a: by that much an order observed at a spacing h may depart from 2.
    counts = np.array([9, 13, 19, 27])
    lattices = [square_membrane(n * n) for n in counts]
    errors = convergence.membrane_errors(
        lattices, SQUARE_PRONY, convergence.SQUARE_SPOT, spot_load.square_modes
    )
    spacing = 1 / (counts - 1)
    departure = (np.pi / convergence.SQUARE_SPOT) ** 2 * spacing[:-1] * spacing[1:]
    for method in ("conservative", "linear finite elements", "collocation, quadratic"):
        order = np.diff(np.log(over_time(errors, method))) / np.diff(np.log(spacing))
        assert np.all(np.abs(order - 2) < departure), (method, order, departure)
    # Linear consistency is order 0 for second derivatives: what is left at the finest is no nearer to zero.
    stuck = over_time(errors, "collocation, linear")
    assert stuck[-1] > stuck[-2] > stuck[-3]


@pytest.mark.slow
def test_on_scattered_nodes_the_conservative_deflections_converge_and_linear_collocation_does_not() -> None:
    errors = convergence.scattered_square_errors([square_membrane(n * n) for n in (9, 27)], 4)

    def order(method: str) -> float:
        coarse, fine = over_time(errors, f"{method}, scattered")
        return float(np.log(coarse / fine) / np.log(26 / 8))

    # Theory has order 1 for the one and order 0 for the other: each must be nearer to its own.
    assert order("conservative") > 0.5
    assert order("collocation, linear") < 0.5


@pytest.mark.slow
def test_the_cubes_displacement_converges_to_quadratic_hexahedra() -> None:
    # Where the held bottom meets free sides the displacement grows like r^lambda with 1/2 < lambda < 1 (0.71 for
    # nu = 0.3 in plane strain, Williams 1952). That leaves linear elements the L2 order 2 lambda, above one: half the
    # spacing, less than half the error.
    errors = convergence.cube_errors((5, 9), 8)
    for method in ("conservative", "linear finite elements"):
        coarse, fine = (e.value for e in errors if e.method == method)
        assert fine < coarse / 2, method


def test_a_quarter_of_the_cube_has_a_quarter_of_its_mass() -> None:
    body = finite_elements.quarter_cube(2, CUBE_MATERIAL)
    along_z = (body.components == 2).astype(float)
    assert along_z @ body.mass @ along_z == pytest.approx(CUBE_MATERIAL.density_kg_per_m3 / 4)
    assert body.places.min(axis=0) == pytest.approx([0.5, 0.5, 0.0])


def test_hankel_optimal_reduction_errs_at_infinite_frequency_by_the_first_value_left_out(
    study: Study,
) -> None:
    full = study.square.system
    reduced = study.reduced(study.square, HOM, 8)
    assert reduced is not None
    error = np.linalg.norm(full.d - reduced.system.d, 2)
    assert error == pytest.approx(reduced.hankel_singular_values[reduced.order], rel=1e-6)


def test_the_observed_order_of_a_power_law_is_its_exponent() -> None:
    nodes = [n**3 for n in (4, 6, 9)]
    assert convergence.observed_order(nodes, [5.0 * n ** (-1.7 / 3) for n in nodes], 3) == pytest.approx(1.7)
    # The finest three clouds are told apart from all of them.
    errors = [convergence.Error("any", n * n, float(n) ** (-1 if n < 4 else -3)) for n in (2, 4, 6, 9)]
    orders = convergence.Orders.of(errors, 2)
    assert orders.finest == pytest.approx(3.0)
    assert orders.all_clouds != pytest.approx(3.0, abs=0.1)
    assert orders.over_time is None


def test_accuracies_are_compared_on_the_same_nodes_and_in_the_same_variant() -> None:
    errors = [
        convergence.Error(method, n, value)
        for method, values in {
            "conservative": (0.2, 0.05),
            "linear finite elements": (0.1, 0.1),
            "collocation, linear": (0.3, 0.4),
            "collocation, linear, scattered": (0.9, 0.9),
            "linear finite elements, scattered": (0.3, 0.1),
        }.items()
        for n, value in zip((100, 400), values, strict=True)
    ]
    said = convergence.convergence_figure(3, "Disc: any", errors, 2, "").findings
    assert "collocation, linear is less accurate at every number of nodes (3 to 4 times the error)" in said
    assert "collocation, linear, scattered is less accurate at every number of nodes (3 to 9 times" in said
    assert "That confirms the paper's finding, for its own method" in said
    assert "is more accurate at 1 of 2 numbers of nodes (2 times the error at the coarsest, 0.5 times" in said
    # The text of the paper ranks the accuracies in figure 3 alone.
    assert "finding" not in convergence.convergence_figure(6, "Square: any", errors, 2, "").findings


def test_the_membranes_frequencies_converge_at_second_order() -> None:
    # Abramowitz & Stegun, table 9.5, and pi sqrt(2).
    assert membrane_frequencies.disc_frequencies()[:4] == pytest.approx(
        [2.40483, 3.83171, 3.83171, 5.13562], abs=5e-6
    )
    assert membrane_frequencies.square_frequencies()[:3] == pytest.approx([4.44288, 7.02481, 7.02481])
    # Errors c h² (1 + h) with h = 1/7 and 1/15, the coarsest and the finest square, have an order within 1/8 of 2. The rings
    # of the disc are no refinements of each other: with this few it is only that each has smaller errors than the last.
    for errors in (membrane_frequencies.disc(quick=True), membrane_frequencies.square(quick=True)):
        methods = [e.method for e in errors]
        assert methods == ["conservative", "collocation, quadratic", "linear finite elements"]
        assert all(np.all(np.diff(e.values) < 0) for e in errors)
    assert all(e.order > 2 - 1 / 8 for e in errors), errors
    assert (
        "| conservative | 1 % at 100 nodes | 0.5 % at 200 nodes | 0.25 % at 400 nodes | 2.00 |"
        in membrane_frequencies.table(
            [membrane_frequencies.FrequencyErrors("conservative", (100, 200, 400), (0.0101, 0.005, 0.0025))],
            "any",
        )
    )


def test_jittered_nodes_share_the_whole_square() -> None:
    cloud = convergence.jittered(square_membrane(81))
    assert cloud.areas.sum() == pytest.approx(1.0)
    assert np.array_equal(cloud.points[cloud.on_edge], square_membrane(81).points[cloud.on_edge])


def test_reductions_keep_their_bounds_and_their_rank(study: Study) -> None:
    system = study.square.system
    for method in (HOM, TBR, MT, MT_STATICS):
        for order in (4, 8, 12):
            reduced = study.reduced(study.square, method, order)
            assert reduced is not None and reduced.bound is not None
            omega = all_frequencies((system, reduced.system))
            error = spectral_norms(system.transfer(1j * omega) - reduced.system.transfer(1j * omega))
            assert np.max(error) <= reduced.bound
    # The full lattice has the symmetries of the square: the middle node moves few of its modes.
    everything = study.reduced(study.square, TBR, 1000)
    assert everything is not None and everything.order < system.n_states / 4


def test_every_method_has_a_reduced_model_of_the_cube(study: Study) -> None:
    for method in ALL:
        reduced = study.reduced(study.cube, method, 60)
        assert reduced is not None and reduced.order <= 60, method.name
        assert reduced.system.spectral_abscissa < 0


def test_the_product_is_per_cent_times_seconds(study: Study) -> None:
    reduced = study.reduced(study.square, MT, 12)
    assert reduced is not None
    comparison = Comparison(reduced, 0.5, 0.5, 0.5, 0.0, 0.02, 3.0, None)
    assert comparison.product == pytest.approx(6.0)


def test_the_ranking_follows_the_numbers_and_says_what_is_equal() -> None:
    def text(value: float) -> str:
        return f"{value:g}"

    assert ranking({"HOM": 3.0, "MT": 1.0, "TBR": 2.0}, text) == "MT (1) < TBR (2) < HOM (3)"
    assert ranking({"HOM": 1.05, "MT": 1.0}, text) == "MT (1) ≈ HOM (1.05)"
    # Equal to the least of a group, not to the neighbor: a chain of small steps is no equality.
    assert ranking({"HOM": 1.9, "MT": 1.0, "TBR": 3.0}, text, 2.0) == "MT (1) ≈ HOM (1.9) < TBR (3)"
    assert [m.name for m in OF_THE_PAPER] == ["HOM", "MT", "TBR"]


def point(method: Method, requested: int, order: int, error: float) -> orders.Point:
    return orders.Point("square", method, requested, order, error, error, error, 0.0)


def test_methods_that_need_equally_many_states_share_the_first_place(study: Study) -> None:
    measured = [
        point(HOM, 10, 9, 0.5),
        point(HOM, 20, 19, 0.01),
        point(TBR, 10, 10, 0.5),
        point(TBR, 20, 20, 0.001),
        point(MT, 20, 18, 0.5),
    ]
    said = orders.fewest_states(measured, study.square)
    assert said.startswith("over all frequencies HOM = TBR (20), ")
