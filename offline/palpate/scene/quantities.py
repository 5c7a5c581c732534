"""The numbers of a scene: each kind with the range beyond which it can only be a mistake."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field


class Table(BaseModel):
    """A TOML table: no unknown keys, unchangeable."""

    model_config = ConfigDict(extra="forbid", frozen=True)


SHORTEST_M, LONGEST_M = 1e-6, 1e4
"""Lengths of bodies and of their parts."""

SystemMethod = Literal["tbr", "tbr-band", "hankel-optimal", "modal", "modal-static"]
"""Reductions of any stable linear system."""
ReductionMethod = Literal["passive", SystemMethod]
"""All reductions: "passive" needs the modes of a symmetric body."""

LengthUnit = Literal["m", "cm", "mm"]
UNITS_M: dict[LengthUnit, float] = {"m": 1.0, "cm": 0.01, "mm": 0.001}
"""The units that a surface file may be in, each with its length, m."""

Number = Annotated[float, Field(strict=True, allow_inf_nan=False)]
Count = Annotated[int, Field(strict=True, le=10**9)]
Length = Annotated[Number, Field(ge=SHORTEST_M, le=LONGEST_M)]
"""m"""
Coordinate = Annotated[Number, Field(ge=-LONGEST_M, le=LONGEST_M)]
"""m"""
Point = tuple[Coordinate, Coordinate, Coordinate]
"""m"""
