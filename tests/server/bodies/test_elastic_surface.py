"""The step of modes and residual against the transfer function, dense matrices and the balance of energy."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from numba import njit
from numpy.typing import NDArray

from palpate.model_file import SurfaceModel, ToolShape
from palpate_server.bodies import elastic_surface
from palpate_server.bodies.elastic_surface import STORED, WORK, ElasticSurface
from palpate_server.diagnostics.sample_surface import half_space_model
from palpate_server.realtime import native_image
from palpate_server.realtime.native_image import make_image, view

Floats = NDArray[np.float64]

POINTS = (0, 4, 7)


@pytest.fixture(scope="module")
def model() -> SurfaceModel:
    prony = ([0.5, 1.5], [0.2, 0.01])
    return half_space_model([ToolShape("tip", 5e-3, 0.0, (0.0, 0.0, 0.01))], count=3, prony=prony, n_modes=5)


class Watched:
    """A body with point i watched in slot i. Its image is what compiled code takes."""

    def __init__(self, model: SurfaceModel) -> None:
        self.body = elastic_surface.make_body(model, model.n_points, 2)
        native_image.register("elastic_surface", self.body)
        self.image = make_image(self.body)
        watch_all(self.image)

    def run(
        self, points: Sequence[int], forces: Floats, shares: Floats | float = 1.0
    ) -> tuple[Floats, Floats]:
        """Steps under forces (n, n_forces, 3), N, at these points.

        Returns displacements of all points (n, n_points, 3), m, after each step, and its work and the energy stored then (n, 2), J.
        """
        n = len(forces)
        displacement, energies = np.empty((n, self.body.watched.size, 3)), np.empty((n, 2))
        shares = np.broadcast_to(np.asarray(shares, float), (n,)).copy()
        run(
            self.image,
            np.array(points),
            np.ascontiguousarray(forces, dtype=float),
            shares,
            displacement,
            energies,
        )
        return displacement, energies


@njit
def watch_all(image):
    body = view(image)
    for i in range(body.watched.size):
        elastic_surface.watch(body, i, i)


@njit
def run(image, points, forces, shares, displacement, energies):
    body = view(image)
    for k in range(forces.shape[0]):
        elastic_surface.predict(body)
        elastic_surface.begin_load(body)
        for j in range(points.size):
            f = forces[k, j]
            if f[0] != 0.0 or f[1] != 0.0 or f[2] != 0.0:
                elastic_surface.add_load(body, j % 2, points[j], f[0], f[1], f[2])
        elastic_surface.finish_load(body)
        elastic_surface.commit(body, shares[k])
        energies[k, 0] = body.group_work.sum()
        energies[k, 1] = body.energy[0]
        elastic_surface.predict(body)
        for i in range(body.watched.size):
            elastic_surface.place(body, i)
            displacement[k, i] = body.displacement[i]


def compliance(model: SurfaceModel, s: complex) -> NDArray[np.complex128]:
    """(3 n_points, 3 n_points), m/N, of the model, continuous in time."""
    h = 1 + np.sum(model.gamma * s * model.tau_s / (1 + s * model.tau_s))
    shapes = model.shapes.reshape(-1, model.n_modes).astype(float)
    return (shapes / (s**2 + model.squared_frequencies * h)) @ shapes.T + model.residual / h


def pulse_of(force: Floats, n: int) -> Floats:
    forces = np.zeros((n, 1, 3))
    forces[0, 0] = force
    return forces


def test_the_response_is_the_models_at_all_frequencies_of_touch(model: SurfaceModel) -> None:
    """A pulse of one tick; the rules' own error grows with (omega T)² and T / tau_j."""
    pulse, n, point = np.array([0.1, -0.2, 0.3]), 12_000, 4
    response = Watched(model).run([0], pulse_of(pulse, n))[0][:, point]
    assert np.abs(response[-1]).max() < 1e-6 * np.abs(response).max()
    for hz, allowed in ((1.0, 0.004), (5.0, 0.02), (20.0, 0.08)):
        s = 2j * np.pi * hz
        hold = (1 - np.exp(-s * model.period_s)) / s
        # the value at the end of a tick stands for the tick
        found = np.sum(response * np.exp(-s * model.period_s * np.arange(1, n + 1))[:, None], axis=0)
        expected = compliance(model, s)[3 * point : 3 * point + 3, :3] @ pulse * hold / model.period_s
        assert np.linalg.norm(found - expected) < allowed * np.linalg.norm(expected), hz


def test_the_error_of_the_step_is_halved_with_the_period(model: SurfaceModel) -> None:
    errors = []
    s, pulse = 2j * np.pi * 5.0, np.array([0.0, 0.0, 1.0])
    for period in (2e-3, 1e-3, 5e-4):
        n = round(12 / period)
        response = Watched(replace(model, period_s=period)).run([0], pulse_of(pulse / period, n))[0][:, 0]
        found = np.sum(response * np.exp(-s * period * (np.arange(n) + 0.5))[:, None], axis=0) * period
        expected = compliance(model, s)[:3, :3] @ pulse
        errors.append(np.linalg.norm(found - expected) / np.linalg.norm(expected))
    assert errors[0] / errors[1] > 1.8
    assert errors[1] / errors[2] > 1.8


def test_a_force_that_stays_gives_the_static_compliance(model: SurfaceModel) -> None:
    force = np.array([0.1, 0.2, -0.3])
    found = Watched(model).run([4], np.tile(force, (12_000, 1, 1)))[0][-1].ravel()
    expected = compliance(model, 0.0).real[:, 12:15] @ force
    np.testing.assert_allclose(found, expected, rtol=0, atol=2e-6 * np.abs(expected).max())  # float32


def random_forces(n: int, seed: int) -> Floats:
    random = np.random.default_rng(seed)
    return random.normal(size=(n, len(POINTS), 3)) * np.sin(np.arange(n) / 30)[:, None, None]


def test_energy_balances_to_rounding_whatever_the_forces(model: SurfaceModel) -> None:
    watched, forces = Watched(model), random_forces(3000, 5)
    forces[2000:] = 0.0
    shares = np.where(np.arange(3000) % 5 == 0, 0.6, 1.0)
    displacement, energies = watched.run(POINTS, forces, shares)
    moved = np.diff(displacement, axis=0, prepend=0.0)[:, POINTS, :]
    work, stored = energies.T
    expected = shares * np.sum(forces * moved, axis=(1, 2))
    np.testing.assert_allclose(
        work, expected, rtol=0, atol=1e-5 * np.abs(work).max()
    )  # places are in float32
    dissipated = work - np.diff(stored, prepend=0.0)
    assert dissipated.min() >= -1e-15
    assert work.sum() > 0.1
    body = watched.body
    assert stored[-1] + dissipated.sum() == pytest.approx(work.sum(), rel=1e-13)
    assert body.energy[WORK] == pytest.approx(work.sum(), rel=1e-13)
    assert body.energy[STORED] == pytest.approx(dense_energy(body), rel=1e-9)


def dense_energy(body: ElasticSurface) -> float:
    """J, stored in springs and masses, by their definition."""
    residual = body.residual.astype(float)
    energy = (np.sum(body.v**2) + np.sum(body.squared * body.q**2) + body.y[0] @ residual @ body.y[0]) / 2
    for gamma, z, y in zip(body.gamma, body.z, body.y[1:], strict=True):
        energy += gamma / 2 * (np.sum(body.squared * z**2) + y @ residual @ y)
    return float(energy)


def test_what_is_followed_at_watched_points_is_the_dense_product(model: SurfaceModel) -> None:
    watched = Watched(model)
    watched.run(POINTS, random_forces(500, 6), 0.9)
    body = watched.body
    fields = (body.y @ body.residual.astype(float)).reshape(len(body.y), -1, 3)
    np.testing.assert_allclose(body.images, fields, rtol=0, atol=1e-12 * np.abs(fields).max())
    gram = body.y @ body.residual.astype(float) @ body.y.T
    np.testing.assert_allclose(body.gram, gram, rtol=0, atol=1e-11 * np.abs(gram).max())
    watch_all(watched.image)  # begins again, from the fields
    np.testing.assert_allclose(body.images, fields, rtol=0, atol=1e-12 * np.abs(fields).max())


def test_the_step_of_a_place_is_what_happens_if_the_force_stays(model: SurfaceModel) -> None:
    watched, force = Watched(model), np.array([0.3, 0.1, -0.2])
    before = watched.run([4], np.tile(force, (50, 1, 1)))[0][-1]
    expected = watched.body.step.copy()
    after = watched.run([4], np.tile(force, (1, 1, 1)))[0][-1]
    np.testing.assert_allclose(after - before, expected, rtol=0, atol=1e-6 * np.abs(before).max())


def test_the_compliance_of_one_tick_is_what_a_force_does_in_it(model: SurfaceModel) -> None:
    watched = Watched(model)
    found = watched.run([4], np.array([[[0.0, 0.0, 1.0]]]))[0][0].ravel()
    expected = watched.body.compliance[:, 14]
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-6 * np.abs(expected).max())


def test_a_mode_above_half_the_sampling_rate_is_refused(model: SurfaceModel) -> None:
    squared = model.squared_frequencies.copy()
    squared[-1] = (2 * np.pi * 501.0) ** 2
    with pytest.raises(ValueError, match=r"squared_frequencies: a mode of 501 Hz is not below half the"):
        elastic_surface.make_body(replace(model, squared_frequencies=squared), 1, 1)
