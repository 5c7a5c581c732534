"""Surface models of small bodies against direct solutions of the assembled body, at rest and in the band."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from scipy.sparse import csr_array, eye_array
from scipy.sparse.linalg import splu

from palpate.discretization import conservative
from palpate.discretization.assembled_body import AssembledBody
from palpate.discretization.supports import components
from palpate.geometry.cloud import NodeCloud
from palpate.geometry.node_surface import node_surface
from palpate.geometry.shapes import box_lattice
from palpate.model_file import SurfaceAccuracy, SurfaceModel
from palpate.model_file.surface_model import SAMPLE_SIZE
from palpate.modes.compliance import static_compliance
from palpate.modes.dense import elastic_modes
from palpate.modes.held_body import HeldBody, hold
from palpate.modes.lanczos import LowestModes, lowest_modes
from palpate.progress import NO_PROGRESS
from palpate.scene.tissues import PRESETS
from palpate.surface_model import evidence
from palpate.surface_model.enough import enough_vectors
from palpate.surface_model.footprint import footprints, on_components
from palpate.surface_model.mode_count import guessed_modes, modes_up_to
from palpate.surface_model.reference import reference_model
from palpate.surface_model.residual import Residual, modal_compliance, residual
from palpate.surface_model.ritz_vectors import Added, added, dominant_fields
from palpate.surface_model.rounding import rounded
from palpate.surface_model.sample import Sample, exact_compliance, sample_footprints

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
    left = residual(held, modes, rows, free, NO_PROGRESS)
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


def test_the_residual_is_semidefinite_and_its_responses_are_orthogonal_to_the_modes(block: Block) -> None:
    np.testing.assert_array_equal(block.left.compliance, block.left.compliance.T)
    eigenvalues = np.linalg.eigvalsh(block.left.compliance)
    assert eigenvalues[0] > -1e-12 * eigenvalues[-1]
    along = block.left.responses @ block.body.inertia(block.modes.parameters)
    assert np.abs(along).max() < 1e-6 * np.sqrt(np.abs(block.left.responses).max())


@pytest.fixture(scope="module")
def sample(block: Block) -> Sample:
    """All points that are not held, every second of them in the working area."""
    return sample_footprints(block.rows, block.footprints, block.free, block.free[::2])


@pytest.mark.parametrize("frequency_hz", [0.0, 15.0, 30.0])
def test_the_exact_compliance_is_that_of_the_assembled_body(
    block: Block, sample: Sample, frequency_hz: float
) -> None:
    found = exact_compliance(block.held, block.modes, sample, LIVER.prony, np.array([frequency_hz]))
    direct = _direct(block, frequency_hz, sample.loads)
    for i, compliance in enumerate(found.compliance[0]):
        expected = direct[3 * i : 3 * i + 3, 3 * i : 3 * i + 3]
        assert np.linalg.norm(compliance - expected, 2) < 1e-4 * np.linalg.norm(expected, 2)
        if frequency_hz == 0:
            assert np.linalg.norm(found.static[i] - expected, 2) < 1e-9 * np.linalg.norm(expected, 2)


def test_a_sample_has_points_inside_and_outside_of_the_working_areas(block: Block) -> None:
    """Of many points three quarters are inside, of few all."""
    alone = csr_array(eye_array(300))
    some = sample_footprints(alone, alone, np.arange(290), np.arange(200))
    assert len(some.points) == SAMPLE_SIZE == len(set(some.points.tolist()))
    assert np.count_nonzero(some.working) == 153
    few = sample_footprints(block.rows, block.footprints, block.free[:20], block.free[:5])
    np.testing.assert_array_equal(few.points, block.free[:20])
    assert np.count_nonzero(few.working) == 5


def test_errors_are_those_of_the_force_in_the_worst_direction(block: Block, sample: Sample) -> None:
    frequencies = np.array([0.0, 12.0])
    exact = exact_compliance(block.held, block.modes, sample, LIVER.prony, frequencies).compliance
    met = block.met.of(sample.points)
    errors = evidence.force_errors(met, exact, LIVER.prony, frequencies)
    s = 2j * np.pi * 12.0
    h = complex(LIVER.prony.transfer_factor(np.array([s]))[0])
    model = met.compliance(1 / (s**2 + met.squared_frequencies * h), 1 / h)
    for i in (0, 7):
        true_force = np.linalg.inv(exact[1, i])
        difference = np.linalg.inv(model[i]) - true_force
        # Largest of |difference u| / |true_force u| over u.
        assert errors[i] == pytest.approx(np.linalg.norm(difference @ np.linalg.inv(true_force), 2), rel=1e-6)


def test_fields_of_the_most_inertia_reduce_the_error_far_more_than_as_many_modes(block: Block) -> None:
    top = block.cloud.points[block.nodes]
    near = np.linalg.norm(top - [0.03, 0.024, 0.036], axis=1) < 0.015
    sample = sample_footprints(block.rows, block.footprints, np.flatnonzero(near), np.flatnonzero(near))
    frequencies, more = np.linspace(0, 20, 9), 40
    exact = exact_compliance(block.held, block.modes, sample, LIVER.prony, frequencies).compliance

    def error(found: LowestModes) -> float:
        shapes = (sample.loads.T @ found.parameters).reshape(len(sample.points), 3, -1)
        model = block.met.of(sample.points).with_modes(found.squared_frequencies, shapes)
        return float(evidence.force_errors(model, exact, LIVER.prony, frequencies).max())

    spread, weights = on_components(block.footprints), np.where(near, 1.0, 0.1)
    fields = dominant_fields(block.held, block.left.responses, spread, weights, more)
    space = added(block.held, block.modes, fields)
    by_fields = error(space.ritz_modes(space.ends[-1]))
    by_modes = error(lowest_modes(block.held, N_MODES + more))
    assert len(sample.points) >= 5
    assert by_modes < error(block.modes)
    assert by_fields < 0.5 * by_modes


def test_dominant_fields_are_the_principal_directions_in_the_mass(block: Block) -> None:
    spread = on_components(block.footprints)
    weights = np.random.default_rng(2).uniform(0.5, 2, len(block.nodes))
    fields = dominant_fields(block.held, block.left.responses, spread, weights, 6)
    every = (np.repeat(weights, 3)[:, None] * (spread @ block.left.responses.astype(float))).T
    gram = every.T @ block.body.inertia(every)
    largest = np.linalg.eigvalsh(gram)[::-1][:6]
    found = np.sqrt(np.diag(fields.T @ block.body.inertia(fields)))
    np.testing.assert_allclose(found, np.sqrt(largest), rtol=0.1)
    assert np.all(np.diff(found) <= 0)


def test_no_more_vectors_are_added_than_the_tolerance_needs(block: Block) -> None:
    asked: list[int] = []

    def fields(count: int) -> np.ndarray:
        asked.append(count)
        loads = np.random.default_rng(3).standard_normal((3 * len(block.body.mass), count))
        return block.held.approximate(loads)

    def error(space: Added, end: int) -> float:
        return 1.0 / (N_MODES + end)

    found = enough_vectors(block.held, block.modes, fields, error, 1 / 100, 40, NO_PROGRESS)
    assert asked == [40, 64]
    assert N_MODES + 60 <= len(found.squared_frequencies) <= N_MODES + 64
    none = enough_vectors(block.held, block.modes, fields, error, 1 / 40, 40, NO_PROGRESS)
    np.testing.assert_allclose(none.squared_frequencies, block.modes.squared_frequencies, rtol=1e-9)
    with pytest.raises(ValueError, match=r"surface.tolerance: .* vectors reach .* 1e-09 is needed"):
        enough_vectors(block.held, block.modes, fields, error, 1e-9, 3000, NO_PROGRESS)


def test_what_a_projection_leaves_of_the_static_compliance_is_semidefinite(block: Block) -> None:
    """Even where the fields are far from any mode, and those are known to some digits only."""
    rng = np.random.default_rng(5)
    rough = block.modes.parameters * (1 + 1e-6 * rng.standard_normal(block.modes.parameters.shape))
    modes = LowestModes(block.modes.squared_frequencies, block.held.project(rough))
    space = added(block.held, modes, block.held.project(rng.standard_normal((len(rough), 30))))
    found = space.ritz_modes(space.ends[-1])
    whole = block.left.compliance + modal_compliance(block.modes.squared_frequencies, block.shapes)
    shapes = (on_components(block.rows) @ found.parameters).reshape(len(block.nodes), 3, -1)
    left = whole - modal_compliance(found.squared_frequencies, shapes)
    eigenvalues = np.linalg.eigvalsh(left)
    assert eigenvalues[0] > -1e-12 * eigenvalues[-1]


def test_static_errors_are_zero_for_the_exact_compliance_and_as_large_as_a_change_of_it(block: Block) -> None:
    met = block.met
    chosen = met.of(block.free[:3])
    exact = chosen.static()
    assert evidence.static_errors(chosen, exact).max() < 1e-12
    np.testing.assert_allclose(evidence.static_errors(chosen, 1.03 * exact), 0.03, rtol=1e-9)


def test_no_energy_comes_out_and_a_negative_residual_is_noticed(block: Block) -> None:
    met = block.met.of(block.free)
    for margin in (evidence.passivity_margin, evidence.passivity_margin_sampled):
        assert margin(met, LIVER.prony, 1e-3) >= 0
        wrong = evidence.Footprints(met.shapes, -met.residual, met.squared_frequencies)
        assert margin(wrong, LIVER.prony, 1e-3) < -1e-4


def test_the_largest_stiffness_is_that_of_one_tick_of_the_equations_of_motion(block: Block) -> None:
    """One mode and one residual each, stepped as the equations are written."""
    period, prony = 1e-3, LIVER.prony
    shapes, residue, mu = np.zeros((1, 3, 1)), np.zeros((1, 3, 3)), np.array([(2 * np.pi * 20) ** 2])
    shapes[0, 2, 0], residue[0, 2, 2] = 0.7, 2e-4
    met = evidence.Footprints(shapes, residue, mu)
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


def test_all_modes_up_to_a_frequency_are_found_and_one_beyond(block: Block) -> None:
    every = np.sqrt(elastic_modes(block.body).squared_frequencies) / (2 * np.pi)
    for guess in (5, 200):
        found = modes_up_to(block.held, 25.0, guess, NO_PROGRESS)
        count = int(np.count_nonzero(every < 25.0)) + 1
        np.testing.assert_allclose(np.sqrt(found.squared_frequencies) / (2 * np.pi), every[:count], rtol=1e-6)


def test_the_number_of_modes_is_guessed_to_a_factor_of_two(block: Block) -> None:
    every = np.sqrt(elastic_modes(block.body).squared_frequencies) / (2 * np.pi)
    guess = guessed_modes(LIVER, 0.06 * 0.048 * 0.036, 2 * (0.06 * 0.048 + 0.108 * 0.036), 72.0)
    assert 0.5 < guess / np.count_nonzero(every < 72.0) < 2


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


def test_ritz_modes_of_further_fields_come_after_the_modes_and_are_of_the_body(block: Block) -> None:
    fields = np.random.default_rng(1).standard_normal((len(block.body.mass) * 3, 5))
    space = added(block.held, block.modes, block.held.approximate(fields), n_powers=1)
    found = space.ritz_modes(space.ends[-1])
    mu, vectors = found.squared_frequencies, found.parameters
    np.testing.assert_allclose(mu[:N_MODES], block.modes.squared_frequencies, rtol=1e-9)
    assert space.ends == (5, 10) and len(mu) == N_MODES + 10 and np.all(np.diff(mu) > 0)
    np.testing.assert_allclose(vectors.T @ block.body.inertia(vectors), np.eye(len(mu)), atol=1e-8)
    stiffness = vectors.T @ (block.body.stiffness @ vectors)
    np.testing.assert_allclose(stiffness / np.sqrt(np.outer(mu, mu)), np.eye(len(mu)), atol=1e-8)


def test_the_reference_is_the_whole_body_up_to_twice_the_band(block: Block) -> None:
    """Against complex solutions of all equations. What is faster than 250 Hz has no inertia: (30 / 250)² of a small part."""
    points = block.free[::11]
    is_held = np.ones(len(block.nodes), bool)
    is_held[block.free] = False
    model = SurfaceModel(
        name="block", period_s=1e-3, n_nodes=block.cloud.n_nodes, tools=(), points=block.cloud.points[block.nodes],
        normals=block.cloud.normals[block.nodes], triangles=node_surface(block.cloud).triangles, held=is_held,
        squared_frequencies=block.modes.squared_frequencies, shapes=block.shapes.astype(np.float32),
        residual=block.compliance.astype(np.float32), gamma=np.array(LIVER.prony.gamma), tau_s=np.array(LIVER.prony.tau_s),
        band_hz=(0.0, 15.0), config="", config_sha256="", built_with="", accuracy=SurfaceAccuracy.unknown(len(block.nodes)),
    )  # fmt: skip
    reference = reference_model(model, block.held, block.modes, block.rows, points)
    assert reference.n_modes > N_MODES + len(points)
    np.testing.assert_array_equal(reference.points, model.points[points])
    loads = on_components(csr_array(block.rows[points])).T.toarray()
    for frequency_hz in (0.0, 15.0, 30.0):
        s = 2j * np.pi * frequency_hz
        h = LIVER.prony.transfer_factor(np.array([s]))[0]
        shapes = reference.shapes.reshape(3 * len(points), -1).astype(float)
        found = (shapes / (s**2 + h * reference.squared_frequencies)) @ shapes.T + reference.residual / h
        exact = _direct(block, frequency_hz, loads)
        assert np.linalg.norm(found - exact, 2) < 1e-3 * np.linalg.norm(exact, 2)
