"""The lowest modes and the static compliance of held bodies against the dense path."""

from dataclasses import replace

import numpy as np
import pytest

from palpate.discretization import conservative
from palpate.discretization.supports import components, supports
from palpate.geometry.shapes import box_lattice
from palpate.modes import lanczos
from palpate.modes.compliance import static_compliance
from palpate.modes.dense import elastic_modes, nodal_stiffness
from palpate.modes.held_body import hold
from palpate.modes.lanczos import lowest_modes
from palpate.scene.tissues import PRESETS

EPS = np.finfo(float).eps


def _held(counts, jitter):
    """A block of liver held at its lower side; a cube without jitter has pairs of equal modes."""
    cloud = box_lattice((0, 0, 0), (0.04, 0.04, 0.04), counts, jitter, seed=2)
    bottom = np.flatnonzero(cloud.points[:, 2] == 0)
    body = conservative.assemble(cloud, PRESETS["liver"], bottom, [])
    return cloud, hold(body, bottom)


@pytest.mark.parametrize("jitter", [0.0, 0.1])
@pytest.mark.parametrize("n_modes", [1, 40])
def test_the_lowest_modes_are_those_of_the_dense_path(jitter, n_modes):
    _, held = _held((6, 6, 6), jitter)
    found, expected = lowest_modes(held, n_modes), elastic_modes(held.body)
    np.testing.assert_allclose(found.squared_frequencies, expected.squared_frequencies[:n_modes], rtol=1e-9)
    mass = held.body.inertia(found.parameters)
    np.testing.assert_allclose(found.parameters.T @ mass, np.eye(n_modes), atol=1e-10)
    # K v - mu M v vanishes but for the reactions of the held nodes.
    residual = held.project(held.body.stiffness @ found.parameters - mass * found.squared_frequencies)
    assert np.linalg.norm(residual) < 1e-4 * np.linalg.norm(mass * found.squared_frequencies)


def test_all_modes_there_are_can_be_asked_for_and_no_more():
    _, held = _held((3, 3, 3), 0.1)
    expected = elastic_modes(held.body)
    found = lowest_modes(held, 54)
    np.testing.assert_allclose(found.squared_frequencies, expected.squared_frequencies, rtol=1e-8)
    with pytest.raises(ValueError, match="n_modes = 55: expected from 1 to 54"):
        lowest_modes(held, 55)


def test_a_missed_mode_is_noticed_by_the_inertia():
    _, held = _held((5, 5, 5), 0.1)
    mu = elastic_modes(held.body).squared_frequencies
    lanczos._require_none_missed(held, mu[:30], 22)
    with pytest.raises(np.linalg.LinAlgError, match="modes lie below"):
        lanczos._require_none_missed(held, np.delete(mu, 7)[:30], 22)


def test_the_compliance_is_that_of_the_nodal_values():
    cloud, held = _held((5, 5, 5), 0.1)
    free = np.setdiff1d(np.flatnonzero(cloud.boundary), held.nodes)
    compliance = static_compliance(held, cloud.points[free])
    alone = replace(held.body, supports=supports(cloud.n_nodes, held.nodes, []))
    stiffness = nodal_stiffness(alone)
    rows = components(np.searchsorted(alone.supports.free, free), 3)
    expected = np.linalg.inv(stiffness)[np.ix_(rows, rows)]
    tolerance = 1e3 * EPS * np.linalg.cond(stiffness) * np.abs(expected).max()
    np.testing.assert_allclose(compliance, expected, atol=tolerance)
    assert np.all(np.linalg.eigvalsh(compliance) > 0)
