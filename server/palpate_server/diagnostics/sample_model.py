"""A model of a few damped masses on springs, for host checks, tests and benchmarks."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.model_file import AccuracyReport, Contact, PoleResidueSystem, ReducedModel, StateSpace, Surface
from palpate_server.coupling import fixed_patch
from palpate_server.coupling.running import Running, of_patch

Floats = NDArray[np.float64]

_DAMPING = 0.2  # ratio, of every mode


def spring_mass_model(n_contacts: int = 1, n_modes: int = 4, period_s: float = 1e-3) -> ReducedModel:
    """A passive model (also when sampled) with a known response, made in milliseconds:

    F(s) = K - sum_k p_k p_k^T / (s² + 2 zeta w_k s + w_k²) with K > sum_k p_k p_k^T / w_k², sampled with first-order hold.
    """
    random = np.random.default_rng(n_contacts + 100 * n_modes)
    channels, order = 3 * n_contacts, 2 * n_modes
    frequencies = 2 * np.pi * np.linspace(2.0, 60.0, n_modes)
    participation = random.normal(size=(n_modes, channels)) * frequencies[:, None] * 3.0
    static_loss = sum(np.outer(p, p) / w**2 for p, w in zip(participation, frequencies, strict=True))
    stiffness = 50.0 * np.eye(channels) + static_loss
    continuous, discrete = _state_spaces(frequencies, participation, stiffness, period_s)
    # 1 / ((s - pole)(s - conj pole)) in partial fractions
    poles = -_DAMPING * frequencies + 1j * frequencies * np.sqrt(1 - _DAMPING**2)
    return ReducedModel(
        name="masses on springs",
        method="exact",
        period_s=period_s,
        n_nodes=n_modes,
        n_states_full=order,
        contacts=tuple(
            Contact(f"tip{i}" if i else "tip", (0.01 * i, 0.0, 0.0), (0.0, 0.0, 1.0), 0.005, 7)
            for i in range(n_contacts)
        ),
        continuous=continuous,
        discrete=discrete,
        full=PoleResidueSystem(
            poles=poles,
            b=participation / (2j * poles.imag)[:, None],
            c=-participation.T.astype(np.complex128),
            d=stiffness,
        ),
        static_stiffness=stiffness - static_loss,
        surface=Surface(
            vertices=np.array([[0.0, 0.0, 0.0], [0.01, 0.0, 0.0], [0.0, 0.01, 0.0], [0.0, 0.0, -0.01]]),
            triangles=np.array([[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]], np.int32),
            output=random.normal(size=(12, order)).astype(np.float32),
            feedthrough=random.normal(size=(12, channels)).astype(np.float32),
        ),
        accuracy=_exact(float(-_DAMPING * frequencies.min()), period_s),
        config="",
        config_sha256="",
        built_with="palpate_server.diagnostics.sample_model",
    )


def patches_of(system: StateSpace, displacement: Floats | None = None) -> Running:
    """A running patch model of these matrices alone, at rest or settled at (n_tools, 3), m; its normals along z."""
    n = len(system.c) // 3
    normals = np.tile([0.0, 0.0, 1.0], (n, 1))
    return of_patch(fixed_patch.make(system, normals, np.ones(n, np.int64), displacement))


def _state_spaces(
    frequencies: Floats, participation: Floats, stiffness: Floats, period_s: float
) -> tuple[StateSpace, StateSpace]:
    """The model in block form, continuous and sampled.

    frequencies (n_modes,), rad/s; participation (n_modes, channels), the p_k; stiffness (channels, channels), K, N/m
    """
    n_modes, channels = participation.shape
    continuous, discrete = (
        StateSpace(
            np.zeros(2 * n_modes),
            np.zeros(2 * n_modes),
            np.zeros((2 * n_modes, channels)),
            np.zeros((channels, 2 * n_modes)),
            stiffness.copy(),
        )
        for _ in range(2)
    )
    for k, (p, w) in enumerate(zip(participation, frequencies, strict=True)):
        pole = complex(-_DAMPING * w, w * np.sqrt(1 - _DAMPING**2))
        # In this basis 1 / ((s - re)² + im²) is [1, 0] (sI - A)^-1 [0, 1/im] with A = [[re, im], [-im, re]].
        b = np.vstack([np.zeros(channels), p / pole.imag])
        c = np.column_stack([-p, np.zeros(channels)])
        # A acts as the complex number `pole`, and its functions in the first-order hold as those of the number.
        z = pole * period_s
        decay, ramp = np.exp(z), period_s * (np.expm1(z) - z) / z**2
        held = period_s * np.expm1(z) / z - ramp + decay * ramp
        rows = slice(2 * k, 2 * k + 2)
        for system, block, inputs in (
            (continuous, _block(pole), b),
            (discrete, _block(decay), _block(held) @ b),
        ):
            system.diagonal[rows] = np.diag(block)
            system.cross[rows] = block[[0, 1], [1, 0]]
            system.b[rows] = inputs
            system.c[:, rows] = c
        discrete.d[:] += c @ _block(ramp) @ b
    return continuous, discrete


def _block(number: complex) -> Floats:
    """(2, 2): the real matrix that acts as a complex number."""
    return np.array([[number.real, number.imag], [-number.imag, number.real]])


def _exact(spectral_abscissa: float, period_s: float) -> AccuracyReport:
    """The report of a model that was not reduced: every error is zero."""
    zeros: dict[str, Any] = {field.name: 0.0 for field in fields(AccuracyReport)}
    return AccuracyReport(
        **zeros
        | {
            "error_bound": None,
            "spectral_abscissa": spectral_abscissa,
            "spectral_abscissa_full": spectral_abscissa,
            "passive_up_to_hz": 0.5 / period_s,
            "resolved_frequency_hz": 100.0,
            "band_hz": (0.0, 30.0),
            "hankel_singular_values": np.zeros(0),
        }
    )
