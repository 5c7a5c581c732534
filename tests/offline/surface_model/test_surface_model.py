"""Surface models of small bodies against direct solutions of the assembled body, at rest and in the band."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from scipy.sparse import csr_array
from scipy.sparse.linalg import splu

from palpate.discretization import conservative
from palpate.discretization.assembled_body import AssembledBody
from palpate.discretization.supports import components
from palpate.geometry.cloud import NodeCloud
from palpate.geometry.shapes import box_lattice
from palpate.modes.compliance import static_compliance
from palpate.modes.dense import elastic_modes
from palpate.modes.held_body import HeldBody, hold
from palpate.modes.lanczos import LowestModes, lowest_modes
from palpate.progress import NO_PROGRESS
from palpate.scene.tissues import PRESETS
from palpate.surface_model import evidence
from palpate.surface_model.footprint import footprints, on_components
from palpate.surface_model.mode_count import enough_modes, guessed_modes, sample_footprints
from palpate.surface_model.residual import Residual, residual
from palpate.surface_model.rounding import rounded

LIVER = PRESETS["liver"]
RADIUS_M = 0.012
N_MODES = 40


@dataclass(frozen=True)
class Block:
    cloud: NodeCloud
    body: AssembledBody
    held: HeldBody
    nodes: np.ndarray
    free: np.ndarray
    rows: csr_array
    footprints: csr_array
    modes: LowestModes
    left: Residual
    shapes: np.ndarray

    @property
    def compliance(self) -> np.ndarray:
        """(3 n_points, 3 n_points), of the model at rest."""
        flat = self.shapes.reshape(3 * len(self.nodes), -1)
        return self.left.compliance + (flat / self.modes.squared_frequencies) @ flat.T

    @property
    def met(self) -> evidence.Footprints:
        return evidence.averaged(
            self.shapes,
            self.left.compliance,
            self.left.inertia,
            self.modes.squared_frequencies,
            self.footprints,
        )


@pytest.fixture(scope="module")
def block() -> Block:
    """A block of liver of 60 x 48 x 36 mm held at its lower side, with 40 modes."""
    cloud = box_lattice((0, 0, 0), (0.06, 0.048, 0.036), (6, 5, 4), 0.15, seed=3)
    bottom = np.flatnonzero(cloud.points[:, 2] == 0)
    body = conservative.assemble(cloud, LIVER, bottom, [])
    held = hold(body, bottom)
    nodes = np.flatnonzero(cloud.boundary)
    free = np.flatnonzero(~np.isin(nodes, bottom))
    rows = csr_array(body.basis.value[nodes])
    spread = footprints(cloud.points[nodes], cloud.normals[nodes], cloud.areas[nodes], RADIUS_M)
    modes = lowest_modes(held, N_MODES)
    left = residual(held, modes, rows, free, spread, NO_PROGRESS)
    shapes = (on_components(rows) @ modes.parameters).reshape(len(nodes), 3, -1)
    return Block(cloud, body, held, nodes, free, rows, spread, modes, left, shapes)


def _direct(block: Block, frequency_hz: float, loads: np.ndarray) -> np.ndarray:
    """Displacements conjugate to the loads (3 n_nodes, k), (k, k), m/N, of the assembled body with its constraints as they stand.

    The saddle-point system of h K - w² M with the held values at zero, by a complex factorization.
    """
    s = 2j * np.pi * frequency_hz
    h = LIVER.prony.transfer_factor(np.array([s]))[0]
    value = on_components(csr_array(block.body.basis.value)).toarray()
    mass = value.T @ (np.repeat(block.body.mass, 3)[:, None] * value)
    dynamic = h * block.body.stiffness.toarray() + s**2 * mass
    constraints = value[components(block.held.nodes, 3)]
    zero = np.zeros((len(constraints), len(constraints)))
    saddle = np.block([[dynamic, constraints.T], [constraints, zero]])
    right = np.vstack([loads, np.zeros((len(constraints), loads.shape[1]))])
    response = splu(csr_array(saddle).tocsc()).solve(right.astype(complex))
    return loads.T @ response[: len(loads)]


def test_at_rest_the_model_is_the_static_solution_between_all_points(block: Block) -> None:
    points = block.cloud.points[block.nodes]
    expected = static_compliance(block.held, points)
    # The supports of the residual give way by the compliance of their penalty, a few parts in a million.
    np.testing.assert_allclose(block.compliance, expected, atol=1e-5 * np.abs(expected).max())


def test_held_points_have_no_compliance(block: Block) -> None:
    is_held = np.ones(len(block.nodes), bool)
    is_held[block.free] = False
    assert not block.left.compliance[np.repeat(is_held, 3)].any()
    assert np.abs(block.shapes[is_held]).max() < 1e-9 * np.abs(block.shapes).max()


def test_the_residual_is_semidefinite_and_its_inertia_that_of_the_modes_left_out(block: Block) -> None:
    np.testing.assert_array_equal(block.left.compliance, block.left.compliance.T)
    eigenvalues = np.linalg.eigvalsh(block.left.compliance)
    assert eigenvalues[0] > -1e-12 * eigenvalues[-1]
    every = elastic_modes(block.body)
    shapes = (on_components(csr_array(block.footprints @ block.rows)) @ every.parameters).reshape(
        len(block.nodes), 3, -1
    )[:, :, N_MODES:]
    expected = (shapes / every.squared_frequencies[N_MODES:] ** 2) @ shapes.transpose(0, 2, 1)
    np.testing.assert_allclose(block.left.inertia, expected, atol=1e-4 * np.abs(expected).max())


@pytest.mark.parametrize("frequency_hz", [5.0, 15.0, 29.0])
def test_in_the_band_the_force_error_is_below_its_bound_and_the_bound_is_not_far_off(
    block: Block, frequency_hz: float
) -> None:
    chosen = block.free[::9]
    loads = on_components(csr_array(block.footprints[chosen] @ block.rows)).T.toarray()
    exact = _direct(block, frequency_hz, loads)
    met = block.met.of(chosen)
    bounds = evidence.error_bound(met, LIVER.prony, np.array([frequency_hz]))
    s = 2j * np.pi * frequency_hz
    h = complex(LIVER.prony.transfer_factor(np.array([s]))[0])
    model = met.compliance(1 / (s**2 + met.squared_frequencies * h), 1 / h)
    errors = np.array(
        [
            np.linalg.norm(np.linalg.solve(c, exact[3 * i : 3 * i + 3, 3 * i : 3 * i + 3] - c), 2)
            for i, c in enumerate(model)
        ]
    )
    assert np.all(errors <= bounds * (1 + 1e-3) + 1e-5)
    assert np.median(bounds / errors) < 4


def test_a_frequency_beyond_the_kept_modes_is_refused(block: Block) -> None:
    highest = np.sqrt(block.modes.squared_frequencies[-1]) / (2 * np.pi)
    with pytest.raises(ValueError, match=r"surface.modes = 40 reach .* Hz: expected modes beyond"):
        evidence.error_bound(block.met, LIVER.prony, np.array([2 * highest]))


def test_static_errors_are_zero_for_the_exact_compliance_and_as_large_as_a_change_of_it(block: Block) -> None:
    met = block.met
    chosen = block.free[:3]
    exact = met.of(chosen).compliance((1 / met.squared_frequencies).astype(complex), 1.0).real
    assert evidence.static_errors(met, chosen, exact).max() < 1e-12
    np.testing.assert_allclose(evidence.static_errors(met, chosen, 1.03 * exact), 0.03, rtol=1e-9)


def test_no_energy_comes_out_and_a_negative_residual_is_noticed(block: Block) -> None:
    met = block.met.of(block.free)
    for margin in (evidence.passivity_margin, evidence.passivity_margin_sampled):
        assert margin(met, LIVER.prony, 1e-3) >= 0
        wrong = evidence.Footprints(met.shapes, -met.residual, met.inertia, met.squared_frequencies)
        assert margin(wrong, LIVER.prony, 1e-3) < -1e-4


def test_the_largest_stiffness_is_that_of_one_tick_of_the_equations_of_motion(block: Block) -> None:
    """One mode and one residual each, stepped as the equations are written."""
    period, prony = 1e-3, LIVER.prony
    shapes, residue, mu = np.zeros((1, 3, 1)), np.zeros((1, 3, 3)), np.array([(2 * np.pi * 20) ** 2])
    shapes[0, 2, 0], residue[0, 2, 2] = 0.7, 2e-4
    met = evidence.Footprints(shapes, residue, np.zeros((1, 3, 3)), mu)
    squared, effective = evidence.prewarped(mu, shapes, period)
    # Unknown at the end of the tick: displacement, speed and one strain for each branch, all starting at 0, force 1.
    gamma, tau = np.array(prony.gamma), np.array(prony.tau_s)
    n = len(gamma)
    a, right = np.zeros((2 + n, 2 + n)), np.zeros(2 + n)
    a[0, :2] = 1 / period, -0.5  # q' = v at the middle
    a[1, 0], a[1, 1], a[1, 2:] = (
        squared[0] / 2,
        1 / period,
        squared[0] * gamma / 2,
    )  # v' = -w² (q + sum gamma z) + phi f
    right[1] = effective[0, 2, 0]
    for j in range(n):  # z' = -z / tau + q'
        a[2 + j, 2 + j], a[2 + j, 0] = 1 / period + 0.5 / tau[j], -1 / period
    modal = effective[0, 2, 0] * np.linalg.solve(a, right)[0]
    # f = h y by backward Euler from rest: y (1 + sum gamma / (1 + T/tau)) = f.
    massless = residue[0, 2, 2] / (1 + np.sum(gamma / (1 + period / tau)))
    found = evidence.largest_stiffness(met, np.array([[0.0, 0.0, 1.0]]), prony, period)
    assert found == pytest.approx(1 / (modal + massless), rel=1e-12)


def test_rounding_to_single_precision_keeps_the_residual_definite_with_a_small_shift(block: Block) -> None:
    single, shift = rounded(block.left.compliance, block.free)
    assert single.dtype == np.float32
    np.testing.assert_array_equal(single, single.T)
    columns = components(block.free, 3)
    assert np.linalg.eigvalsh(single[np.ix_(columns, columns)].astype(float))[0] >= 0
    assert 0 < shift < 1e-6 * np.abs(block.left.compliance).max()
    np.testing.assert_allclose(single, block.left.compliance, atol=shift + 2**-23 * np.abs(single).max())


def test_a_residual_with_a_negative_eigenvalue_is_refused(block: Block) -> None:
    columns = components(block.free, 3)
    wrong = block.left.compliance.copy()
    wrong[columns[0], columns[0]] = -1e-3 * wrong.max()
    with pytest.raises(np.linalg.LinAlgError, match="not positive semidefinite"):
        rounded(wrong, block.free)


@pytest.mark.parametrize("tolerance", [0.2, 0.05])
def test_as_many_modes_are_kept_as_the_tolerance_needs_and_not_many_more(
    block: Block, tolerance: float
) -> None:
    sample = sample_footprints(block.rows, block.footprints, block.free)
    frequencies = evidence.band_frequencies((0.0, 15.0))
    modes = enough_modes(block.held, sample, LIVER, frequencies, tolerance, 10, NO_PROGRESS)

    def error(kept: LowestModes) -> float:
        left = residual(block.held, kept, block.rows, block.free, block.footprints, NO_PROGRESS)
        shapes = (on_components(block.rows) @ kept.parameters).reshape(len(block.nodes), 3, -1)
        met = evidence.averaged(
            shapes, left.compliance, left.inertia, kept.squared_frequencies, block.footprints
        )
        return float(evidence.error_bound(met.of(sample.points), LIVER.prony, frequencies).max())

    assert error(modes) <= 0.9 * tolerance * 1.001
    fewer = int(0.7 * len(modes.squared_frequencies))
    if modes.squared_frequencies[fewer - 1] > 1.1 * (2 * np.pi * 15) ** 2:
        less = LowestModes(modes.squared_frequencies[:fewer], modes.parameters[:, :fewer])
        assert error(less) > 0.9 * tolerance


def test_a_tolerance_out_of_reach_is_refused(block: Block) -> None:
    sample = sample_footprints(block.rows, block.footprints, block.free)
    with pytest.raises(ValueError, match=r"surface.tolerance = 1e-12: .* modes reach"):
        enough_modes(block.held, sample, LIVER, np.array([15.0]), 1e-12, 10**6, NO_PROGRESS)


def test_the_number_of_modes_is_guessed_to_a_factor_of_two(block: Block) -> None:
    every = np.sqrt(elastic_modes(block.body).squared_frequencies) / (2 * np.pi)
    guess = guessed_modes(LIVER, 0.06 * 0.048 * 0.036, 2 * (0.06 * 0.048 + 0.108 * 0.036), 30.0, 0.05)
    assert 0.5 < guess / np.count_nonzero(every < 2.4 * 30) < 2


def test_a_footprint_spreads_a_unit_force_as_the_pressure_of_hertz() -> None:
    """On a fine lattice: the mean of r² under sqrt(1 - r²/a²) is 2/5 a²."""
    side = np.linspace(-0.01, 0.01, 41)
    points = np.array([(x, y, 0.0) for x in side for y in side])
    normals = np.tile([0.0, 0.0, 1.0], (len(points), 1))
    spread = footprints(points, normals, np.full(len(points), 1.0), 0.008)
    center = int(np.argmin(np.linalg.norm(points, axis=1)))
    weights = spread[[center]].toarray()[0]
    assert weights.sum() == pytest.approx(1)
    distance = np.linalg.norm(points, axis=1)
    radius = 0.008 * np.sqrt(0.5)
    assert not weights[distance > radius].any()
    assert weights @ distance**2 == pytest.approx(0.4 * radius**2, rel=0.02)


def test_a_footprint_does_not_reach_through_a_thin_part() -> None:
    points = np.array([[0, 0, 0], [0.001, 0, 0], [0, 0, -0.001]])
    normals = np.array([[0, 0, 1.0], [0, 0, 1.0], [0, 0, -1.0]])
    spread = footprints(points, normals, np.ones(3), 0.008).toarray()
    assert (spread > 0).tolist() == [[True, True, False], [True, True, False], [False, False, True]]
