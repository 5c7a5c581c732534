"""A model of a few points of a surface that is as good as exact: what a surface model is compared with.

Its modes and Ritz modes are those that `exact_compliance` of a sample is computed with, so it is as exact, for forces at these
points alone. Fast ones among the Ritz modes can't be stepped; they follow the force at once, as a residual does.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from palpate.model_file import SurfaceAccuracy, SurfaceModel
from palpate.modes.held_body import HeldBody
from palpate.modes.lanczos import LowestModes
from palpate.surface_model.footprint import on_components
from palpate.surface_model.residual import residual_responses
from palpate.surface_model.ritz_vectors import added

FASTEST = 0.25
"""Highest frequency of a mode that is stepped, over the sampling rate. Faster ones follow without inertia."""


def reference_model(
    model: SurfaceModel, held: HeldBody, modes: LowestModes, rows: csr_array, points: NDArray[np.intp]
) -> SurfaceModel:
    """The surface at some points (n_chosen,), ascending, of the model, with all that forces there can excite.

    held, modes  the body that the model is of, and its lowest modes
    rows         (n_points, n_nodes), values at the model's points from parameters

    Its errors are not stated. Raises as `added`.
    """
    at_points = on_components(csr_array(rows[points]))
    fields = residual_responses(held, modes, at_points.T.toarray())
    space = added(held, modes, fields, n_powers=1)
    squared_frequencies, rotation = space.ritz(space.ends[-1])
    shapes = (at_points @ space.vectors @ rotation).reshape(len(points), 3, -1)
    shapes[model.held[points]] = 0.0
    fastest = np.searchsorted(squared_frequencies, (2 * np.pi * FASTEST / model.period_s) ** 2)
    stiff = shapes[:, :, fastest:].reshape(3 * len(points), -1)
    place = np.full(model.n_points, -1, np.int32)
    place[points] = np.arange(len(points))
    triangles = place[model.triangles]
    return replace(
        model,
        name=f"{model.name}, reference",
        points=model.points[points],
        normals=model.normals[points],
        triangles=triangles[np.all(triangles >= 0, axis=1)],
        held=model.held[points],
        squared_frequencies=squared_frequencies[:fastest],
        shapes=shapes[:, :, :fastest].astype(np.float32),
        residual=((stiff / squared_frequencies[fastest:]) @ stiff.T).astype(np.float32),
        accuracy=SurfaceAccuracy.unknown(len(points)),
    )
