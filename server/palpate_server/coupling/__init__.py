"""What a tick asks of a coupling between ports and a body, compiled for the coupling of the model that runs.

A coupling is a named tuple of arrays. Its module defines the functions below, with these names and arguments, for compiled
code, and registers itself. All arrays are in the model's frame: `displacement` (n_tools, 3), m, of each tip from its tool's
start; `force` (n_tools, 3), N, of the tissue on each tool; `state` (n,), all that the body and the coupling remember.
"""

# mypy: disable-error-code="no-untyped-def, no-untyped-call"
from __future__ import annotations

from collections.abc import Callable
from types import ModuleType
from typing import Any

import numpy as np
from numba.extending import overload
from numpy.typing import NDArray

from palpate_server.realtime.native_image import ViewType

Floats = NDArray[np.float64]

_MODULES: dict[type, ModuleType] = {}
_COMPILED_ONLY = "for compiled code alone"


def register(coupling: type, module: ModuleType) -> None:
    """Have the functions of `module` used for couplings of this type of named tuple."""
    _MODULES[coupling] = module


def advance(coupling: Any, displacement: Floats, force: Floats) -> None:
    """One tick: write the forces at these displacements, and advance the state."""
    raise TypeError(_COMPILED_ONLY)


def is_fading(coupling: Any) -> bool:
    """Whether another model is being faded in."""
    raise TypeError(_COMPILED_ONLY)


def put_to_rest(coupling: Any) -> None:
    """Put the state to zero."""
    raise TypeError(_COMPILED_ONLY)


def save(coupling: Any, state: Floats) -> None:
    """Copy the state into `state`; that of the body which is shown comes first."""
    raise TypeError(_COMPILED_ONLY)


def _compile(function: Callable[..., bool | None]) -> None:
    """Have compiled code call the function of this name in the coupling's module."""

    @overload(function, strict=False)
    def choose(coupling, *arguments):
        tuple_type: Any = coupling.tuple_type if isinstance(coupling, ViewType) else coupling
        return getattr(_MODULES[tuple_type.instance_class], function.__name__)


for _function in (advance, is_fading, put_to_rest, save):
    _compile(_function)
