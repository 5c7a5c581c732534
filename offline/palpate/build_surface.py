"""From a scene with tools to a surface model: cloud, body held at its supports, modes, residual flexibility, evidence."""

from __future__ import annotations

import functools
from importlib.metadata import version
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from palpate.build import node_cloud
from palpate.discretization import conservative
from palpate.geometry.cloud import NodeCloud
from palpate.geometry.measures import enclosed_volume
from palpate.geometry.node_surface import node_surface
from palpate.memory import machine_memory
from palpate.model_file import SurfaceModel
from palpate.model_file.contact_size import ripple_note, small_tool_advice
from palpate.modes.body_modes import factor_memory, stiffness_memory
from palpate.modes.held_body import hold
from palpate.modes.lanczos import LowestModes, lowest_modes
from palpate.progress import NO_PROGRESS, Progress
from palpate.scene.schema import Config, canonical_text, fingerprint
from palpate.scene_cloud import in_working_area, tool_shapes
from palpate.stage_cache import NO_CACHE, StageCache, key_of
from palpate.stage_keys import stage_keys
from palpate.surface_model import evidence
from palpate.surface_model.accuracy import accuracy_of
from palpate.surface_model.flexibility import SurfaceBody, Touched, compute_flexibility
from palpate.surface_model.footprint import footprints
from palpate.surface_model.mode_count import REACH, guessed_modes, modes_up_to
from palpate.surface_model.residual import residual_memory
from palpate.surface_model.rounding import rounded
from palpate.thin_parts import thin_working_area

_SURFACE_SOLVES = 2.5
"""Vectors that the lowest modes take, for each mode."""


def build_surface_model(
    config: Config, folder: Path, progress: Progress = NO_PROGRESS, cache: StageCache = NO_CACHE
) -> SurfaceModel:
    """Build and judge a scene with tools; files in it are relative to `folder`.

    cache  of the node cloud, the assembled body, its modes and its residual: what is in it is not computed again

    Raises FileNotFoundError or ValueError (ConfigError, SurfaceError, NodeSurfaceError, RegionError, SupportError) with
    what is wrong; LinAlgError where the supports do not hold the body; MemoryError where it does not fit into this machine.
    """
    digest, material = fingerprint(config, folder), config.material.material()
    body = surface_body(config, folder, progress, cache)
    cloud, touched = body.cloud, body.touched
    tools = tool_shapes(config, cloud)
    _warn_of_small_tools(config, cloud, progress)
    if thin := thin_working_area(config, cloud, touched.nodes[touched.working]):
        progress.warn(thin)
    modes = surface_modes(config, body, progress, cache)
    flexible = cache.kept("residual", body.key, lambda: compute_flexibility(config, body, modes, progress))
    single, shift = rounded(flexible.residual, touched.free)
    progress("evidence")
    shapes = flexible.shapes.astype(np.float32)
    met = evidence.averaged(shapes, single, flexible.squared_frequencies, touched.footprints)
    accuracy = accuracy_of(config, body, flexible, met, shift)
    progress.note(f"force error in band {100 * accuracy.error_in_working_area:.2g} % in the working area")
    is_held = np.ones(len(touched.nodes), dtype=bool)
    is_held[touched.free] = False
    return SurfaceModel(
        name=config.name,
        period_s=config.surface.period_s,
        n_nodes=cloud.n_nodes,
        tools=tools,
        points=cloud.points[touched.nodes],
        normals=cloud.normals[touched.nodes],
        triangles=touched.triangles,
        held=is_held,
        squared_frequencies=flexible.squared_frequencies,
        shapes=shapes,
        residual=single,
        gamma=np.array(material.prony.gamma),
        tau_s=np.array(material.prony.tau_s),
        band_hz=config.surface.band_hz,
        config=canonical_text(config),
        config_sha256=digest,
        built_with=f"palpate {version('palpate')}",
        accuracy=accuracy,
    )


def surface_body(
    config: Config, folder: Path, progress: Progress = NO_PROGRESS, cache: StageCache = NO_CACHE
) -> SurfaceBody:
    """The assembled body and the points that are touched. Arguments and errors as `build_surface_model`."""
    material, keys = config.material.material(), stage_keys(config, folder)
    cloud, fixed = surface_cloud(config, folder, progress, cache)
    support = config.discretization.support_radius
    needed = _require_memory(config, cloud)
    progress("assembly, conservative")
    unit = cache.kept(
        "body", keys.body, lambda: conservative.assemble(cloud, material.unit, fixed, [], support)
    )
    body = unit.scaled(material.youngs_modulus_pa, material.density_kg_per_m3)
    progress.note(f"memory needed about {needed / 2**30:.1f} GiB")
    touched = _touched(config, cloud, fixed, body.basis.value)
    key = key_of(keys.surface, fingerprint(config, folder))
    return SurfaceBody(cloud, touched, functools.cache(lambda: hold(body, fixed)), key)


def surface_cloud(
    config: Config, folder: Path, progress: Progress = NO_PROGRESS, cache: StageCache = NO_CACHE
) -> tuple[NodeCloud, NDArray[np.int64]]:
    """As `node_cloud`. Arguments and errors as `build_surface_model`."""
    cloud, fixed = node_cloud(config, folder, stage_keys(config, folder), progress, cache)
    progress.note(
        f"{cloud.n_nodes:,} nodes, {int(cloud.boundary.sum()):,} on the surface, {len(fixed)} fixed"
    )
    return cloud, fixed


def surface_modes(
    config: Config, body: SurfaceBody, progress: Progress = NO_PROGRESS, cache: StageCache = NO_CACHE
) -> LowestModes:
    """The modes that the scene asks for, or as many as its tolerance needs. Errors as `build_surface_model`."""
    progress("modes")
    wanted = config.surface

    def compute() -> LowestModes:
        if wanted.modes is not None:
            return lowest_modes(body.held(), wanted.modes)
        return modes_up_to(body.held(), REACH * wanted.band_hz[1], _guess(config, body.cloud), progress)

    modes = cache.kept("surface-modes", body.key, compute)
    highest = float(np.sqrt(modes.squared_frequencies[-1]) / (2 * np.pi))
    progress.note(f"{len(modes.squared_frequencies):,} modes up to {highest:.3g} Hz")
    if highest <= wanted.band_hz[1]:
        raise ValueError(
            f"surface.modes = {len(modes.squared_frequencies)} reach {highest:.3g} Hz: expected modes beyond the end of "
            f"surface.band_hz, {wanted.band_hz[1]:g} Hz"
        )
    return modes


def _guess(config: Config, cloud: NodeCloud) -> int:
    """About how many modes there will be."""
    return config.surface.modes or guessed_modes(
        config.material.material(),
        enclosed_volume(cloud.surface),
        float(cloud.areas.sum()),
        REACH * config.surface.band_hz[1],
    )


def _warn_of_small_tools(config: Config, cloud: NodeCloud, progress: Progress) -> None:
    """Warn of tools that touch too few points for their radius where the points are as far apart as anywhere they work."""
    working = cloud.boundary & in_working_area(config, cloud.points)
    spacing = float(cloud.spacing[working].max())
    for tool in config.tool:
        if text := small_tool_advice(tool.name, tool.radius_m, spacing):
            progress.warn(text)
    if text := ripple_note(min(tool.radius_m for tool in config.tool), spacing):
        progress.note(text)


def _touched(config: Config, cloud: NodeCloud, fixed: NDArray[np.int64], value: csr_array) -> Touched:
    """Raises ValueError where all points of the working areas are held."""
    nodes = np.flatnonzero(cloud.boundary)
    free = np.flatnonzero(~np.isin(nodes, fixed))
    points = cloud.points[nodes]
    working = free[in_working_area(config, points[free])]
    if not len(working):
        raise ValueError("surface.working_area: all of its points are fixed: expected some that can move")
    radius = min(tool.radius_m for tool in config.tool)
    return Touched(
        nodes=nodes,
        triangles=node_surface(cloud).triangles,
        free=free,
        working=working,
        rows=csr_array(value[nodes]),
        footprints=footprints(points, cloud.normals[nodes], cloud.areas[nodes], radius),
    )


def memory_needed(config: Config, cloud: NodeCloud) -> float:
    """Bytes that the build needs at its peak, about."""
    n, n_points, n_modes = 3 * cloud.n_nodes, int(cloud.boundary.sum()), _guess(config, cloud)
    support = config.discretization.support_radius
    stiffness = stiffness_memory(cloud.n_nodes, support)
    factor = factor_memory(cloud.n_nodes, support)
    space = 2 * 8 * n * _SURFACE_SOLVES * n_modes
    return (
        0.5 * 2**30
        + stiffness
        + max(4 * stiffness, factor + max(space, residual_memory(n, n_points, n_modes)))
    )


def _require_memory(config: Config, cloud: NodeCloud) -> float:
    """As `memory_needed`. Raises MemoryError where the machine has less."""
    needed, present = memory_needed(config, cloud), machine_memory()
    if needed > present:
        raise MemoryError(
            f"the surface model of {cloud.n_nodes:,} nodes, {int(cloud.boundary.sum()):,} of them on the surface, needs about "
            f"{needed / 2**30:.1f} GiB, this machine has {present / 2**30:.1f}: expected a larger surface.spacing_m or a "
            "smaller surface.working_area"
        )
    return needed
