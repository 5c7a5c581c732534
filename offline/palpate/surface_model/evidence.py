"""How large the errors of a surface model are, and that it can't give out energy.

With forces f at the points, the model's displacement is u = sum_k phi_k (phi_k . f) / (s² + omega_k² h) + R f / h, phi_k being
modes and Ritz modes. What the residual R leaves out is the inertia of all else (MacNeal 1971; Rubin 1975).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from palpate.scene.material import PronySeries
from palpate.surface_model.footprint import on_components

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

_BAND_POINTS = 24
_PASSIVITY_POINTS = 60
_LOWEST_HZ = 1e-3


@dataclass(frozen=True)
class Footprints:
    """The compliance that the smallest tool meets around each point, in the coordinates of the model.

    shapes               (n_points, 3, n_modes), of the modes, averaged over the footprint, kg^-1/2
    residual             (n_points, 3, 3), m/N
    squared_frequencies  (n_modes,), (rad/s)²
    """

    shapes: Array
    residual: Array
    squared_frequencies: Array

    def of(self, points: NDArray[np.intp]) -> Footprints:
        """Those around some of the points."""
        return Footprints(self.shapes[points], self.residual[points], self.squared_frequencies)

    def with_modes(self, squared_frequencies: Array, shapes: Array) -> Footprints:
        """With other modes (n,), shapes (n_points, 3, n), and the same static compliance."""
        modal = (shapes / squared_frequencies) @ shapes.transpose(0, 2, 1)
        return Footprints(shapes, self.static() - modal, squared_frequencies)

    def compliance(self, factors: Complex, residual_factor: complex) -> Complex:
        """(n_points, 3, 3): with a factor (n_modes,) for each mode and one for the residual."""
        modal = (self.shapes * factors) @ self.shapes.transpose(0, 2, 1)
        return modal + residual_factor * self.residual

    def static(self) -> Array:
        """(n_points, 3, 3), m/N, at 0 Hz."""
        return (self.shapes / self.squared_frequencies) @ self.shapes.transpose(0, 2, 1) + self.residual


def averaged(
    shapes: NDArray[np.floating],
    residual: NDArray[np.floating],
    squared_frequencies: Array,
    footprints: csr_array,
) -> Footprints:
    """The stored shapes (n_points, 3, n_modes) and residual (3 n_points, 3 n_points) averaged over the footprints."""
    spread, n = on_components(footprints), len(shapes)
    blocks = np.empty((n, 3, 3))
    for start in range(0, n, 64):
        part = spread[3 * start : 3 * (start + 64)]
        rows = np.asarray(part @ residual, np.float64)
        square = np.asarray(part @ rows.T).T
        for k in range(len(rows) // 3):
            blocks[start + k] = square[3 * k : 3 * k + 3, 3 * k : 3 * k + 3]
    modal = np.asarray(spread @ shapes.reshape(3 * n, -1), np.float64).reshape(n, 3, -1)
    return Footprints(modal, (blocks + blocks.transpose(0, 2, 1)) / 2, squared_frequencies)


def force_errors(footprints: Footprints, exact: Complex, prony: PronySeries, frequencies_hz: Array) -> Array:
    """(n_points,): |force error| / |force| of a tool that moves in the worst direction, largest over the frequencies.

    exact  (n_frequencies, n_points, 3, 3), m/N, compliance of the footprints in the assembled body
    """
    largest = np.zeros(len(footprints.shapes))
    for frequency, wanted in zip(frequencies_hz, exact, strict=True):
        s = 2j * np.pi * frequency
        h = complex(prony.transfer_factor(np.array([s]))[0])
        model = footprints.compliance(1 / (s**2 + footprints.squared_frequencies * h), 1 / h)
        largest = np.maximum(largest, np.linalg.norm(np.linalg.solve(model, wanted - model), 2, axis=(1, 2)))
    return largest


def band_frequencies(band_hz: tuple[float, float]) -> Array:
    """Hz, across the band."""
    return np.linspace(band_hz[0], band_hz[1], _BAND_POINTS)


def static_errors(footprints: Footprints, exact: Array) -> Array:
    """(n_points,): the same error at 0 Hz, against the compliance (n_points, 3, 3) of static solutions."""
    model = footprints.static()
    return np.linalg.norm(np.linalg.solve(model, exact - model), 2, axis=(1, 2))


def passivity_margin(footprints: Footprints, prony: PronySeries, period_s: float) -> float:
    """Smallest eigenvalue of the part of w C(jw) that dissipates, over |w C(0)|, up to half the sampling rate."""
    mu, worst, static = footprints.squared_frequencies, np.inf, footprints.static()
    for frequency in np.geomspace(_LOWEST_HZ, 0.5 / period_s, _PASSIVITY_POINTS):
        s = 2j * np.pi * frequency
        h = complex(prony.transfer_factor(np.array([s]))[0])
        worst = min(worst, _least(footprints.compliance(1 / (s**2 + mu * h), 1 / h) * 1j, static))
    return worst


def passivity_margin_sampled(footprints: Footprints, prony: PronySeries, period_s: float) -> float:
    """The same for the displacement during a tick under a force held over it, in the sampled model.

    Modes by the implicit midpoint rule with their frequency prewarped, which is the continuous mode at
    s = j 2/T tan(w T/2); the residual by the backward Euler rule, s = (1 - 1/z)/T.
    """
    effective, shapes = prewarped(footprints.squared_frequencies, footprints.shapes, period_s)
    warped = Footprints(shapes, footprints.residual, effective)
    static = warped.static()
    worst = np.inf
    for frequency in np.geomspace(_LOWEST_HZ, 0.499 / period_s, _PASSIVITY_POINTS):
        angle = 2 * np.pi * frequency * period_s
        midpoint = 2j / period_s * np.tan(angle / 2)
        euler = (1 - np.exp(-1j * angle)) / period_s
        h = complex(prony.transfer_factor(np.array([midpoint]))[0])
        h_euler = complex(prony.transfer_factor(np.array([euler]))[0])
        rate = warped.compliance(midpoint / (midpoint**2 + effective * h), euler / h_euler)
        worst = min(worst, _least(rate / abs(midpoint), static))
    return worst


def prewarped(squared_frequencies: Array, shapes: Array, period_s: float) -> tuple[Array, Array]:
    """Squared frequencies and shapes with which the midpoint rule has the modes' own resonances and static compliance.

    Raises ValueError where a mode lies beyond half the sampling rate.
    """
    omega = np.sqrt(squared_frequencies)
    if omega[-1] * period_s >= np.pi:
        raise ValueError(
            f"surface.modes reach {omega[-1] / (2 * np.pi):.4g} Hz: expected modes below half the sampling rate, "
            f"{0.5 / period_s:g} Hz"
        )
    effective = 2 / period_s * np.tan(omega * period_s / 2)
    return effective**2, shapes * (effective / omega)


def largest_stiffness(footprints: Footprints, normals: Array, prony: PronySeries, period_s: float) -> float:
    """N/m: the largest over the points (normals (n_points, 3)) of the force along the normal over the displacement in the tick."""
    effective, shapes = prewarped(footprints.squared_frequencies, footprints.shapes, period_s)
    gamma, tau = np.array(prony.gamma), np.array(prony.tau_s)
    stiffening = 1 + np.sum(gamma / (1 + period_s / (2 * tau)))
    gain = 1 / (2 / period_s**2 + effective / 2 * stiffening)
    instant = 1 / (1 + np.sum(gamma / (1 + period_s / tau)))
    along = np.einsum("pik,pi->pk", shapes, normals)
    compliance = along**2 @ gain + instant * np.einsum("pi,pij,pj->p", normals, footprints.residual, normals)
    return float(1 / compliance.min())


def _least(rate: Complex, static: Array) -> float:
    """Smallest eigenvalue of the Hermitian part of rates (n, 3, 3) over the norm of the static compliance at the point."""
    hermitian = (rate + rate.conj().transpose(0, 2, 1)) / 2
    return float(np.min(np.linalg.eigvalsh(hermitian)[:, 0] / np.linalg.norm(static, 2, axis=(1, 2))))
