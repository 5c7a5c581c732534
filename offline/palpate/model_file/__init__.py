"""The model file: one `.npz` that the offline stage writes and the server reads (`docs/model-file.md`).

The package needs numpy and the standard library only, so that a server can load a model without the offline libraries.
"""

from palpate.lti.pole_residue import PoleResidueSystem
from palpate.model_file.read import load_model, load_patch_model
from palpate.model_file.surface_model import SurfaceAccuracy, SurfaceModel, ToolShape, stiffened
from palpate.model_file.types import (
    LONGEST_PERIOD_S,
    SHORTEST_PERIOD_S,
    AccuracyReport,
    Contact,
    ModelFileError,
    ReducedModel,
    StateSpace,
    Surface,
)
from palpate.model_file.write import save_model

__all__ = [
    "LONGEST_PERIOD_S",
    "SHORTEST_PERIOD_S",
    "AccuracyReport",
    "Contact",
    "ModelFileError",
    "PoleResidueSystem",
    "ReducedModel",
    "StateSpace",
    "Surface",
    "SurfaceAccuracy",
    "SurfaceModel",
    "ToolShape",
    "load_model",
    "load_patch_model",
    "save_model",
    "stiffened",
]
