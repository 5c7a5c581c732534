"""Reductions of linear systems, of viscoelastic bodies above all, and the accuracy report for them."""

from palpate.lti.errors import ReductionError
from palpate.lti.sampling import discretize
from palpate.reduction.accuracy import measure
from palpate.reduction.hankel_optimal import hankel_optimal
from palpate.reduction.linear_system import LinearSystem
from palpate.reduction.methods import METHODS, Method, Reduction, reduce
from palpate.reduction.surface import SurfaceOutput, fit_surface_output
from palpate.reduction.truncation import (
    ReducedSystem,
    balanced_truncation,
    band_limited_truncation,
    modal_truncation,
    singular_perturbation_balancing,
)

__all__ = [
    "METHODS",
    "LinearSystem",
    "Method",
    "ReducedSystem",
    "Reduction",
    "ReductionError",
    "SurfaceOutput",
    "balanced_truncation",
    "band_limited_truncation",
    "discretize",
    "fit_surface_output",
    "hankel_optimal",
    "measure",
    "modal_truncation",
    "reduce",
    "singular_perturbation_balancing",
]
