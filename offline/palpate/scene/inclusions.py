"""Stiffer or softer parts of a body. The only definition: `palpate.inclusions` finds the nodes' cells in them."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from palpate.scene.quantities import Length, LengthUnit, Number, Point, Table

_Stiffness = Annotated[Number, Field(ge=1e-3, le=1e3)]


class SphereInclusion(Table):
    """A ball of another stiffness, such as a tumor."""

    shape: Literal["sphere"]
    center_m: Point
    radius_m: Length
    relative_stiffness: _Stiffness = Field(
        description="Young's modulus over the body's; Poisson's ratio, density and Prony series are the body's"
    )
    spacing_m: Length | None = Field(
        default=None, description="of the nodes at its surface and around; unset: the cloud's"
    )


class SurfaceInclusion(Table):
    """The inside of a closed triangle surface, of another stiffness."""

    shape: Literal["surface"]
    file: str = Field(description="as geometry.file")
    file_unit: LengthUnit = Field(default="m", description="unit of the file's coordinates")
    relative_stiffness: _Stiffness = Field(description="as of a sphere")
    spacing_m: Length | None = Field(default=None, description="as of a sphere")


Inclusion = SphereInclusion | SurfaceInclusion
