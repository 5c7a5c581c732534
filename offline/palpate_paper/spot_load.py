"""A smooth load in the middle of a membrane, and the deflections that follow from it: exact, and of a discrete model.

The paper drives the middle node. A point force on a membrane deflects its own point without limit, so that nothing
converges; spread over a spot of radius a as (1 - (r/a)²)², with the paper's history, it has a series solution.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm
from scipy.special import j0, j1, jn_zeros, jv

from palpate.scene.material import PronySeries

Array = NDArray[np.float64]
Modal = NDArray[Any]  # real of a symmetric model, else complex

LOAD_ENDS_S = 0.2


def spot(distance: Array, radius: float) -> Array:
    """Pressure of a unit force on a spot: 3/(pi a²) (1 - (r/a)²)² for r < a."""
    inside = np.clip(1 - (distance / radius) ** 2, 0, None)
    return 3 / (np.pi * radius**2) * inside**2


def spot_transform(wave_number: Array, radius: float) -> Array:
    """Its Fourier transform 48 J_3(ka) / (ka)³ (Sonine's first integral), 1 at k = 0."""
    beta = wave_number * radius
    return 48 * jv(3, beta) / beta**3


def disc_modes(points: Array, radius: float, count: int = 60) -> tuple[Array, Array, Array]:
    """(mu, shapes, load) of the unit disc's axisymmetric modes: mu = j_0n², shapes J_0(j_0n r) / (sqrt(pi) J_1(j_0n)).

    mu (n,), (rad/s)²; shapes (n_points, n) at the points (n_points, 2); load (n,), the unit force on the spot
    """
    zeros = jn_zeros(0, count)
    norm = np.sqrt(np.pi) * np.abs(j1(zeros))
    r = np.linalg.norm(points, axis=1)
    return zeros**2, j0(np.outer(r, zeros)) / norm, spot_transform(zeros, radius) / norm


def square_modes(points: Array, radius: float, count: int = 40) -> tuple[Array, Array, Array]:
    """The same for the unit square [0, 1]²: 2 sin(m pi x) sin(n pi y), odd m and n up to 2 count - 1."""
    odd = 2 * np.arange(count) + 1
    m, n = (a.ravel() for a in np.meshgrid(odd, odd))
    shapes = 2 * np.sin(np.pi * np.outer(points[:, 0], m)) * np.sin(np.pi * np.outer(points[:, 1], n))
    wave_number = np.pi * np.hypot(m, n)
    middle = 2 * np.sin(np.pi * m / 2) * np.sin(np.pi * n / 2)
    return wave_number**2, shapes, middle * spot_transform(wave_number, radius)


def modal_history(mu: Modal, prony: PronySeries, step_s: float, n_steps: int) -> Modal:
    """(n_steps + 1, n_modes): q of q'' + mu (q + sum gamma_j z_j) = g(t), z_j' = -z_j/tau_j + q', from rest.

    g is the paper's history, t/10 before 0.2 s and 0 after. Exact: one matrix exponential a mode. step_s must
    divide 0.2 s.
    """
    ramp_steps = round(LOAD_ENDS_S / step_s)
    if abs(ramp_steps * step_s - LOAD_ENDS_S) > 1e-9:
        raise ValueError(f"step_s = {step_s}: expected a divisor of {LOAD_ENDS_S} s")
    n_memories = len(prony.gamma)
    size = 4 + n_memories  # q, q', z_1 .. z_M, g, g'
    a = np.zeros((len(mu), size, size), dtype=mu.dtype)
    a[:, 0, 1] = 1
    a[:, 1, 0] = -mu
    for j, (gamma, tau) in enumerate(zip(prony.gamma, prony.tau_s, strict=True)):
        a[:, 1, 2 + j] = -gamma * mu
        a[:, 2 + j, 1] = 1
        a[:, 2 + j, 2 + j] = -1 / tau
    a[:, 1, -2] = 1
    a[:, -2, -1] = 1
    step = expm(a * step_s)
    state = np.zeros((len(mu), size), dtype=mu.dtype)
    state[:, -1] = 0.1
    q = np.zeros((n_steps + 1, len(mu)), dtype=mu.dtype)
    for i in range(n_steps):
        state = np.einsum("kab,kb->ka", step, state)
        q[i + 1] = state[:, 0]
        if i + 1 == ramp_steps:
            state[:, -2:] = 0
    return q


def modal_load(shapes: Modal, free: NDArray[np.int64], pressure_over_density: Array) -> Modal:
    """(n_modes,): the load's share of every mode, for shapes (n_nodes, n_modes) of a discrete model, symmetric or not.

    free  (n_modes,), the nodes that move
    """
    return np.linalg.solve(shapes[free], pressure_over_density[free].astype(shapes.dtype))
