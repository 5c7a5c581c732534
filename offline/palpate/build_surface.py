"""From a scene with tools to a surface model: cloud, body held at its supports, modes, residual flexibility, evidence."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.spatial import cKDTree

from palpate.discretization import conservative
from palpate.discretization.resolution import resolved_frequency_hz
from palpate.factorization import solver_name
from palpate.factorization.dense import dense_memory
from palpate.geometry.cloud import NodeCloud
from palpate.geometry.measures import enclosed_volume
from palpate.geometry.node_surface import node_surface
from palpate.inclusions import with_inclusions
from palpate.memory import machine_memory
from palpate.model_file import SurfaceAccuracy, SurfaceModel
from palpate.model_file.contact_size import contact_radius_m, small_tool_advice
from palpate.modes.body_modes import factor_memory, stiffness_memory
from palpate.modes.held_body import HeldBody, hold
from palpate.modes.lanczos import LowestModes, lowest_modes
from palpate.progress import NO_PROGRESS, Progress
from palpate.scene.plausibility import plausibility
from palpate.scene.schema import Config, canonical_text, fingerprint
from palpate.scene_cloud import cloud_and_warnings, fixed_nodes, in_working_area, tool_shapes
from palpate.stage_cache import NO_CACHE, StageCache, key_of
from palpate.stage_keys import stage_keys
from palpate.surface_model import evidence
from palpate.surface_model.enough import enough_vectors, guessed_vectors
from palpate.surface_model.footprint import footprints, on_components
from palpate.surface_model.mode_count import REACH, guessed_modes, modes_up_to
from palpate.surface_model.residual import Residual, modal_compliance, residual, residual_memory
from palpate.surface_model.ritz_vectors import Added, dominant_fields
from palpate.surface_model.rounding import rounded
from palpate.surface_model.sample import Exact, Sample, exact_compliance, sample_footprints
from palpate.thin_parts import thin_working_area

Array = NDArray[np.float64]

_ROUND_OFF = 1e-6
"""Of a passivity margin: the shapes and the residual are stored in single precision."""

_SURFACE_SOLVES = 2.5
"""Vectors that the lowest modes take, for each mode."""

_SAFETY = 0.9
"""The sample's largest error in the working areas over the tolerance: of all points some have a larger one."""

_OUTSIDE = 0.3
"""Weight of the other points when vectors are chosen. On the liver, 0.3 gave smaller errors inside than 1, and about the same outside."""


@dataclass(frozen=True)
class Touched:
    """The points that are touched.

    nodes       (n_points,), of the cloud
    triangles   (n_triangles, 3)
    free        (n_free,), points that are not held
    working     (n_working,), those of them in a working area
    rows        (n_points, n_nodes), values at the points from parameters
    footprints  (n_points, n_points), of the smallest tool
    """

    nodes: NDArray[np.intp]
    triangles: NDArray[np.int32]
    free: NDArray[np.intp]
    working: NDArray[np.intp]
    rows: csr_array
    footprints: csr_array


@dataclass(frozen=True)
class _Flexible:
    """The points under forces, and what they are judged by.

    squared_frequencies  (n_modes,), (rad/s)², of modes and Ritz modes
    shapes               (n_points, 3, n_modes), kg^-1/2, zero at held points
    residual             (3 n_points, 3 n_points), m/N
    sample, working      (n_sample,), points, and whether they are in a working area
    exact                compliance of the assembled body at the sample
    """

    squared_frequencies: Array
    shapes: Array
    residual: Array
    sample: NDArray[np.intp]
    working: NDArray[np.bool_]
    exact: Exact


@dataclass(frozen=True)
class SurfaceBody:
    """A body with its surface, before anything is solved.

    held  factorizes the body when it is first asked for
    key   of the stages that follow, in a cache
    """

    cloud: NodeCloud
    touched: Touched
    held: Callable[[], HeldBody]
    key: str


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
    flexible = cache.kept("residual", body.key, lambda: _flexible(config, body, modes, progress))
    single, shift = rounded(flexible.residual, touched.free)
    progress("evidence")
    shapes = flexible.shapes.astype(np.float32)
    met = evidence.averaged(shapes, single, flexible.squared_frequencies, touched.footprints)
    accuracy = _accuracy(config, cloud, touched, flexible, met, shift)
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
    progress("node cloud")
    cloud, warnings = cache.kept("cloud", keys.cloud, lambda: cloud_and_warnings(config, folder))
    for text in (*warnings, *plausibility(config, float(np.max(np.ptp(cloud.points, axis=0))))):
        progress.warn(text)
    cloud = with_inclusions(config, folder, cloud, progress.warn)
    fixed = fixed_nodes(config, cloud)
    progress.note(
        f"{cloud.n_nodes:,} nodes, {int(cloud.boundary.sum()):,} on the surface, {len(fixed)} fixed"
    )
    support = config.discretization.support_radius
    guess = _guess(config, cloud)
    needed = _require_memory(cloud, guess, support)
    progress("assembly, conservative")
    unit = cache.kept(
        "body", keys.body, lambda: conservative.assemble(cloud, material.unit, fixed, [], support)
    )
    body = unit.scaled(material.youngs_modulus_pa, material.density_kg_per_m3)
    progress.note(f"memory needed about {needed / 2**30:.1f} GiB")
    touched = _touched(config, cloud, fixed, body.basis.value)
    n_solves = int(_SURFACE_SOLVES * guess) + 3 * len(touched.nodes)
    key = key_of(keys.surface, fingerprint(config, folder))
    return SurfaceBody(cloud, touched, functools.cache(lambda: hold(body, fixed, n_solves=n_solves)), key)


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


def _flexible(config: Config, body: SurfaceBody, modes: LowestModes, progress: Progress) -> _Flexible:
    """Modes, as many Ritz modes as the tolerance needs, and the residual."""
    held, touched = body.held(), body.touched
    prony, frequencies = config.material.material().prony, evidence.band_frequencies(config.surface.band_hz)
    progress("static responses")
    left = residual(held, modes, touched.rows, touched.free, progress)
    progress.note(f"{len(touched.free):,} points")
    progress("exact compliance")
    sample = sample_footprints(touched.rows, touched.footprints, touched.free, touched.working)
    exact = exact_compliance(held, modes, sample, prony, frequencies)
    progress.note(
        f"{len(sample.points)} points, {np.count_nonzero(sample.working)} of them in the working area"
    )
    kept = modes
    if config.surface.modes is None:
        progress("Ritz vectors")
        kept = _with_vectors(config, body, modes, left, sample, exact, progress)
    shapes, compliance = _shapes(touched, kept), left.compliance
    if kept is not modes:
        compliance += modal_compliance(modes.squared_frequencies, _shapes(touched, modes))
        compliance -= modal_compliance(kept.squared_frequencies, shapes)
    return _Flexible(kept.squared_frequencies, shapes, compliance, sample.points, sample.working, exact)


def _with_vectors(
    config: Config,
    body: SurfaceBody,
    modes: LowestModes,
    left: Residual,
    sample: Sample,
    exact: Exact,
    progress: Progress,
) -> LowestModes:
    """The modes and as many Ritz modes as the tolerance needs in the working areas."""
    held, touched, material = body.held(), body.touched, config.material.material()
    frequencies = evidence.band_frequencies(config.surface.band_hz)
    met = evidence.averaged(
        _shapes(touched, modes), left.compliance, modes.squared_frequencies, touched.footprints
    )
    weights = np.zeros(len(touched.nodes))
    weights[touched.free] = _OUTSIDE / np.sqrt(np.linalg.norm(met.static()[touched.free], 2, axis=(1, 2)))
    weights[touched.working] /= _OUTSIDE
    judged, loads = met.of(sample.points[sample.working]), sample.loads[:, np.repeat(sample.working, 3)]
    wanted = exact.compliance[:, sample.working]

    def fields(count: int) -> Array:
        return dominant_fields(held, left.responses, on_components(touched.footprints), weights, count)

    def error(space: Added, end: int) -> float:
        mu, rotation = space.ritz(end)
        shapes = (loads.T @ space.vectors[:, : len(mu)] @ rotation).reshape(len(judged.shapes), 3, -1)
        model = judged.with_modes(mu, shapes)
        return float(evidence.force_errors(model, wanted, material.prony, frequencies).max())

    area = float(body.cloud.areas[touched.nodes[touched.working]].sum())
    guess = guessed_vectors(material, area, config.surface.band_hz[1])
    found = enough_vectors(held, modes, fields, error, _SAFETY * config.surface.tolerance, guess, progress)
    progress.note(f"{len(found.squared_frequencies) - len(modes.squared_frequencies):,} vectors")
    return found


def _warn_of_small_tools(config: Config, cloud: NodeCloud, progress: Progress) -> None:
    """Warn of tools that touch too few points for their radius where the points are as far apart as anywhere they work."""
    working = cloud.boundary & in_working_area(config, cloud.points)
    spacing = float(cloud.spacing[working].max())
    for tool in config.tool:
        if text := small_tool_advice(tool.name, tool.radius_m, spacing):
            progress.warn(text)


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


def _require_memory(cloud: NodeCloud, n_modes: int, support_radius_factor: float) -> float:
    """Bytes that the build needs at its peak. Raises MemoryError where the machine has less."""
    n, n_points = 3 * cloud.n_nodes, int(cloud.boundary.sum())
    stiffness = stiffness_memory(cloud.n_nodes, support_radius_factor)
    dense = solver_name(n, int(_SURFACE_SOLVES * n_modes) + 3 * n_points) == "LAPACK"
    factor = dense_memory(n) if dense else factor_memory(cloud.n_nodes, support_radius_factor)
    space = 2 * 8 * n * _SURFACE_SOLVES * n_modes
    needed = (
        0.5 * 2**30
        + stiffness
        + max(4 * stiffness, factor + max(space, residual_memory(n, n_points, n_modes)))
    )
    present = machine_memory()
    if needed > present:
        raise MemoryError(
            f"the surface model of {cloud.n_nodes:,} nodes, {n_points:,} of them on the surface, needs about "
            f"{needed / 2**30:.1f} GiB, this machine has {present / 2**30:.1f}: expected a larger surface.spacing_m or a "
            "smaller surface.working_area"
        )
    return needed


def _shapes(touched: Touched, modes: LowestModes) -> Array:
    """(n_points, 3, n_modes), zero at held points."""
    values = (on_components(touched.rows) @ modes.parameters).reshape(len(touched.nodes), 3, -1)
    shapes = np.zeros(values.shape)
    shapes[touched.free] = values[touched.free]
    return shapes


def _accuracy(
    config: Config,
    cloud: NodeCloud,
    touched: Touched,
    flexible: _Flexible,
    met: evidence.Footprints,
    shift: float,
) -> SurfaceAccuracy:
    """The evidence. Raises ValueError where the model can give out energy."""
    wanted, prony = config.surface, config.material.material().prony
    sampled, free = met.of(flexible.sample), met.of(touched.free)
    static = evidence.static_errors(sampled, flexible.exact.static)
    errors = evidence.force_errors(
        sampled, flexible.exact.compliance, prony, evidence.band_frequencies(wanted.band_hz)
    )
    margins = [
        evidence.passivity_margin(free, prony, wanted.period_s),
        evidence.passivity_margin_sampled(free, prony, wanted.period_s),
    ]
    if min(margins) < -_ROUND_OFF:
        raise ValueError(
            f"the surface model can give out energy: passivity margin {min(margins):.1e}, expected at least 0"
        )
    points, normals = cloud.points[touched.nodes], cloud.normals[touched.nodes][touched.free]
    error_map = np.zeros(len(points), dtype=np.float32)
    _, nearest = cKDTree(points[flexible.sample]).query(points[touched.free])
    error_map[touched.free] = errors[nearest]
    return SurfaceAccuracy(
        contact_radius_m=contact_radius_m(min(tool.radius_m for tool in config.tool)),
        error_static=float(static.max()),
        error_static_median=float(np.median(static)),
        error_in_band=float(errors.max()),
        error_in_band_median=float(np.median(errors)),
        error_in_working_area=float(errors[flexible.working].max()),
        passivity_margin=margins[0],
        passivity_margin_sampled=margins[1],
        largest_stiffness_n_per_m=evidence.largest_stiffness(free, normals, prony, wanted.period_s),
        residual_shift_m_per_n=shift,
        resolved_frequency_hz=resolved_frequency_hz(cloud, config.material.material()),
        error_map=error_map,
    )
