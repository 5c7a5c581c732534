"""The node cloud of a scene, its held nodes, contact patches and tools, and the surface to show."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from palpate.geometry.cloud import NodeCloud, TriangleSurface
from palpate.geometry.fill import fill_surface
from palpate.geometry.places_apart import places_apart
from palpate.geometry.refinement import refine_surface
from palpate.geometry.region_edge import Distance
from palpate.geometry.regions import ContactPatch, contact_patch, distance_outside, nodes_in
from palpate.geometry.sampling import depth_inside, sample_elements
from palpate.geometry.shapes import ball, box_lattice
from palpate.geometry.spacing import RefinedArea, Refinement, SpacingField
from palpate.geometry.surface import load_surface
from palpate.inclusions import finer_around_inclusions
from palpate.model_file import ToolShape
from palpate.progress import NO_PROGRESS, Progress, Warnings
from palpate.scene.regions import NearestRegion
from palpate.scene.schema import (
    BallGeometry,
    BoxGeometry,
    Config,
    ContactTable,
    SurfaceGeometry,
)

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

_NEAR_SURFACE = 0.1
"""How far from the surface a contact's point may be, as a fraction of the body's diagonal: it is moved onto it."""

_LEAST_PATCH = 0.25
"""Smallest area of a patch over that of a flat disc of its radius; a patch that wraps around the body has less."""

_AREA_SAMPLES = 0.5
"""Distance of a working area's samples over that of its nodes."""

_SHOWN_EDGE = 1.5
"""Longest triangle edge of the surface that is shown near a refined contact, in node spacings."""


def build_cloud(config: Config, folder: Path, progress: Progress = NO_PROGRESS) -> NodeCloud:
    """The nodes of the scene's body; files are relative to `folder`.

    Raises FileNotFoundError, SurfaceError or ValueError.
    """
    match config.geometry:
        case BoxGeometry(lower_m=lower, upper_m=upper, counts=counts, jitter=jitter, seed=seed):
            return box_lattice(lower, upper, counts, jitter=jitter, seed=seed)
        case BallGeometry(radius_m=radius, spacing_m=spacing):
            return ball(radius, spacing)
        case SurfaceGeometry(file=file, file_unit=unit, spacing_m=spacing):
            loaded = load_surface(folder / file, unit)
            for note in loaded.notes:
                progress.warn(note)
            areas = (*_working_areas(config, loaded.surface), *finer_around_inclusions(config, folder))
            return fill_surface(loaded.surface, spacing, refinements(config), areas, held_part(config))


def held_part(config: Config) -> Distance | None:
    """How far points are outside all fixed regions that hold an area, m; None where there is none."""
    regions = [region for region in config.fixed if not isinstance(region, NearestRegion)]
    if not regions:
        return None
    return lambda points: np.min([distance_outside(region, points) for region in regions], axis=0)


def cloud_and_warnings(config: Config, folder: Path) -> tuple[NodeCloud, tuple[str, ...]]:
    """As `build_cloud`, with the warnings that it gave."""
    heard = Warnings()
    return build_cloud(config, folder, heard), tuple(heard.texts)


def fixed_nodes(config: Config, cloud: NodeCloud) -> Indices:
    """(n_fixed,), ascending: the boundary nodes in any of the scene's fixed regions. Raises ValueError naming the region."""
    held = []
    for index, region in enumerate(config.fixed):
        try:
            held.append(nodes_in(region, cloud))
        except ValueError as error:
            raise ValueError(f"fixed[{index}]: {error}") from error
    return np.unique(np.concatenate(held))


def contact_patches(config: Config, cloud: NodeCloud, fixed: Indices) -> tuple[ContactPatch, ...]:
    """The patches of the scene's contacts, in order.

    Raises ValueError naming the contact whose patch is off the surface, larger than the body's side, or shares a node
    with a fixed region or another patch.
    """
    patches = tuple(_patch(table, cloud) for table in config.contact)
    owner = {int(n): "a fixed region" for n in fixed}
    for table, patch in zip(config.contact, patches, strict=True):
        for node in patch.nodes.tolist():
            if node in owner:
                raise ValueError(
                    f"contact {table.name!r} and {owner[node]} share node {node}: expected them apart from each other"
                )
            owner[node] = f"contact {table.name!r}"
    return patches


def shown_surface(config: Config, cloud: NodeCloud) -> TriangleSurface:
    """The body's surface with triangles small enough near refined contacts to show a dimple."""
    refined = refinements(config)
    if not refined or not isinstance(config.geometry, SurfaceGeometry):
        return cloud.surface
    spacing = config.geometry.spacing_m
    field = SpacingField(spacing, refined)
    corners = cloud.surface.vertices[cloud.surface.triangles]
    longest = float(np.max(np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=2)))
    return refine_surface(
        cloud.surface, lambda p: np.where(field(p) < spacing, _SHOWN_EDGE * field(p), longest)
    )


def in_working_area(config: Config, points: Array) -> NDArray[np.bool_]:
    """(n,): whether points (n, 3), m, of the surface lie in a working area; all do where the scene names none."""
    regions = config.surface.working_area
    if not regions:
        return np.ones(len(points), dtype=bool)
    return np.any([distance_outside(region, points) <= 0 for region in regions], axis=0)


def tool_shapes(config: Config, cloud: NodeCloud) -> tuple[ToolShape, ...]:
    """The scene's tools. One without a home starts two radii above a working area, away from the others.

    Raises ValueError naming a tool whose home is not clear of the body.
    """
    nodes = np.flatnonzero(cloud.boundary)
    working = in_working_area(config, cloud.points[nodes]) & ~np.isin(nodes, fixed_nodes(config, cloud))
    inside, beyond = nodes[working], nodes[~working]
    starts = inside[places_apart(cloud.points[inside], cloud.points[beyond], len(config.tool))]
    shapes: list[ToolShape] = []
    for tool, start in zip(config.tool, starts, strict=True):
        home = tool.home_m
        if home is None:
            x, y, z = (cloud.points[start] + 3 * tool.radius_m * cloud.normals[start]).tolist()
            home = (x, y, z)
        clear = -float(depth_inside(np.array([home]), cloud.surface)[0])
        if clear <= tool.radius_m:
            raise ValueError(
                f"tool {tool.name!r}: home_m = {[round(v, 4) for v in home]} is {clear:.3g} m outside the body: expected more "
                f"than radius_m = {tool.radius_m:g}"
            )
        shapes.append(ToolShape(tool.name, tool.radius_m, tool.friction, home))
    return tuple(shapes)


def _working_areas(config: Config, surface: TriangleSurface) -> tuple[RefinedArea, ...]:
    """The part of the surface with finer nodes, none where the scene asks for none.

    Raises ValueError naming a region that holds nothing of the surface.
    """
    spacing = config.surface.spacing_m
    if not isinstance(config.geometry, SurfaceGeometry) or spacing is None or not config.tool:
        return ()
    samples, _ = sample_elements(
        surface.vertices, surface.triangles, lambda p: np.full(len(p), spacing), _AREA_SAMPLES
    )
    for index, region in enumerate(config.surface.working_area):
        if (nearest := float(distance_outside(region, samples.points).min())) > 0:
            raise ValueError(
                f"surface.working_area[{index}]: holds nothing of the surface, which is {nearest:.3g} m outside: expected a "
                "region that holds a part of it, in m"
            )
    inside = in_working_area(config, samples.points)
    area = float(samples.measures[inside].sum())
    return (RefinedArea(samples.points[inside], area, spacing, config.geometry.growth),)


def refinements(config: Config) -> tuple[Refinement, ...]:
    """Finer nodes around every contact that asks for them, on rings so that its outline is round."""
    if not isinstance(config.geometry, SurfaceGeometry):
        return ()
    return tuple(
        Refinement(t.point_m, t.radius_m, t.spacing_m, config.geometry.growth)
        for t in config.contact
        if t.spacing_m is not None
    )


def _patch(table: ContactTable, cloud: NodeCloud) -> ContactPatch:
    try:
        patch = contact_patch(table.point_m, table.radius_m, cloud)
    except ValueError as error:
        raise ValueError(f"contact {table.name!r}: {error}") from error
    away = float(np.linalg.norm(patch.center_m - np.asarray(table.point_m)))
    reach = max(table.radius_m, float(np.max(cloud.spacing)))
    low, high = cloud.points.min(axis=0), cloud.points.max(axis=0)
    if away > max(reach, _NEAR_SURFACE * float(np.linalg.norm(high - low))):
        raise ValueError(
            f"contact {table.name!r}: point_m = {list(table.point_m)} is {away:.3g} m from the surface: expected a point "
            f"near it (the body reaches from {low.round(4).tolist()} to {high.round(4).tolist()} m)"
        )
    area, disc = float(np.sum(cloud.areas[patch.nodes])), np.pi * table.radius_m**2
    if area < _LEAST_PATCH * disc and len(patch.nodes) > 1:
        raise ValueError(
            f"contact {table.name!r}: radius_m = {table.radius_m:g} holds {area:.3g} m² of the surface, a disc of that "
            f"radius {disc:.3g} m²: expected a patch that the body has room for"
        )
    return patch
