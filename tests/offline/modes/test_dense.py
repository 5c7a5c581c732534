"""The dense modes: what does not depend on the discretization."""

import numpy as np
import pytest
from scipy.linalg import eigh
from scipy.sparse import csr_array

from palpate.discretization.assembled_body import AssembledBody
from palpate.discretization.nodal import NodalBasis
from palpate.discretization.supports import supports
from palpate.modes.dense import elastic_modes

EPS = np.finfo(float).eps


def _chain(symmetric, mass):
    """Springs of 1 N/m between six masses on a line, node 0 held, the last node the tip; parameters are not the values."""
    n = len(mass)
    stiffness = 2 * np.eye(n) - np.eye(n, k=1) - np.eye(n, k=-1)
    stiffness[0, 0] = stiffness[-1, -1] = 1
    h = np.eye(n) + 0.2 * (np.eye(n, k=1) + np.eye(n, k=-1))
    on_parameters = (h.T if symmetric else np.eye(n)) @ stiffness @ h
    basis = NodalBasis(np.arange(float(n))[:, None], np.ones(n), csr_array(h))
    body = AssembledBody(basis, csr_array(on_parameters), mass, supports(n, [0], [[n - 1]]), symmetric)
    return body, stiffness


@pytest.mark.parametrize("symmetric", [True, False])
def test_modes_and_forces_are_those_of_the_nodal_values_whatever_the_parameters(symmetric):
    mass = np.array([1.0, 1.0, 2.0, 3.0, 1.0, 1.0])
    body, stiffness = _chain(symmetric, mass)
    modes = elastic_modes(body)
    free = slice(1, 5)
    expected = eigh(stiffness[free, free], np.diag(mass[free]), eigvals_only=True)
    np.testing.assert_allclose(modes.squared_frequencies, expected, atol=100 * EPS * expected[-1])
    # Five springs in series.
    np.testing.assert_allclose(modes.static_stiffness, 0.2, rtol=1e3 * EPS)
    np.testing.assert_allclose(modes.direct_stiffness, 1.0, rtol=1e3 * EPS)


@pytest.mark.parametrize("symmetric", [True, False])
def test_nodes_without_mass_follow_in_equilibrium(symmetric):
    mass = np.array([1.0, 1.0, 0.0, 3.0, 0.0, 1.0])
    body, stiffness = _chain(symmetric, mass)
    modes = elastic_modes(body)
    assert modes.n_modes == 2
    np.testing.assert_allclose(modes.static_stiffness, 0.2, rtol=1e3 * EPS)
    for parameters in (modes.parameters, modes.patch_parameters):
        fields = body.basis.values(parameters)
        np.testing.assert_allclose((stiffness @ fields)[[2, 4]], 0, atol=100 * EPS * np.abs(fields).max())
