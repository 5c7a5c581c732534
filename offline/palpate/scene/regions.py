"""Regions of the surface, where a scene fixes the nodes or lets tools work. The only definition: `palpate.geometry.regions` finds their nodes."""

from __future__ import annotations

import math
from typing import Literal

from pydantic import model_validator

from palpate.scene.quantities import Length, Number, Point, Table

_SHORTEST_NORMAL = 1e-6


class BoxRegion(Table):
    """Boundary nodes inside an axis-aligned box."""

    region: Literal["box"] = "box"
    lower_m: Point
    upper_m: Point

    @model_validator(mode="after")
    def _is_a_box(self) -> BoxRegion:
        if any(low > up for low, up in zip(self.lower_m, self.upper_m, strict=True)):
            raise ValueError(
                f"lower_m = {list(self.lower_m)}: expected at most upper_m = {list(self.upper_m)}"
            )
        return self


class PlaneRegion(Table):
    """Boundary nodes on the side of a plane that its normal points to."""

    region: Literal["plane"] = "plane"
    point_m: Point
    normal: tuple[Number, Number, Number]

    @model_validator(mode="after")
    def _has_a_normal(self) -> PlaneRegion:
        length = math.hypot(*self.normal)
        if not _SHORTEST_NORMAL <= length <= 1 / _SHORTEST_NORMAL:
            raise ValueError(f"normal = {list(self.normal)}: expected a direction, such as [0.0, 0.0, -1.0]")
        return self


class SphereRegion(Table):
    """Boundary nodes inside a sphere."""

    region: Literal["sphere"] = "sphere"
    center_m: Point
    radius_m: Length


class NearestRegion(Table):
    """The one boundary node nearest to a point; of several at the same distance, the first in the cloud."""

    region: Literal["nearest"] = "nearest"
    point_m: Point


Region = BoxRegion | PlaneRegion | SphereRegion | NearestRegion

AreaRegion = BoxRegion | PlaneRegion | SphereRegion
"""A region that holds a part of the surface with an area."""
