"""The stiffness of each node's cell where a scene has inclusions, and the finer nodes that they ask for.

A cell that the inclusion's surface cuts has the geometric mean of its two parts' stiffness. The part inside is that of a cell
as wide as this one, cut at right angles at its centroid's distance from the surface. With the arithmetic mean, which holds
only where both parts are strained alike, a ball ten times as stiff would act too strongly: by 25 % with eight nodes across,
5 % with the geometric mean (docs/validation.md).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from palpate.geometry.cloud import NodeCloud
from palpate.geometry.measures import enclosed_volume, triangle_normals
from palpate.geometry.sampling import depth_inside, sample_elements
from palpate.geometry.shapes import directions
from palpate.geometry.spacing import RefinedArea
from palpate.geometry.surface import load_surface
from palpate.scene.inclusions import Inclusion, SphereInclusion
from palpate.scene.schema import Config, SurfaceGeometry

Array = NDArray[np.float64]

_SAMPLES_A_SPACING = 2

_MOST_NODES = 1e6
"""On the surface of an inclusion: more are beyond any machine, and a spacing that asks for them is a mistake."""

_LARGEST_LOSS = 0.1
"""Of an inclusion's volume: what the cells inside may lack or have too much before the build warns."""


def with_inclusions(config: Config, folder: Path, cloud: NodeCloud, warn: Callable[[str], None]) -> NodeCloud:
    """The cloud with the stiffness that the scene's inclusions give its cells.

    Where inclusions overlap, the later one counts. Files are relative to `folder`.

    Raises FileNotFoundError, SurfaceError; ValueError naming an inclusion that holds no part of the body.
    """
    if not config.inclusion:
        return cloud
    stiffness = np.ones(cloud.n_nodes)
    width = np.sqrt(12 * np.trace(cloud.moments, axis1=1, axis2=2) / 3)
    for index, inclusion in enumerate(config.inclusion):
        depth, volume = _depth_and_volume(inclusion, folder, cloud.centroids)
        inside = np.clip(0.5 + depth / width, 0.0, 1.0)
        held = float(inside @ cloud.volumes)
        if held == 0:
            raise ValueError(
                f"inclusion[{index}]: holds no part of the body, whose nearest node is {-depth.max():.3g} m outside: expected an "
                "inclusion within the body, in m"
            )
        if abs(held / volume - 1) > _LARGEST_LOSS:
            warn(
                f"inclusion[{index}]: {held * 1e6:.3g} cm³ of the nodes' cells lie in it, its volume is {volume * 1e6:.3g} cm³: "
                + _likely_cause(inclusion, cloud)
            )
        stiffness *= (inclusion.relative_stiffness / stiffness) ** inside
    return replace(cloud, relative_stiffness=stiffness)


def finer_around_inclusions(config: Config, folder: Path) -> tuple[RefinedArea, ...]:
    """The surfaces of the inclusions that ask for finer nodes.

    Raises FileNotFoundError, SurfaceError; ValueError naming an inclusion whose spacing asks for millions of nodes.
    """
    geometry = config.geometry
    if not isinstance(geometry, SurfaceGeometry):
        return ()
    return tuple(
        _finer_around(f"inclusion[{index}]", inclusion, inclusion.spacing_m, geometry.growth, folder)
        for index, inclusion in enumerate(config.inclusion)
        if inclusion.spacing_m is not None
    )


def _likely_cause(inclusion: Inclusion, cloud: NodeCloud) -> str:
    """Why the cells inside are not as large as the inclusion."""
    spacing = "a spacing_m of a third of its thickness or less"
    if not isinstance(inclusion, SphereInclusion):
        return f"expected it within the body, and {spacing}"
    depth = float(depth_inside(np.array([inclusion.center_m]), cloud.surface)[0])
    if depth >= inclusion.radius_m:
        return f"expected {spacing}"
    side = "inside" if depth >= 0 else "outside"
    return f"center_m is {abs(depth):.2g} m {side} the body: expected it at least radius_m = {inclusion.radius_m:g} inside"


def _depth_and_volume(inclusion: Inclusion, folder: Path, points: Array) -> tuple[Array, float]:
    """Depth of points (n, 3) inside the inclusion, m, (n,), and its volume, m³."""
    if isinstance(inclusion, SphereInclusion):
        away = np.linalg.norm(points - np.asarray(inclusion.center_m), axis=1)
        return inclusion.radius_m - away, 4 / 3 * np.pi * inclusion.radius_m**3
    surface = load_surface(folder / inclusion.file, inclusion.file_unit).surface
    return depth_inside(points, surface), enclosed_volume(surface)


def _finer_around(
    name: str, inclusion: Inclusion, spacing_m: float, growth: float, folder: Path
) -> RefinedArea:
    """The inclusion's surface, with samples half a spacing apart."""
    if isinstance(inclusion, SphereInclusion):
        area = 4 * np.pi * inclusion.radius_m**2
        _require_possible(name, area, spacing_m)
        count = int(np.ceil(area * (_SAMPLES_A_SPACING / spacing_m) ** 2))
        points = np.asarray(inclusion.center_m) + inclusion.radius_m * directions(count)
        return RefinedArea(points, area, spacing_m, growth)
    surface = load_surface(folder / inclusion.file, inclusion.file_unit).surface
    area = float(triangle_normals(surface)[1].sum())
    _require_possible(name, area, spacing_m)
    samples, _ = sample_elements(
        surface.vertices, surface.triangles, lambda p: np.full(len(p), spacing_m), 1 / _SAMPLES_A_SPACING
    )
    return RefinedArea(samples.points, area, spacing_m, growth)


def _require_possible(name: str, area_m2: float, spacing_m: float) -> None:
    nodes = area_m2 / spacing_m**2
    if nodes > _MOST_NODES:
        raise ValueError(
            f"{name}.spacing_m = {spacing_m:g}: would put {nodes:.2g} nodes on its surface, expected a larger spacing, in m"
        )
