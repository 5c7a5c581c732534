"""Newmark's method against the exact response of the linear time-invariant system, and against statics."""

from dataclasses import replace

import numpy as np
import pytest

from palpate.discretization import collocation, conservative
from palpate.discretization.supports import supports
from palpate.geometry.shapes import box_lattice
from palpate.lti.viscoelastic import viscoelastic_system
from palpate.modes.dense import elastic_modes, nodal_stiffness
from palpate.scene.material import Material, PronySeries
from palpate_paper import membrane
from palpate_paper.membranes import disc_membrane
from palpate_paper.time_integration import equations_of_motion, newmark

PRONY = PronySeries((0.8, 0.5), (1.0, 0.1))


def _cube(method):
    cloud = box_lattice((0, 0, 0), (1, 1, 1), (5, 5, 5))
    bottom = np.flatnonzero(cloud.points[:, 2] == 0)
    tip = np.flatnonzero(
        (cloud.points[:, 2] == 1) & (np.linalg.norm(cloud.points[:, :2] - 0.5, axis=1) < 0.3)
    )
    body = method.assemble(cloud, Material(1.0, 0.3, 0.1, PRONY), bottom, [tip])
    return elastic_modes(body), equations_of_motion(body), 3 * tip[0] + 2


def _disc(method):
    body = method(disc_membrane(61), [[0]])
    return elastic_modes(body), equations_of_motion(body), 0


MODELS = {
    "conservative cube": lambda: _cube(conservative),
    "collocated cube": lambda: _cube(collocation),
    "conservative disc": lambda: _disc(membrane.conservative),
    "collocated disc": lambda: _disc(membrane.collocation),
}


@pytest.fixture(params=MODELS, scope="module")
def model(request):
    return MODELS[request.param]()


def _poke(times, n_inputs):
    """A smooth poke, three derivatives continuous, that starts from rest at t = 0."""
    return np.outer(0.1 * np.sin(np.pi * np.minimum(times, 1.0)) ** 4, np.linspace(0.5, 1.0, n_inputs))


def test_newmark_converges_to_the_exact_response_at_second_order(model):
    modes, equations, _ = model
    n_inputs = equations.driving.shape[1]
    coarse, end = 0.02, 2.0
    fine = coarse / 64
    exact = viscoelastic_system(modes, PRONY).response(
        _poke(fine * np.arange(round(end / fine) + 1), n_inputs), fine
    )
    errors = []
    for refinement in (1, 2, 4):
        step = coarse / refinement
        n = round(end / step)
        force = newmark(equations, PRONY, _poke(step * np.arange(n + 1), n_inputs), step).forces
        every = round(step / fine)
        errors.append(np.linalg.norm(force - exact[::every]) / np.linalg.norm(exact[::every]))
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    assert errors[-1] < 5e-3
    assert orders[-1] == pytest.approx(2.0, abs=0.1), (errors, orders)


def test_a_held_tip_relaxes_to_the_static_force(model):
    modes, equations, _ = model
    n_inputs = equations.driving.shape[1]
    ramp = np.minimum(np.arange(1500) * 0.02, 1.0)[:, None] * np.linspace(0.05, 0.1, n_inputs)
    force = newmark(equations, PRONY, ramp, 0.02).forces[-1]
    np.testing.assert_allclose(force, modes.static_stiffness @ ramp[-1], rtol=2e-3, atol=1e-5)


def test_observed_tip_nodes_follow_the_input_exactly(model):
    _, equations, watched = model
    n_inputs = equations.driving.shape[1]
    inputs = _poke(0.05 * np.arange(30), n_inputs)
    history = newmark(equations, PRONY, inputs, 0.05, observed=[watched])
    np.testing.assert_allclose(history.displacements[:, 0], inputs[:, -1], atol=1e-12)


def test_without_a_prony_series_the_conservative_model_conserves_energy_when_the_tip_rests():
    disc = disc_membrane(61)
    body = membrane.conservative(disc, [[0]])
    equations = equations_of_motion(body)
    step, n = 0.01, 600
    times = step * np.arange(n)
    inputs = 0.1 * np.sin(np.pi * np.minimum(times, 0.5) / 0.5)[:, None] ** 4
    u = newmark(equations, PronySeries(), inputs, step, observed=np.arange(disc.n_nodes)).displacements
    stiffness = nodal_stiffness(replace(body, supports=supports(disc.n_nodes, [], [])))
    velocity = (u[2:] - u[:-2]) / (2 * step)
    potential = 0.5 * np.einsum("ti,ij,tj->t", u[1:-1], stiffness, u[1:-1])
    kinetic = 0.5 * velocity**2 @ disc.areas
    resting = (potential + kinetic)[70:]
    assert resting.min() > 0
    assert np.ptp(resting) < 0.02 * resting.mean()  # central differences of the fastest motion, not drift
    drift = np.polyfit(times[71:-1], resting, 1)[0] * (times[-1] - times[71]) / resting.mean()
    assert abs(drift) < 2e-3


def test_inputs_of_the_wrong_shape_and_indices_out_of_range_are_refused(model):
    _, equations, _ = model
    with pytest.raises(ValueError, match=r"inputs has shape \(5,\)"):
        newmark(equations, PRONY, np.zeros(5), 0.01)
    with pytest.raises(ValueError, match="period_s = 0"):
        newmark(equations, PRONY, np.zeros((5, equations.driving.shape[1])), 0.0)
    inputs = np.zeros((5, equations.driving.shape[1]))
    n_values = equations.value.shape[0]
    for index in (-1, n_values):
        with pytest.raises(ValueError, match=f"observed = .* from 0 to {n_values - 1}"):
            newmark(equations, PRONY, inputs, 0.01, observed=[0, index])
