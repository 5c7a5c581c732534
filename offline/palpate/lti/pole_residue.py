"""A real linear time-invariant system in pole-residue form: its frequency response and its exact response in time.

Continuous or discrete: of a discrete system the poles are those of z, and `transfer` is evaluated at z = e^{j omega T}.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

_CHUNK = 1 << 22
"""Complex numbers in the largest temporary array of a response, about 64 MiB."""


@dataclass(frozen=True)
class PoleResidueSystem:
    """F(s) = D + sum_k c_k b_k^T / (s - p_k), a pole off the real axis counting with its conjugate.

    poles  (n_poles,), complex, 1/s, Im >= 0: one with Im > 0 stands for itself and its complex conjugate
    b      (n_poles, n_inputs), complex; of a real pole the product c_k b_k^T is real
    c      (n_outputs, n_poles), complex
    d      (n_outputs, n_inputs), real
    group  (n_poles,), integers, ascending: poles of one group belong to one elastic mode; None: each pole its own
    """

    poles: Complex
    b: Complex
    c: Complex
    d: Array
    group: NDArray[np.int64] | None = None

    @property
    def n_inputs(self) -> int:
        return self.d.shape[1]

    @property
    def n_outputs(self) -> int:
        return self.d.shape[0]

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

    @property
    def residues(self) -> Complex:
        """(n_poles, n_outputs, n_inputs): c_k b_k^T, real for real poles."""
        products: Complex = np.einsum("pk,km->kpm", self.c, self.b)
        products.imag[~self.is_pair] = 0.0
        return products

    def transfer(self, s: NDArray[np.complexfloating[Any, Any]]) -> Complex:
        """(n_points, n_outputs, n_inputs): F at the points s (n_points,), 1/s, none of them a pole."""
        residues = self.residues.reshape(len(self.poles), self.n_outputs * self.n_inputs)
        paired = self.is_pair
        out = np.zeros((len(s), residues.shape[1]), dtype=np.complex128)
        for part in _chunks(len(s), len(self.poles)):
            points = np.asarray(s[part], dtype=np.complex128)[:, None]
            out[part] = (1 / (points - self.poles)) @ residues
            out[part] += (1 / (points - self.poles[paired].conj())) @ residues[paired].conj()
        return self.d + out.reshape(len(s), self.n_outputs, self.n_inputs)

    def static_gain(self) -> Array:
        """(n_outputs, n_inputs): F(0)."""
        return self.transfer(np.zeros(1, dtype=np.complex128))[0].real

    def step_response(self, times_s: Array) -> Array:
        """(n_times, n_outputs, n_inputs): exact response, t >= 0, of a system at rest to unit steps at t = 0."""
        residues = (self._weights / self.poles)[:, None] * self.residues.reshape(
            len(self.poles), self.n_outputs * self.n_inputs
        )
        out = np.zeros((len(times_s), residues.shape[1]))
        for part in _chunks(len(times_s), len(self.poles)):
            out[part] = (np.expm1(times_s[part, None] * self.poles) @ residues).real
        return self.d + out.reshape(len(times_s), self.n_outputs, self.n_inputs)

    def response(self, inputs: Array, period_s: float) -> Array:
        """(n_samples, n_outputs): exact response to the piecewise linear input through the samples.

        inputs  (n_samples, n_inputs), period_s apart. The system is at rest one period before the first sample,
                and the input rises linearly from zero to it.
        """
        decay, old, new = first_order_hold(self.poles * period_s)
        before = np.vstack([np.zeros((1, self.n_inputs)), inputs[:-1]])
        b_old, b_new = ((period_s * w)[:, None] * self.b for w in (old, new))
        state = np.zeros(len(self.poles), dtype=np.complex128)
        out = inputs @ self.d.T
        for part in _chunks(len(inputs), len(self.poles)):
            states = before[part] @ b_old.T + inputs[part] @ b_new.T
            for row in states:
                state *= decay
                state += row
                row[:] = state
            out[part] += (states @ (self._weights * self.c).T).real
        return out

    def take(self, chosen: NDArray[np.intp] | NDArray[np.bool_]) -> PoleResidueSystem:
        """The system with the chosen poles only, D unchanged."""
        group = None if self.group is None else self.group[chosen]
        return PoleResidueSystem(self.poles[chosen], self.b[chosen], self.c[:, chosen], self.d, group)

    @property
    def _weights(self) -> Array:
        """(n_poles,): how often the real part of a pole's contribution counts."""
        return np.where(self.is_pair, 2.0, 1.0)


def phases(rows: Complex) -> Complex:
    """(n,): the phase factor of the entry of largest modulus in each of the rows (n, k); 1 for a row of zeros."""
    if not rows.shape[1]:
        return np.ones(len(rows), dtype=np.complex128)
    largest = np.take_along_axis(rows, np.argmax(np.abs(rows), axis=1, keepdims=True), axis=1)[:, 0]
    return np.where(largest != 0, largest / np.where(largest != 0, np.abs(largest), 1), 1)


def _chunks(n: int, width: int) -> list[slice]:
    """Slices that cover 0..n, each of at most `_CHUNK` entries when an entry of n has `width` of them."""
    step = max(1, _CHUNK // max(1, width))
    return [slice(i, min(i + step, n)) for i in range(0, n, step)]


def first_order_hold(z: Complex) -> tuple[Complex, Complex, Complex]:
    """(e^z, phi_1 - phi_2, phi_2) for z = p T, each (n,): weights of the old state, old and new input.

    x(T) = e^z x(0) + T ((phi_1 - phi_2) u(0) + phi_2 u(T)) solves dx/dt = p x + u exactly for linear u, with
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
