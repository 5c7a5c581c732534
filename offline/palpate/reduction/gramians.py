"""Low-rank factors of the Gramians of a system in pole-residue form, in real coordinates.

Real coordinates: a real pole has one state; a pair has two, sqrt(2) Re x and sqrt(2) Im x of the complex state x of its
upper pole, so that the change of basis is unitary. Its block of A is [[a, -w], [w, a]] for the pole a + jw. States
follow the order of the poles.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from palpate.lti.pole_residue import PoleResidueSystem

Array = NDArray[np.float64]

GRAMIAN_TOLERANCE = 1e-20
"""Trace of what a Gramian factor leaves out, over the Gramian's. It moves a Hankel singular value by about the square root
of this times the largest, 1e-10, at worst."""

BAND_FREQUENCIES = 120
"""Approximate number of points over a band without narrow resonances: 30 panels, each a fraction of an octave."""

_NARROW = 0.01
"""|Re p| / |p| below which the panels of the band are too wide for the resonance of the pole p."""

_MOST_RESONANCES = 60
"""Largest number of narrow resonances that get panels of their own, narrowest first: each costs some tens of points."""


@dataclass(frozen=True)
class RealForm:
    """A system in real coordinates.

    decay, rotation  (n_states,): A x = decay * x + rotation * x[partner]
    partner          (n_states,), the other state of a pair; the state itself for a real pole
    b (n_states, n_inputs), c (n_outputs, n_states), d (n_outputs, n_inputs)
    signature        (n_states,), +-1: diag(signature) A^T diag(signature) = A; for a symmetric system also
                     C = B^T diag(signature)
    """

    decay: Array
    rotation: Array
    partner: NDArray[np.intp]
    b: Array
    c: Array
    d: Array
    signature: Array

    def apply(self, x: Array) -> Array:
        """A x for x (n_states, k)."""
        return self.decay[:, None] * x + self.rotation[:, None] * x[self.partner]


@dataclass(frozen=True)
class Gramians:
    """Factors of the two Gramians, control control^T and observe observe^T, in real coordinates.

    control (n_states, k), observe (n_states, l)
    missing    bound on the sum of the differences between the Hankel singular values and those of the whole Gramians
    symmetric  whether observe is control times signs, so that observe^T control is symmetric
    """

    control: Array
    observe: Array
    missing: float = 0.0
    symmetric: bool = False


@dataclass(frozen=True)
class GramianFactor:
    """A Gramian P = L L^T + R, R symmetric positive semidefinite.

    factor    (n_states, rank), L in real coordinates
    trace     trace of P
    residual  trace of R, so the 2-norm of what L misses is at most this
    """

    factor: Array
    trace: float
    residual: float


def real_form(system: PoleResidueSystem) -> RealForm:
    """The system in real coordinates (exact; see the module's text)."""
    start, is_pair, n = _first_state(system), system.is_pair, system.n_states
    real, pair = start[~is_pair], start[is_pair]
    sizes, second = np.where(is_pair, 2, 1), np.zeros(n, dtype=bool)
    second[pair + 1] = True  # the second state of each pair
    decay = np.repeat(system.poles.real, sizes)
    rotation = np.repeat(system.poles.imag, sizes) * np.where(second, 1.0, -1.0)
    partner = np.arange(n)
    partner[pair], partner[pair + 1] = pair + 1, pair
    signature = np.where(second, -1.0, 1.0)
    # The rows of a real pole are real or imaginary, square roots of a real residue: j times j is the sign.
    rows = system.b[~is_pair]
    signature[real] = np.where(np.sum(rows.imag**2, axis=1) > np.sum(rows.real**2, axis=1), -1.0, 1.0)
    b = _in_real_coordinates(system, system.b)
    c = (_in_real_coordinates(system, system.c.T) * signature[:, None]).T
    return RealForm(decay, rotation, partner, b, c, system.d, signature)


def gramians(system: PoleResidueSystem) -> Gramians:
    """Factors of P, A P + P A^T + B B^T = 0, and of Q, A^T Q + Q A + C^T C = 0.

    In real coordinates A^T = S A S with the signature S, so Q is S times the P of the rows of C^T times S: of a symmetric
    system (C = B^T) one factor gives both. Raises ValueError as `gramian_factor`.
    """
    control = gramian_factor(system, system.b)
    observe = control if system.is_symmetric else gramian_factor(system, system.c.T)
    # The factors of the whole have more blocks, whose nuclear norms are at most the products of Frobenius norms, and singular
    # values differ in sum by no more than that (Mirsky 1960).
    missing = (
        math.sqrt(observe.trace * control.residual)
        + math.sqrt(control.trace * observe.residual)
        + math.sqrt(control.residual * observe.residual)
    )
    signature = real_form(system).signature
    return Gramians(control.factor, signature[:, None] * observe.factor, missing, system.is_symmetric)


def gramian_factor(
    system: PoleResidueSystem, rows: NDArray[np.complex128], tolerance: float = GRAMIAN_TOLERANCE
) -> GramianFactor:
    """Factor of P, A P + P A^T + B B^T = 0, until the trace of the rest is below tolerance times that of P.

    rows  (n_poles, k), complex, the rows of B

    Pivoted Cholesky of the Cauchy-form Gramian P_kl = -b_k b_l^* / (lambda_k + conj(lambda_l)). Its Schur complements
    keep that form, with b multiplied by a Blaschke factor (Gohberg, Kailath, Olshevsky 1995), so a column costs
    O(n_states k) instead of O(n_states rank) and the factor keeps its relative accuracy however small the
    tolerance. It is low-rank ADI with the pivot's pole as shift and its row of b as tangential direction.

    Raises ValueError unless every pole lies in the open left half plane.
    """
    if not system.spectral_abscissa < 0:
        raise ValueError(
            f"the spectral abscissa is {system.spectral_abscissa:.3g} 1/s: Gramians exist for poles in the open left "
            "half plane only"
        )
    is_pair = system.is_pair
    generator = np.where(is_pair[:, None], rows, rows.real + rows.imag)
    generator = np.ascontiguousarray(generator, dtype=np.complex128)
    poles = np.ascontiguousarray(system.poles)
    diagonal = np.sum(np.abs(generator) ** 2, axis=1) / (-2 * poles.real) * np.where(is_pair, 2, 1)
    trace = residual = float(np.sum(diagonal))
    start = _first_state(system)
    blocks = [np.zeros((0, system.n_states))]
    while residual > tolerance * trace and sum(map(len, blocks)) < system.n_states:
        columns = np.zeros((256, system.n_states))
        n_columns, residual = _eliminate(
            poles, is_pair, start, generator, diagonal, tolerance * trace, columns
        )
        if n_columns == 0:
            break
        blocks.append(columns[:n_columns])
    return GramianFactor(np.concatenate(blocks).T, trace, residual)


def band_controllability_factor(
    system: PoleResidueSystem, band: tuple[float, float], n_frequencies: int = BAND_FREQUENCIES
) -> Array:
    """(n_states, k): L with L L^T about the controllability Gramian limited to the band; k is 2 n_inputs a frequency.

    band  (low, high), rad/s, 0 <= low < high

    P is 1/(2 pi) times the integral over |omega| in the band of (j omega - A)^-1 B B^* (j omega - A)^-* (Gawronski & Juang
    1990), by `band_quadrature`. omega and -omega together give the real and the imaginary part of a column.
    """
    omega, weight = band_quadrature(band, system.poles, n_frequencies)
    n, m = system.n_states, system.n_inputs
    form = real_form(system)
    columns = np.empty((n, len(omega), 2, m))
    for i, (w, scale) in enumerate(zip(omega, np.sqrt(weight / np.pi), strict=True)):
        # (jw - A) x = b on each block, A x = a x + r x[partner]: x = ((jw - a) b + r b[partner]) / ((jw - a)² + r²)
        shift = 1j * w - form.decay
        x = (shift[:, None] * form.b + form.rotation[:, None] * form.b[form.partner]) * (
            scale / (shift**2 + form.rotation**2)
        )[:, None]
        columns[:, i, 0], columns[:, i, 1] = x.real, x.imag
    return columns.reshape(n, 2 * m * len(omega))


def band_quadrature(
    band: tuple[float, float], poles: NDArray[np.complex128], n_points: int = BAND_FREQUENCIES
) -> tuple[Array, Array]:
    """Points (rad/s) and weights of composite Gauss-Legendre quadrature over the band.

    poles     (n,), 1/s, of the integrand
    n_points  approximate number of points, without those of the narrow resonances

    Panels have 4 points. Above a tenth of the smallest |pole|, where the integrand varies over octaves, they are even in
    log(omega). Below it the integrand is nearly constant, and one panel reaches to the start of the band. Around a
    resonance narrower than a panel, panels grow in proportion to the distance from it.
    """
    low, high = band
    knee = min(max(low, float(np.min(np.abs(poles), initial=high)) / 10), high)
    n_panels = max(1, n_points // 4 - 1)
    panels = knee * (high / knee) ** (np.arange(n_panels + 1) / n_panels)
    edges = np.unique(np.concatenate([[low], panels, _edges_around_resonances(band, poles)]))
    x, w = np.polynomial.legendre.leggauss(4)
    half = np.diff(edges) / 2
    middle = (edges[1:] + edges[:-1]) / 2
    return (middle[:, None] + half[:, None] * x).ravel(), (half[:, None] * w).ravel()


def _edges_around_resonances(band: tuple[float, float], poles: NDArray[np.complex128]) -> Array:
    """(k,), rad/s, inside the band: Im p + |Re p| (0, +-2, +-10, +-50, ...) up to Im p / 10 away, for narrow resonances."""
    low, high = band
    narrow = poles[
        (poles.imag > low / 1.1) & (poles.imag < high * 1.1) & (-poles.real < _NARROW * poles.imag)
    ]
    narrow = narrow[np.argsort(-narrow.real / narrow.imag)][:_MOST_RESONANCES]
    steps = 2 * 5.0 ** np.arange(20)
    offsets = -narrow.real[:, None] * np.concatenate([-steps, [0.0], steps])
    edges = narrow.imag[:, None] + offsets
    return np.asarray(edges[(np.abs(offsets) <= narrow.imag[:, None] / 10) & (edges > low) & (edges < high)])


def _first_state(system: PoleResidueSystem) -> NDArray[np.intp]:
    """(n_poles,): index of each pole's first real state."""
    sizes = np.where(system.is_pair, 2, 1)
    return np.cumsum(sizes) - sizes


def _in_real_coordinates(system: PoleResidueSystem, rows: NDArray[np.complex128]) -> Array:
    """(n_states, k) from complex rows (n_poles, k)."""
    start, is_pair = _first_state(system), system.is_pair
    out = np.empty((system.n_states, rows.shape[1]))
    out[start[~is_pair]] = rows.real[~is_pair] + rows.imag[~is_pair]
    out[start[is_pair]] = np.sqrt(2) * rows.real[is_pair]
    out[start[is_pair] + 1] = np.sqrt(2) * rows.imag[is_pair]
    return out


class _Pivot(NamedTuple):
    """A pole's block of the Gramian, its eigenvectors and the rows of the generator that its columns eliminate.

    pole                  lambda of the block
    is_pair               whether a conjugate pole belongs to it: then it is 2 by 2
    direction, second     (m,), the rows: that of the pole, and that of its conjugate once the first is eliminated
    length2, second2      squares of their norms; second2 is 0 where there is no second
    product               conj(direction) conj(direction)^T, what couples the pole to its conjugate
    cosine, sine          of the angle of the block's eigenvectors
    first_scale, second_scale  1/sqrt of its eigenvalues; second_scale is 0 where the block gives one column only
    """

    pole: complex
    is_pair: bool
    direction: NDArray[np.complex128]
    second: NDArray[np.complex128]
    length2: float
    second2: float
    product: complex
    cosine: float
    sine: float
    first_scale: float
    second_scale: float


@njit(cache=True)
def _eliminate(poles, is_pair, start, generator, diagonal, target, columns):  # type: ignore[no-untyped-def]
    """Fill `columns` with Cholesky columns, largest remaining diagonal block first, updating generator and diagonal.

    Returns (number of columns filled, remaining trace); stops at the target or when no pair of columns fits.
    """
    count = 0
    residual = diagonal.sum()
    while residual > target and count + 2 <= columns.shape[0]:
        j = np.argmax(diagonal)
        pivot = _pivot(poles[j], is_pair[j], generator[j].copy())
        if pivot.length2 == 0.0:
            break
        residual = _column(poles, is_pair, start, generator, diagonal, pivot, columns[count : count + 2])
        generator[j] = 0j
        residual -= diagonal[j]
        diagonal[j] = 0.0
        count += 2 if pivot.second_scale > 0.0 else 1
    return count, residual


@njit(cache=True)
def _pivot(pole, is_pair, direction):  # type: ignore[no-untyped-def]
    """The pivot of a pole with the row `direction` (m,) of the generator."""
    a = pole.real
    length2, product = 0.0, 0j
    for b in direction:
        length2 += b.real**2 + b.imag**2
        product += np.conj(b) ** 2
    second = np.zeros_like(direction)
    p = -length2 / (2 * a)
    if not is_pair or length2 == 0.0:
        scale = 1 / np.sqrt(p) if length2 > 0.0 else 0.0
        return _Pivot(pole, is_pair, direction, second, length2, 0.0, product, 1.0, 0.0, scale, 0.0)
    # The block [[p + Re q, Im q], [Im q, p - Re q]] has eigenvalues p +- |q|.
    q = -np.conj(product) / (2 * pole)
    angle = 0.5 * np.arctan2(q.imag, q.real)
    large, small = p + abs(q), p - abs(q)
    factor = 2 * a / (2 * np.conj(pole) * length2)
    second2 = 0.0
    for i, b in enumerate(direction):
        second[i] = np.conj(b) - factor * product * b
        second2 += second[i].real ** 2 + second[i].imag ** 2
    second_scale = 1 / np.sqrt(small) if small > 1e-14 * large and second2 > 0.0 else 0.0
    return _Pivot(
        pole, is_pair, direction, second, length2, second2, product,
        np.cos(angle), np.sin(angle), 1 / np.sqrt(large), second_scale,
    )  # fmt: skip


@njit(cache=True)
def _column(poles, is_pair, start, generator, diagonal, pivot, columns):  # type: ignore[no-untyped-def]
    """Fill the pivot's columns (2, n_states) and take it from generator and diagonal. Returns the diagonal's sum.

    The pivot's own row is left as round-off makes it: the caller clears it.
    """
    a, direction, second = pivot.pole.real, pivot.direction, pivot.second
    cosine, sine, two = pivot.cosine, pivot.sine, pivot.second_scale > 0.0
    total = 0.0
    for k in range(len(poles)):
        inner, cross = 0j, 0j
        for i in range(len(direction)):
            inner += generator[k, i] * np.conj(direction[i])
            cross += generator[k, i] * direction[i]
        inverse = 1 / (poles[k] + np.conj(pivot.pole))
        s = -inner * inverse
        mirror, t = 0j, 0j
        if pivot.is_pair:
            mirror = 1 / (poles[k] + pivot.pole)
            t = -cross * mirror
        # The pole's rows, one or two, in the pivot's two states x and y; a real pivot has only x.
        first_x, first_y, second_x, second_y = (
            s.real + t.real,
            t.imag - s.imag,
            s.imag + t.imag,
            s.real - t.real,
        )
        if pivot.is_pair != is_pair[k]:
            first_x, first_y = np.sqrt(2.0) * s.real, -np.sqrt(2.0) * s.imag
            second_x = np.sqrt(2.0) * s.imag
        row = start[k]
        columns[0, row] = (first_x * cosine + first_y * sine) * pivot.first_scale
        if is_pair[k]:
            columns[0, row + 1] = (second_x * cosine + second_y * sine) * pivot.first_scale
        if two:
            columns[1, row] = (-first_x * sine + first_y * cosine) * pivot.second_scale
            if is_pair[k]:
                columns[1, row + 1] = (-second_x * sine + second_y * cosine) * pivot.second_scale

        scale = 2 * a * inverse * inner / pivot.length2
        for i in range(len(direction)):
            generator[k, i] -= scale * direction[i]
        if pivot.second2 > 0.0:
            inner = 0j
            for i in range(len(direction)):
                inner += generator[k, i] * np.conj(second[i])
            scale = 2 * a * mirror * inner / pivot.second2
            for i in range(len(direction)):
                generator[k, i] -= scale * second[i]
        left = 0.0
        for i in range(len(direction)):
            if not is_pair[k]:
                generator[k, i] = generator[k, i].real + 0j
            left += generator[k, i].real ** 2 + generator[k, i].imag ** 2
        diagonal[k] = -left / (2 * poles[k].real) * (2 if is_pair[k] else 1)
        total += diagonal[k]
    return total
