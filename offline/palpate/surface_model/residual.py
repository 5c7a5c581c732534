"""Residual flexibility: the static compliance of a body's surface less that of the modes that are kept (MacNeal 1971)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from palpate.modes.held_body import HeldBody
from palpate.modes.lanczos import LowestModes
from palpate.progress import Progress
from palpate.surface_model.footprint import on_components

Array = NDArray[np.float64]

BLOCK = 96
"""Loads that are solved for at once."""


@dataclass(frozen=True)
class Residual:
    """What the modes leave out.

    compliance  (3 n_points, 3 n_points), R, m/N, between points; symmetric, positive semidefinite up to round-off
    responses   (3 n_points, c n_nodes), parameters under unit forces at the points
    """

    compliance: Array
    responses: NDArray[np.float32]


def modal_compliance(squared_frequencies: Array, shapes: Array) -> Array:
    """(3 n_points, 3 n_points), m/N, at 0 Hz, of modes with shapes (n_points, 3, n_modes); symmetric to the last bit."""
    scaled = (shapes / np.sqrt(squared_frequencies)).reshape(3 * len(shapes), -1)
    return np.asarray(scaled @ scaled.T)


def residual_memory(n_parameters: int, n_points: int, n_modes: int) -> float:
    """Bytes of `residual` at its peak."""
    compliance = 8.0 * (3 * n_points) ** 2
    responses = 4.0 * 3 * n_points * n_parameters
    return 4 * compliance + responses + 8.0 * n_parameters * n_modes


def residual_responses(held: HeldBody, modes: LowestModes, loads: Array) -> Array:
    """(c n_nodes, k): the static response to loads (c n_nodes, k) less that of the modes.

    The supports give way by the compliance of their penalty, a few parts in a million, so that the response is never too
    small: what is left after the modes stays semidefinite.
    """
    along = modes.parameters.T @ loads / modes.squared_frequencies[:, None]
    return held.approximate(loads) - modes.parameters @ along


def residual(
    held: HeldBody, modes: LowestModes, rows: csr_array, free: NDArray[np.intp], progress: Progress
) -> Residual:
    """The residual at points.

    rows  (n_points, n_nodes): values at the points from parameters
    free  (n_free,): points that are not held; the others have no compliance
    """
    at_points = on_components(rows)
    columns = (3 * free[:, None] + np.arange(3)).ravel()
    compliance = np.zeros((at_points.shape[0], at_points.shape[0]))
    responses = np.zeros((at_points.shape[0], at_points.shape[1]), dtype=np.float32)
    for start in range(0, len(columns), BLOCK):
        block = columns[start : start + BLOCK]
        found = residual_responses(held, modes, at_points[block].T.toarray())
        compliance[block] = (at_points @ found).T
        responses[block] = found.T
        progress.note(f"{start // 3:,} of {len(free):,} points")
    held_points = np.setdiff1d(np.arange(at_points.shape[0]), columns)
    compliance[:, held_points] = 0.0
    _symmetrize(compliance)
    return Residual(compliance, responses)


def _symmetrize(matrix: Array) -> None:
    """(A + Aᵀ) / 2 in place, some rows at a time."""
    for start in range(0, len(matrix), BLOCK):
        stop = start + BLOCK
        mean = (matrix[start:stop, start:] + matrix[start:, start:stop].T) / 2
        matrix[start:stop, start:] = mean
        matrix[start:, start:stop] = mean.T
