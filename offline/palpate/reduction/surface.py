"""Surface displacements from the state of the discrete reduced model, whatever method made it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve

from palpate.model_file import StateSpace
from palpate.modes.elastic_modes import ElasticModes
from palpate.scene.material import PronySeries

Array = NDArray[np.float64]

_LEAST_FIT_FREQUENCIES = 64
_PENALTY = 1e-4  # over the norm of the states' responses
_BITS = 12
"""Bits that the read-out of a state keeps below its largest entry; with the 24 of float32 the file takes twice the space."""


@dataclass(frozen=True)
class SurfaceOutput:
    """displacement = output xi + feedthrough u, m, with the state xi before the step and the newest input u.

    output         (3 n_surface, order), float32
    feedthrough    (3 n_surface, n_inputs), float32
    error_in_band  largest over frequencies of the band of |error| / |displacement|, 2-norms, at frequencies that the
                   fit has not seen, of these very float32 matrices
    """

    output: NDArray[np.float32]
    feedthrough: NDArray[np.float32]
    error_in_band: float


def fit_surface_output(
    modes: ElasticModes,
    prony: PronySeries,
    surface_shapes: NDArray[np.float64] | NDArray[np.complex128],
    surface_patch_shapes: Array,
    discrete: StateSpace,
    *,
    period_s: float,
    band_hz: tuple[float, float],
) -> SurfaceOutput:
    """Least squares over the band, relative at each frequency, with the reduced poles fixed and the statics exact.

    surface_shapes        (3 n_surface, n_modes), the displacements of the modes on the surface
    surface_patch_shapes  (3 n_surface, n_inputs), those of the patch displacements
    discrete              the reduced model as it runs at period_s

    The full surface response (surface_patch_shapes - sum_k shapes_k b_k^T h/(s² + mu_k h)) is fitted by
    output (z - A)^-1 B + feedthrough, z = e^{s T}: linear in the unknowns, real and imaginary part at once. A small penalty on
    the read-out (Tikhonov) keeps states apart that are alike in the band.

    Raises ValueError where the shapes do not match the modes.
    """
    expected = (surface_shapes.shape[0], modes.n_modes), (surface_shapes.shape[0], discrete.b.shape[1])
    if (surface_shapes.shape, surface_patch_shapes.shape) != expected:
        raise ValueError(
            f"surface_shapes {surface_shapes.shape} and surface_patch_shapes {surface_patch_shapes.shape}: expected "
            f"{expected[0]} and {expected[1]}"
        )
    # Each gives 2 n_inputs equations for a row's `order` unknowns: three times as many leave none to chance.
    enough = math.ceil(3 * discrete.order / (2 * discrete.b.shape[1]))
    omega = _frequencies(modes, prony, band_hz, max(_LEAST_FIT_FREQUENCIES, enough))
    fitted, held_out = omega[0::2], omega[1::2]
    full = _surface_response(modes, prony, surface_shapes, surface_patch_shapes, fitted)
    states = _state_response(discrete, fitted, period_s)
    static_full = np.real(
        _surface_response(modes, prony, surface_shapes, surface_patch_shapes, np.zeros(1))[0]
    )
    static_states = np.real(_state_response(discrete, np.zeros(1), period_s)[0])

    # feedthrough = static_full - output static_states makes the statics exact; what is left is linear in output.
    weight = 1 / np.linalg.norm(full, axis=(1, 2))[:, None, None]
    target = _side_by_side((full - static_full) * weight)
    basis = _side_by_side((states - static_states) * weight)
    scale = np.linalg.norm(basis, axis=1)
    scale[scale == 0] = 1.0
    basis /= scale[:, None]
    gram = basis @ basis.T
    gram[np.diag_indices_from(gram)] += _PENALTY**2 * len(gram)
    output = _rounded(solve(gram, basis @ target.T, assume_a="pos").T / scale)
    feedthrough = static_full - output @ static_states
    output32, feedthrough32 = output.astype(np.float32), feedthrough.astype(np.float32)

    check = _surface_response(modes, prony, surface_shapes, surface_patch_shapes, held_out)
    shown = _combined(output32.astype(np.float64), _state_response(discrete, held_out, period_s))
    error = float(np.max(_gains(check - shown - feedthrough32) / _gains(check)))
    return SurfaceOutput(output32, feedthrough32, error)


def _rounded(output: Array) -> Array:
    """Rounded to about a ten-thousandth of the largest displacement that the same state makes, so that the file compresses better."""
    _, exponent = np.frexp(np.abs(output).max(axis=0))
    return np.asarray(np.ldexp(np.round(np.ldexp(output, _BITS - exponent)), exponent - _BITS))


def _gains(values: NDArray[np.complex128]) -> Array:
    """(n,): the 2-norm of each of (n, rows, n_inputs)."""
    grams = values.conj().transpose(0, 2, 1) @ values
    return np.asarray(np.sqrt(np.maximum(np.linalg.eigvalsh(grams)[:, -1], 0.0)))


def _frequencies(modes: ElasticModes, prony: PronySeries, band_hz: tuple[float, float], n: int) -> Array:
    """(2 n,), rad/s, ascending: half even, half even in the logarithm, from a slow one to the band's end."""
    low, high = 2 * np.pi * band_hz[0], 2 * np.pi * band_hz[1]
    slowest = min([float(np.sqrt(np.min(np.abs(modes.squared_frequencies)))), *(1 / t for t in prony.tau_s)])
    start = max(low, min(slowest, high) / 10)
    even = start + (high - start) * (np.arange(n) + 0.5) / n
    return np.sort(np.concatenate([np.geomspace(start, high, n), even]))


def _surface_response(
    modes: ElasticModes,
    prony: PronySeries,
    surface_shapes: NDArray[np.float64] | NDArray[np.complex128],
    surface_patch_shapes: Array,
    omega: Array,
) -> NDArray[np.complex128]:
    """(n_frequencies, 3 n_surface, n_inputs): displacement of the full model per unit input."""
    s = np.asarray(1j * omega, dtype=np.complex128)
    h = prony.transfer_factor(s)
    response = -h[:, None] / ((s**2)[:, None] + h[:, None] * modes.squared_frequencies)
    coordinates = response[:, :, None] * modes.input_coupling
    return _combined(surface_shapes, coordinates) + surface_patch_shapes


def _combined(
    shapes: NDArray[np.float64] | NDArray[np.complex128], coordinates: NDArray[np.complex128]
) -> NDArray[np.complex128]:
    """(n_frequencies, rows, n_inputs): shapes (rows, k) times coordinates (n_frequencies, k, n_inputs)."""
    n_frequencies, k, n_inputs = coordinates.shape
    flat = coordinates.transpose(1, 0, 2).reshape(k, -1)
    real = np.isrealobj(shapes)  # half the work
    product = shapes @ flat.real + 1j * (shapes @ flat.imag) if real else shapes @ flat
    return np.asarray(product.reshape(-1, n_frequencies, n_inputs).transpose(1, 0, 2), dtype=np.complex128)


def _state_response(discrete: StateSpace, omega: Array, period_s: float) -> NDArray[np.complex128]:
    """(n_frequencies, order, n_inputs): (z - A)^-1 B at z = e^{j omega T}."""
    z = np.exp(1j * omega * period_s)[:, None]
    even, odd = slice(0, None, 2), slice(1, None, 2)
    a, d = z - discrete.diagonal[even], z - discrete.diagonal[odd]
    b, c = -discrete.cross[even], -discrete.cross[odd]
    determinant = a * d - b * c
    out = np.empty((len(omega), discrete.order, discrete.b.shape[1]), dtype=np.complex128)
    out[:, even] = (d[:, :, None] * discrete.b[even] - b[:, None] * discrete.b[odd]) / determinant[:, :, None]
    out[:, odd] = (a[:, :, None] * discrete.b[odd] - c[:, None] * discrete.b[even]) / determinant[:, :, None]
    return out


def _side_by_side(values: NDArray[np.complex128]) -> Array:
    """(rows, 2 n_frequencies n_inputs): real and imaginary parts of (n_frequencies, rows, n_inputs) as columns."""
    flat = values.transpose(1, 0, 2).reshape(values.shape[1], -1)
    return np.hstack([flat.real, flat.imag])
