"""A real linear time-invariant system in diagonal (pole-residue) form: its frequency and exact time response."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from palpate.model_file import PoleResidueSystem

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]


@dataclass(frozen=True)
class DiagonalSystem:
    """F(s) = D + sum_k c_k b_k^T / (s - lambda_k), a pole off the real axis counting with its conjugate.

    poles  (n_poles,), complex, 1/s, Im >= 0: one with Im > 0 stands for itself and its complex conjugate
    b      (n_poles, n_inputs), complex; of a real pole the product c_k b_k^T is real
    c      (n_outputs, n_poles), complex
    d      (n_outputs, n_inputs), real
    group  (n_poles,), integers, ascending: poles of one group belong together and are truncated together
    """

    poles: Complex
    b: Complex
    c: Complex
    d: Array
    group: NDArray[np.int64]

    @property
    def n_inputs(self) -> int:
        return self.b.shape[1]

    @property
    def n_outputs(self) -> int:
        return self.c.shape[0]

    @property
    def is_pair(self) -> NDArray[np.bool_]:
        """(n_poles,), true where the pole stands for a complex conjugate pair."""
        return self.poles.imag > 0

    @property
    def n_states(self) -> int:
        """Number of real states: 1 for a real pole, 2 for a pair."""
        return len(self.poles) + int(np.count_nonzero(self.is_pair))

    @property
    def is_symmetric(self) -> bool:
        """Whether C = B^T (complex symmetric), so that the observability Gramian is the conjugate of the other."""
        return np.array_equal(self.c, self.b.T)

    @property
    def spectral_abscissa(self) -> float:
        """Largest real part of the poles, 1/s; minus infinity without poles."""
        return float(np.max(self.poles.real, initial=-np.inf))

    def transfer(self, s: NDArray[np.complexfloating[Any, Any]]) -> Complex:
        """(n_points, n_outputs, n_inputs): F at the points s (n_points,), 1/s, none of them a pole."""
        residues = self._residues()
        values = _sum_partial_fractions(
            np.ascontiguousarray(s, dtype=np.complex128),
            np.ascontiguousarray(self.poles),
            np.ascontiguousarray(residues.real),
            np.ascontiguousarray(residues.imag),
        )
        return self.d + values.reshape(len(s), self.n_outputs, self.n_inputs)

    def static_gain(self) -> Array:
        """(n_outputs, n_inputs): F(0)."""
        return self.transfer(np.zeros(1, dtype=np.complex128))[0].real

    def step_response(self, times_s: Array) -> Array:
        """(n_times, n_outputs, n_inputs): exact response, t >= 0, of a system at rest to unit steps at t = 0."""
        residues = np.where(self.is_pair, 2.0, 1.0)[:, None] * self._residues()
        response = np.empty((len(times_s), residues.shape[1]))
        for i, t in enumerate(times_s):
            response[i] = np.real((np.expm1(self.poles * t) / self.poles) @ residues)
        return self.d + response.reshape(len(times_s), self.n_outputs, self.n_inputs)

    def response(self, inputs: Array, period_s: float) -> Array:
        """(n_samples, n_outputs): exact response to the piecewise linear input through the samples.

        inputs  (n_samples, n_inputs), period_s apart. The system is at rest one period before the first sample,
                and the input rises linearly from zero to it.
        """
        decay, old, new = first_order_hold(self.poles * period_s)
        weight = np.where(self.is_pair, 2.0, 1.0)
        forced = _propagate(
            np.ascontiguousarray(inputs, dtype=np.float64),
            decay,
            np.ascontiguousarray((period_s * old)[:, None] * self.b),
            np.ascontiguousarray((period_s * new)[:, None] * self.b),
            np.ascontiguousarray((weight * self.c).T),
        )
        return forced + inputs @ self.d.T

    def take(self, chosen: NDArray[np.intp] | NDArray[np.bool_]) -> DiagonalSystem:
        """The system with the chosen poles only, D unchanged."""
        return DiagonalSystem(
            self.poles[chosen], self.b[chosen], self.c[:, chosen], self.d, self.group[chosen]
        )

    def _residues(self) -> Complex:
        """(n_poles, n_outputs n_inputs): c_k b_k^T, real for real poles."""
        products = np.einsum("pk,km->kpm", self.c, self.b)
        residues = products.reshape(len(self.poles), self.n_outputs * self.n_inputs)
        residues.imag[~self.is_pair] = 0.0
        return residues


def full_system(full: PoleResidueSystem) -> DiagonalSystem:
    """The unreduced system that a model file keeps."""
    return DiagonalSystem(full.poles, full.b, full.c, full.d, np.arange(len(full.poles)))


def first_order_hold(
    z: Complex,
) -> tuple[Complex, Complex, Complex]:
    """(e^z, phi_1 - phi_2, phi_2) for z = lambda T, each (n,): weights of the old state, old and new input.

    x(T) = e^z x(0) + T ((phi_1 - phi_2) u(0) + phi_2 u(T)) solves dx/dt = lambda x + u exactly for linear u, with
    phi_1 = (e^z - 1) / z and phi_2 = (e^z - 1 - z) / z². Near z = 0, where these cancel, by their Taylor series.
    """
    decay: Complex = np.exp(z)
    near = np.abs(z) < 0.5
    safe = np.where(near, 1.0, z)
    phi_1: Complex = (decay - 1.0) / safe
    phi_2: Complex = (phi_1 - 1.0) / safe
    small = np.where(near, z, 0.0)
    series: Complex = np.zeros_like(z)
    for k in range(16, -1, -1):  # phi_2 = sum_k z^k / (k + 2)!, by Horner: 1/2 (1 + z/3 (1 + z/4 (1 + ...)))
        series = (1.0 + small * series) / (k + 2)
    phi_2 = np.where(near, series, phi_2)
    phi_1 = np.where(near, 1.0 + small * series, phi_1)
    return decay, phi_1 - phi_2, phi_2


@njit(parallel=True, cache=True)
def _sum_partial_fractions(s, poles, real, imag):  # type: ignore[no-untyped-def]
    """(n_points, n_channels): sum of R/(s - lambda), for pairs plus conj(R)/(s - conj(lambda)), R = real + j imag."""
    n_channels = real.shape[1]
    out = np.zeros((s.shape[0], n_channels), dtype=np.complex128)
    for i in prange(s.shape[0]):
        total = np.zeros(2 * n_channels)
        for k in range(poles.shape[0]):
            direct = 1.0 / (s[i] - poles[k])
            if poles[k].imag > 0:
                mirror = 1.0 / (s[i] - np.conj(poles[k]))
                even = direct + mirror
                odd = 1j * (direct - mirror)
                for q in range(n_channels):
                    total[2 * q] += real[k, q] * even.real + imag[k, q] * odd.real
                    total[2 * q + 1] += real[k, q] * even.imag + imag[k, q] * odd.imag
            else:
                for q in range(n_channels):
                    total[2 * q] += real[k, q] * direct.real
                    total[2 * q + 1] += real[k, q] * direct.imag
        for q in range(n_channels):
            out[i, q] = complex(total[2 * q], total[2 * q + 1])
    return out


@njit(parallel=True, cache=True)
def _propagate(inputs, decay, b_old, b_new, c):  # type: ignore[no-untyped-def]
    """(n_samples, n_outputs): sum over the poles of Re(c x), x+ = decay x + b_old u + b_new u+."""
    n_samples, n_inputs = inputs.shape
    n_poles, n_outputs = c.shape
    n_chunks = 16
    partial = np.zeros((n_chunks, n_samples, n_outputs))
    for chunk in prange(n_chunks):
        for k in range(chunk, n_poles, n_chunks):
            x = 0j
            for t in range(n_samples):
                x = decay[k] * x
                for m in range(n_inputs):
                    x += b_new[k, m] * inputs[t, m]
                    if t > 0:
                        x += b_old[k, m] * inputs[t - 1, m]
                for p in range(n_outputs):
                    partial[chunk, t, p] += c[k, p].real * x.real - c[k, p].imag * x.imag
    out = np.zeros((n_samples, n_outputs))
    for chunk in range(n_chunks):
        out += partial[chunk]
    return out
