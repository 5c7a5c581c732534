"""The evidence of a surface model: errors, passivity and stiffness of the smallest tool, over its points or a sample of them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from palpate.discretization.resolution import resolved_frequency_hz
from palpate.model_file import SurfaceAccuracy
from palpate.model_file.contact_size import blunted_error, contact_radius_m
from palpate.scene.schema import Config
from palpate.surface_model import evidence
from palpate.surface_model.flexibility import Flexible, SurfaceBody, Touched

Array = NDArray[np.float64]


def accuracy_of(
    config: Config, body: SurfaceBody, flexible: Flexible, met: evidence.Footprints, shift_m_per_n: float
) -> SurfaceAccuracy:
    """The evidence of a surface model. Raises ValueError where it can give out energy.

    met            the footprints around its points, as they are stored
    shift_m_per_n  what was added to the diagonal of its residual
    """
    cloud, touched = body.cloud, body.touched
    wanted, prony = config.surface, config.material.material().prony
    sampled, free = met.of(flexible.sample), met.of(touched.free)
    static = evidence.static_errors(sampled, flexible.exact.static)
    errors = evidence.force_errors(
        sampled, flexible.exact.compliance, prony, evidence.band_frequencies(wanted.band_hz)
    )
    points, normals = cloud.points[touched.nodes], cloud.normals[touched.nodes][touched.free]
    smallest = min(tool.radius_m for tool in config.tool)
    accuracy = SurfaceAccuracy(
        contact_radius_m=contact_radius_m(smallest),
        error_static=float(static.max()),
        error_static_median=float(np.median(static)),
        error_in_band=float(errors.max()),
        error_in_band_median=float(np.median(errors)),
        error_in_working_area=float(errors[flexible.working].max()),
        passivity_margin=evidence.passivity_margin(free, prony, wanted.period_s),
        passivity_margin_sampled=evidence.passivity_margin_sampled(free, prony, wanted.period_s),
        largest_stiffness_n_per_m=evidence.largest_stiffness(free, normals, prony, wanted.period_s),
        residual_shift_m_per_n=shift_m_per_n,
        resolved_frequency_hz=resolved_frequency_hz(cloud, config.material.material()),
        error_map=_error_map(points, touched, flexible.sample, errors, smallest),
    )
    if not accuracy.is_passive:
        margin = min(accuracy.passivity_margin, accuracy.passivity_margin_sampled)
        raise ValueError(
            f"the surface model can give out energy: passivity margin {margin:.1e}, expected at least 0"
        )
    return accuracy


def _error_map(
    points: Array, touched: Touched, sample: NDArray[np.intp], errors: Array, radius_m: float
) -> NDArray[np.float32]:
    """(n_points,), as in SurfaceAccuracy, from the errors of the sample and the radius of the smallest tool."""
    error_map = np.zeros(len(points), dtype=np.float32)
    _, nearest = cKDTree(points[sample]).query(points[touched.free])
    blunted = blunted_error(points, touched.triangles, radius_m)[touched.free]
    error_map[touched.free] = np.maximum(errors[nearest], blunted)
    return error_map
