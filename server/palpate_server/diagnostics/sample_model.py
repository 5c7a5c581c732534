"""A body of a few damped masses on springs: what host checks, tests and benchmarks run when there is no organ at hand."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.model_file import AccuracyReport, Contact, PoleResidueSystem, ReducedModel, StateSpace, Surface


def spring_mass_model(n_contacts: int = 1, n_modes: int = 4, period_s: float = 1e-3) -> ReducedModel:
    """Passive (sampled as well), quick to make, and with a known response.

    F(s) = K u - sum_k p_k p_k^T / (s² + 2 zeta w_k s + w_k²) u with K > sum_k p_k p_k^T / w_k², discretized with
    first-order hold.
    """
    random = np.random.default_rng(n_contacts + 100 * n_modes)
    channels = 3 * n_contacts
    frequencies = 2 * np.pi * np.linspace(2.0, 60.0, n_modes)
    damping = 0.2
    coupling = random.normal(size=(n_modes, channels)) * frequencies[:, None] * 3.0
    static_loss = sum((np.outer(p, p) / w**2 for p, w in zip(coupling, frequencies, strict=True)))
    stiffness = 50.0 * np.eye(channels) + static_loss

    order = 2 * n_modes
    parts: dict[str, dict[str, NDArray[np.float64]]] = {}
    for kind in ("continuous", "discrete"):
        parts[kind] = {
            "diagonal": np.zeros(order),
            "cross": np.zeros(order),
            "b": np.zeros((order, channels)),
            "c": np.zeros((channels, order)),
            "d": stiffness.copy(),
        }
    for k, (p, w) in enumerate(zip(coupling, frequencies, strict=True)):
        real, imaginary = -damping * w, w * np.sqrt(1 - damping**2)
        a = np.array([[real, imaginary], [-imaginary, real]])
        # In this basis 1 / ((s - real)² + imaginary²) is [1, 0] (sI - A)^-1 [0, 1/imaginary].
        b = np.vstack([np.zeros(channels), p / imaginary])
        c = np.column_stack([-p, np.zeros(channels)])
        # The block acts as the complex number real + j imaginary, and so do its functions in the first-order hold.
        z = complex(real, imaginary) * period_s
        decay, ramp = np.exp(z), period_s * (np.expm1(z) - z) / z**2
        held = period_s * np.expm1(z) / z - ramp + decay * ramp
        ad, weight, newest = (np.array([[f.real, f.imag], [-f.imag, f.real]]) for f in (decay, held, ramp))
        rows = slice(2 * k, 2 * k + 2)
        for kind, block, inputs, outputs in (("continuous", a, b, c), ("discrete", ad, weight @ b, c)):
            part = parts[kind]
            part["diagonal"][rows] = np.diag(block)
            part["cross"][rows] = block[[0, 1], [1, 0]]
            part["b"][rows] = inputs
            part["c"][:, rows] = outputs
        parts["discrete"]["d"] += c @ newest @ b

    # 1 / ((s - pole)(s - conj pole)) in partial fractions
    poles = -damping * frequencies + 1j * frequencies * np.sqrt(1 - damping**2)
    contacts = tuple(
        Contact(f"tip{i}" if i else "tip", (0.01 * i, 0.0, 0.0), (0.0, 0.0, 1.0), 0.005, 7)
        for i in range(n_contacts)
    )
    vertices = np.array([[0.0, 0.0, 0.0], [0.01, 0.0, 0.0], [0.0, 0.01, 0.0], [0.0, 0.0, -0.01]])
    surface = Surface(
        vertices=vertices,
        triangles=np.array([[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]], np.int32),
        output=random.normal(size=(12, order)).astype(np.float32),
        feedthrough=random.normal(size=(12, channels)).astype(np.float32),
    )
    # Nothing was reduced: every error is zero, whatever errors a model file comes to state.
    nothing: dict[str, Any] = {field.name: 0.0 for field in fields(AccuracyReport)}
    abscissa = float(-damping * frequencies.min())
    accuracy = AccuracyReport(
        **nothing
        | {
            "error_bound": None,
            "spectral_abscissa": abscissa,
            "spectral_abscissa_full": abscissa,
            "passive_up_to_hz": 0.5 / period_s,
            "resolved_frequency_hz": 100.0,
            "band_hz": (0.0, 30.0),
            "hankel_singular_values": np.zeros(0),
        }
    )
    return ReducedModel(
        name="masses on springs",
        method="exact",
        period_s=period_s,
        n_nodes=n_modes,
        n_states_full=order,
        contacts=contacts,
        continuous=StateSpace(**parts["continuous"]),
        discrete=StateSpace(**parts["discrete"]),
        full=PoleResidueSystem(
            poles=poles,
            b=coupling / (2j * poles.imag)[:, None],
            c=-coupling.T.astype(np.complex128),
            d=stiffness,
        ),
        static_stiffness=stiffness - static_loss,
        surface=surface,
        accuracy=accuracy,
        config="",
        config_sha256="",
        built_with="palpate_server.diagnostics.sample_model",
    )
