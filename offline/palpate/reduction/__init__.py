"""Reduction of linear systems to a few states, and the accuracy report of a reduced model."""

from palpate.lti.errors import ReductionError
from palpate.reduction.accuracy import measure
from palpate.reduction.methods import METHODS, Reduction, reduce, reductions
from palpate.reduction.passive import passive
from palpate.reduction.surface import SurfaceOutput, fit_surface_output

__all__ = [
    "METHODS",
    "Reduction",
    "ReductionError",
    "SurfaceOutput",
    "fit_surface_output",
    "measure",
    "passive",
    "reduce",
    "reductions",
]
