"""From a scene to a model: every stage of the offline chain, one after the other."""

from __future__ import annotations

from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from palpate.discretization import collocation, conservative
from palpate.discretization.nodal import NodalValues, nodal_shape_functions
from palpate.discretization.resolution import resolved_frequency_hz
from palpate.geometry import regions
from palpate.geometry.cloud import NodeCloud, TriangleSurface
from palpate.geometry.fill import fill_surface
from palpate.geometry.refinement import refine_surface
from palpate.geometry.regions import ContactPatch, contact_patch, nodes_in
from palpate.geometry.shapes import ball, box_lattice
from palpate.geometry.spacing import Refinement, SpacingField
from palpate.geometry.surface import load_surface
from palpate.lti.pole_residue import DiagonalSystem
from palpate.lti.sampling import discretize, sampled_response
from palpate.lti.viscoelastic import viscoelastic_system
from palpate.meshfree import shape_functions
from palpate.model_file import Contact, PoleResidueSystem, ReducedModel, Surface
from palpate.modes.elastic_modes import ElasticModes
from palpate.reduction.accuracy import measure
from palpate.reduction.methods import reduce
from palpate.reduction.surface import fit_surface_output
from palpate.scene.material import Material
from palpate.scene.schema import (
    BallGeometry,
    BoxGeometry,
    BoxRegion,
    Config,
    ContactTable,
    NearestRegion,
    PlaneRegion,
    SphereRegion,
    SurfaceGeometry,
    canonical_text,
    fingerprint,
)

Array = NDArray[np.float64]

_NEAR_SURFACE = 0.1
"""How far from the surface a contact's point may be, as a fraction of the body's diagonal: it is moved onto it."""

_UNITS_M = {"m": 1.0, "cm": 0.01, "mm": 0.001}
_VIEW_EDGE = 1.5
"""Longest triangle edge of the surface that is shown near a refined contact, in node spacings."""


class Report(Protocol):
    """How a long computation says where it is."""

    def __call__(self, name: str) -> None:
        """The stage `name` begins."""

    def note(self, text: str) -> None:
        """What came of the stage, in a few words."""


@dataclass(frozen=True)
class FullModel:
    """The whole body before reduction.

    fixed     node indices that are held
    contacts  the patches, in the order of the inputs
    system    from patch displacement (m) to reaction force (N), exact in time for the discretized body
    """

    cloud: NodeCloud
    material: Material
    fixed: NDArray[np.intp]
    contacts: tuple[ContactPatch, ...]
    modes: ElasticModes
    system: DiagonalSystem


def build_model(config: Config, folder: Path, report: Report) -> ReducedModel:
    """Build, reduce and judge the scene; files in it are relative to `folder`.

    Raises FileNotFoundError or ValueError (ConfigError, SurfaceError, RegionError, SupportError, ReductionError) with
    what is wrong; MemoryError when the body has too many nodes for all its modes.
    """
    digest = fingerprint(config, folder)
    full = build_full_model(config, folder, report)

    report(f"reduction, {config.reduction.method}")
    band_hz, period_s, rule = config.reduction.band_hz, config.reduction.period_s, config.reduction.sampling
    reduction = reduce(
        full.system,
        config.reduction.method,
        order=config.reduction.order,
        tolerance=config.reduction.tolerance,
        band_hz=band_hz,
        response=lambda reduced, omega: sampled_response(reduced, omega, period_s, rule, band_hz[1]),
    )
    continuous = reduction.state_space
    discrete = discretize(continuous, period_s, rule, band_hz[1])
    report.note(f"{full.system.n_states:,} → {continuous.order} states")

    report("surface")
    vertices_surface = _view_surface(full.cloud, config)
    shapes, patch_shapes = _surface_shapes(full, vertices_surface.vertices, config)
    fitted = fit_surface_output(
        full.modes, full.material.prony, shapes, patch_shapes, discrete, period_s=period_s, band_hz=band_hz
    )
    del shapes, patch_shapes
    report.note(f"{len(vertices_surface.vertices):,} vertices")

    report("accuracy")
    accuracy = measure(
        full.system,
        reduction,
        discrete,
        period_s=period_s,
        band_hz=band_hz,
        error_surface_in_band=fitted.error_in_band,
        resolved_frequency_hz=resolved_frequency_hz(full.cloud, full.material),
    )
    report.note(f"force error in band {100 * accuracy.error_in_band:.2g} %")
    return ReducedModel(
        name=config.name,
        method=config.reduction.method,
        period_s=period_s,
        n_nodes=full.cloud.n_nodes,
        n_states_full=full.system.n_states,
        contacts=tuple(_contact(t.name, p) for t, p in zip(config.contact, full.contacts, strict=True)),
        continuous=continuous,
        discrete=discrete,
        full=PoleResidueSystem(full.system.poles, full.system.b, full.system.c, full.system.d),
        static_stiffness=full.modes.static_stiffness,
        surface=Surface(
            vertices=vertices_surface.vertices,
            triangles=vertices_surface.triangles,
            output=fitted.output,
            feedthrough=fitted.feedthrough,
        ),
        accuracy=accuracy,
        config=canonical_text(config),
        config_sha256=digest,
        built_with=f"palpate {version('palpate')}",
    )


def build_full_model(config: Config, folder: Path, report: Report) -> FullModel:
    """Everything up to the reduction. Raises as `build_model`."""
    material = config.material.material()

    report("node cloud")
    cloud = build_cloud(config, folder)
    contacts = tuple(_contact_patch(t, cloud) for t in config.contact)
    held = np.unique(np.concatenate([_fixed_nodes(i, r, cloud) for i, r in enumerate(config.fixed)]))
    _refuse_shared_nodes(config, contacts, held)
    report.note(
        f"{cloud.n_nodes:,} nodes, {int(cloud.boundary.sum()):,} on the surface, {len(held)} fixed, "
        f"{' + '.join(str(len(c.nodes)) for c in contacts)} in contact"
    )

    report(f"modes, {config.discretization.method}")
    modes = _elastic_modes(config, cloud, material, held, contacts)
    lowest = float(np.sqrt(np.min(np.abs(modes.squared_frequencies)))) / (2 * np.pi)
    highest = float(np.sqrt(np.max(np.abs(modes.squared_frequencies)))) / (2 * np.pi)
    report.note(f"{modes.n_modes:,} modes from {lowest:.3g} to {highest:.3g} Hz")

    report("viscoelastic system")
    system = viscoelastic_system(modes, material.prony)
    report.note(f"{system.n_states:,} states")
    return FullModel(cloud, material, held, contacts, modes, system)


def build_cloud(config: Config, folder: Path) -> NodeCloud:
    """The nodes of the scene's body. Raises FileNotFoundError, SurfaceError or ValueError."""
    match config.geometry:
        case BoxGeometry(lower_m=lower, upper_m=upper, counts=counts, jitter=jitter, seed=seed):
            return box_lattice(lower, upper, counts, jitter=jitter, seed=seed)
        case BallGeometry(radius_m=radius, spacing_m=spacing):
            return ball(radius, spacing)
        case SurfaceGeometry(file=file, file_unit=unit, spacing_m=spacing):
            surface = load_surface(folder / file, unit_m=_UNITS_M[unit])
            return fill_surface(surface, spacing, _refinements(config))


def _refinements(config: Config) -> tuple[Refinement, ...]:
    """Finer nodes around every contact that asks for them, on rings so that its outline is round."""
    if not isinstance(config.geometry, SurfaceGeometry):
        return ()
    return tuple(
        Refinement(t.point_m, t.radius_m, t.spacing_m, growth=config.geometry.growth, rings=True)
        for t in config.contact
        if t.spacing_m is not None
    )


def _region(table: BoxRegion | PlaneRegion | SphereRegion | NearestRegion) -> regions.Region:
    match table:
        case BoxRegion(lower_m=lower, upper_m=upper):
            return regions.BoxRegion(lower, upper)
        case PlaneRegion(point_m=point, normal=normal):
            return regions.PlaneRegion(point, normal)
        case SphereRegion(center_m=center, radius_m=radius):
            return regions.SphereRegion(center, radius)
        case NearestRegion(point_m=point):
            return regions.NearestRegion(point)


def _fixed_nodes(
    index: int, table: BoxRegion | PlaneRegion | SphereRegion | NearestRegion, cloud: NodeCloud
) -> NDArray[np.intp]:
    try:
        return nodes_in(_region(table), cloud)
    except ValueError as error:
        raise ValueError(f"fixed[{index}]: {error}") from error


def _contact_patch(table: ContactTable, cloud: NodeCloud) -> ContactPatch:
    """The patch of a contact. Raises ValueError where it is off the surface or larger than the body's side."""
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
            f"near it (the body reaches from {low.round(4).tolist()} to {high.round(4).tolist()})"
        )
    # A disc of radius a on a flat face; a patch that wraps around the body has far less of it than pi a².
    area = float(np.sum(cloud.areas[patch.nodes]))
    if area < 0.25 * np.pi * table.radius_m**2 and len(patch.nodes) > 1:
        raise ValueError(
            f"contact {table.name!r}: radius_m = {table.radius_m:g} holds {area:.3g} m² of the surface, a disc of that "
            f"radius {np.pi * table.radius_m**2:.3g} m²: expected a patch that the body has room for"
        )
    return patch


def _refuse_shared_nodes(config: Config, contacts: tuple[ContactPatch, ...], fixed: NDArray[np.intp]) -> None:
    owner = {int(n): "fixed" for n in fixed}
    for table, patch in zip(config.contact, contacts, strict=True):
        for node in patch.nodes.tolist():
            if node in owner:
                with_whom = "a fixed region" if owner[node] == "fixed" else f"contact {owner[node]!r}"
                raise ValueError(
                    f"contact {table.name!r} and {with_whom} share node {node}: expected them apart from each other"
                )
            owner[node] = table.name


def _elastic_modes(
    config: Config,
    cloud: NodeCloud,
    material: Material,
    fixed: NDArray[np.intp],
    contacts: tuple[ContactPatch, ...],
) -> ElasticModes:
    discretization = conservative if config.discretization.method == "conservative" else collocation
    return discretization.elastic_modes(
        cloud,
        material,
        fixed,
        [c.nodes for c in contacts],
        support_radius_factor=config.discretization.support_radius,
    )


def _view_surface(cloud: NodeCloud, config: Config) -> TriangleSurface:
    """The body's surface with triangles small enough near refined contacts to show a dimple."""
    refinements = _refinements(config)
    if not refinements or not isinstance(config.geometry, SurfaceGeometry):
        return cloud.surface
    field = SpacingField(config.geometry.spacing_m, refinements)
    spacing = config.geometry.spacing_m
    longest = float(np.max(_edge_lengths(cloud)))
    return refine_surface(
        cloud.surface, lambda p: np.where(field(p) < spacing, _VIEW_EDGE * field(p), longest)
    )


def _edge_lengths(cloud: NodeCloud) -> Array:
    corners = cloud.surface.vertices[cloud.surface.triangles]
    return np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=2)


def _surface_shapes(full: FullModel, vertices: Array, config: Config) -> tuple[Array, Array]:
    """Rows of the modes' and patches' displacement at surface vertices: (3 n_vertices, n_modes) and (.., n_inputs)."""
    factor, cloud = config.discretization.support_radius, full.cloud
    nodal = NodalValues(nodal_shape_functions(cloud, factor, derivatives=0).value)
    at_vertices = shape_functions(
        vertices, cloud.points, factor * cloud.spacing, order=1, derivatives=0
    ).value
    operator = nodal.operator(at_vertices)  # (n_vertices, n_nodes)
    return _apply(operator, full.modes.shapes), _apply(operator, full.modes.patch_shapes)


def _apply(operator: Array, columns: NDArray) -> NDArray:  # type: ignore[type-arg]
    """(3 n_vertices, k): the operator on each component of columns (3 n_nodes, k), x y z of node 0 first."""
    by_node = columns.reshape(operator.shape[1], -1)
    return (operator @ by_node).reshape(3 * operator.shape[0], -1)


def _contact(name: str, patch: ContactPatch) -> Contact:
    x, y, z = (float(v) for v in patch.center_m)
    nx, ny, nz = (float(v) for v in patch.normal)
    return Contact(name, (x, y, z), (nx, ny, nz), patch.radius_m, len(patch.nodes))
