"""Reduction of a viscoelastic body to the few states that run at 1 kHz, and the evidence for them."""

from palpate.reduction.evidence import measure
from palpate.reduction.methods import METHODS, Method, Reduction, ReductionError, reduce
from palpate.reduction.sampling import discretise
from palpate.reduction.surface import SurfaceOutput, fit_surface_output

__all__ = [
    "METHODS",
    "Method",
    "Reduction",
    "ReductionError",
    "SurfaceOutput",
    "discretise",
    "fit_surface_output",
    "measure",
    "reduce",
]
