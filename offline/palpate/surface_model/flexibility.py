"""The points of a surface under forces: modes, as many Ritz modes as the tolerance needs, and the residual flexibility."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from palpate.geometry.cloud import NodeCloud
from palpate.modes.held_body import HeldBody
from palpate.modes.lanczos import LowestModes
from palpate.progress import Progress
from palpate.scene.schema import Config
from palpate.surface_model import evidence
from palpate.surface_model.enough import enough_vectors, guessed_vectors
from palpate.surface_model.footprint import on_components
from palpate.surface_model.residual import Residual, modal_compliance, residual
from palpate.surface_model.ritz_vectors import Added, dominant_fields
from palpate.surface_model.sample import Exact, Sample, exact_compliance, sample_footprints

Array = NDArray[np.float64]

_SAFETY = 0.9
"""The sample's largest error in the working areas over the tolerance: of all points some have a larger one."""

_OUTSIDE = 0.3
"""Weight of the other points when vectors are chosen. On the liver, 0.3 gave smaller errors inside than 1, and about the same outside."""


@dataclass(frozen=True)
class Touched:
    """The points that are touched.

    nodes       (n_points,), of the cloud
    triangles   (n_triangles, 3)
    free        (n_free,), points that are not held
    working     (n_working,), those of them in a working area
    rows        (n_points, n_nodes), values at the points from parameters
    footprints  (n_points, n_points), of the smallest tool
    """

    nodes: NDArray[np.intp]
    triangles: NDArray[np.int32]
    free: NDArray[np.intp]
    working: NDArray[np.intp]
    rows: csr_array
    footprints: csr_array


@dataclass(frozen=True)
class SurfaceBody:
    """A body with its surface, before anything is solved.

    held  factorizes the body when it is first asked for
    key   of the stages that follow, in a cache
    """

    cloud: NodeCloud
    touched: Touched
    held: Callable[[], HeldBody]
    key: str


@dataclass(frozen=True)
class Flexible:
    """The points under forces, and what they are judged by.

    squared_frequencies  (n_modes,), (rad/s)², of modes and Ritz modes
    shapes               (n_points, 3, n_modes), kg^-1/2, zero at held points
    residual             (3 n_points, 3 n_points), m/N
    sample, working      (n_sample,), points, and whether they are in a working area
    exact                compliance of the assembled body at the sample
    """

    squared_frequencies: Array
    shapes: Array
    residual: Array
    sample: NDArray[np.intp]
    working: NDArray[np.bool_]
    exact: Exact


def compute_flexibility(
    config: Config, body: SurfaceBody, modes: LowestModes, progress: Progress
) -> Flexible:
    """Modes, as many Ritz modes as the tolerance needs, and the residual."""
    held, touched = body.held(), body.touched
    prony, frequencies = config.material.material().prony, evidence.band_frequencies(config.surface.band_hz)
    progress("static responses")
    left = residual(held, modes, touched.rows, touched.free, progress)
    progress.note(f"{len(touched.free):,} points")
    progress("exact compliance")
    sample = sample_footprints(touched.rows, touched.footprints, touched.free, touched.working)
    exact = exact_compliance(held, modes, sample, prony, frequencies)
    progress.note(
        f"{len(sample.points)} points, {np.count_nonzero(sample.working)} of them in the working area"
    )
    kept = modes
    if config.surface.modes is None:
        progress("Ritz vectors")
        kept = _with_vectors(config, body, modes, left, sample, exact, progress)
    shapes, compliance = _shapes(touched, kept), left.compliance
    if kept is not modes:
        compliance += modal_compliance(modes.squared_frequencies, _shapes(touched, modes))
        compliance -= modal_compliance(kept.squared_frequencies, shapes)
    return Flexible(kept.squared_frequencies, shapes, compliance, sample.points, sample.working, exact)


def _with_vectors(
    config: Config,
    body: SurfaceBody,
    modes: LowestModes,
    left: Residual,
    sample: Sample,
    exact: Exact,
    progress: Progress,
) -> LowestModes:
    """The modes and as many Ritz modes as the tolerance needs in the working areas."""
    held, touched, material = body.held(), body.touched, config.material.material()
    frequencies = evidence.band_frequencies(config.surface.band_hz)
    met = evidence.averaged(
        _shapes(touched, modes), left.compliance, modes.squared_frequencies, touched.footprints
    )
    weights = np.zeros(len(touched.nodes))
    weights[touched.free] = _OUTSIDE / np.sqrt(np.linalg.norm(met.static()[touched.free], 2, axis=(1, 2)))
    weights[touched.working] /= _OUTSIDE
    judged, loads = met.of(sample.points[sample.working]), sample.loads[:, np.repeat(sample.working, 3)]
    wanted = exact.compliance[:, sample.working]

    def fields(count: int) -> Array:
        return dominant_fields(held, left.responses, on_components(touched.footprints), weights, count)

    def error(space: Added, end: int) -> float:
        mu, rotation = space.ritz(end)
        shapes = (loads.T @ space.vectors[:, : len(mu)] @ rotation).reshape(len(judged.shapes), 3, -1)
        model = judged.with_modes(mu, shapes)
        return float(evidence.force_errors(model, wanted, material.prony, frequencies).max())

    area = float(body.cloud.areas[touched.nodes[touched.working]].sum())
    guess = guessed_vectors(material, area, config.surface.band_hz[1])
    found = enough_vectors(held, modes, fields, error, _SAFETY * config.surface.tolerance, guess, progress)
    progress.note(f"{len(found.squared_frequencies) - len(modes.squared_frequencies):,} vectors")
    return found


def _shapes(touched: Touched, modes: LowestModes) -> Array:
    """(n_points, 3, n_modes), zero at held points."""
    values = (on_components(touched.rows) @ modes.parameters).reshape(len(touched.nodes), 3, -1)
    shapes = np.zeros(values.shape)
    shapes[touched.free] = values[touched.free]
    return shapes
