"""The node cloud of a scene, its held nodes and contact patches, and the surface to show."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from palpate.geometry.cloud import NodeCloud, TriangleSurface
from palpate.geometry.fill import fill_surface
from palpate.geometry.refinement import refine_surface
from palpate.geometry.regions import ContactPatch, contact_patch, nodes_in
from palpate.geometry.shapes import ball, box_lattice
from palpate.geometry.spacing import Refinement, SpacingField
from palpate.geometry.surface import load_surface
from palpate.progress import NO_PROGRESS, Progress
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
            return fill_surface(loaded.surface, spacing, _refinements(config))


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
    refinements = _refinements(config)
    if not refinements or not isinstance(config.geometry, SurfaceGeometry):
        return cloud.surface
    spacing = config.geometry.spacing_m
    field = SpacingField(spacing, refinements)
    corners = cloud.surface.vertices[cloud.surface.triangles]
    longest = float(np.max(np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=2)))
    return refine_surface(
        cloud.surface, lambda p: np.where(field(p) < spacing, _SHOWN_EDGE * field(p), longest)
    )


def _refinements(config: Config) -> tuple[Refinement, ...]:
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
