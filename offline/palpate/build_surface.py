"""From a scene with tools to a surface model: cloud, body held at its supports, modes, residual flexibility, evidence."""

from __future__ import annotations

from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

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
from palpate.modes.body_modes import factor_memory, stiffness_memory
from palpate.modes.held_body import HeldBody, hold
from palpate.modes.lanczos import LowestModes, lowest_modes
from palpate.progress import NO_PROGRESS, Progress
from palpate.scene.plausibility import plausibility
from palpate.scene.schema import Config, canonical_text, fingerprint
from palpate.scene_cloud import build_cloud, fixed_nodes, in_working_area, tool_shapes
from palpate.surface_model import evidence
from palpate.surface_model.footprint import (
    FEWEST_POINTS,
    contact_radius_m,
    footprints,
    on_components,
    points_in_contact,
)
from palpate.surface_model.mode_count import Sample, enough_modes, guessed_modes, sample_footprints
from palpate.surface_model.residual import residual, residual_memory
from palpate.surface_model.rounding import rounded
from palpate.thin_parts import thin_working_area

Array = NDArray[np.float64]

_ROUND_OFF = 1e-6
"""Of a passivity margin: the shapes and the residual are stored in single precision."""

_SURFACE_SOLVES = 2.5
"""Vectors that the lowest modes take, for each mode."""


@dataclass(frozen=True)
class _Touched:
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


def build_surface_model(config: Config, folder: Path, progress: Progress = NO_PROGRESS) -> SurfaceModel:
    """Build and judge a scene with tools; files in it are relative to `folder`.

    Raises FileNotFoundError or ValueError (ConfigError, SurfaceError, NodeSurfaceError, RegionError, SupportError) with
    what is wrong; LinAlgError where the supports do not hold the body; MemoryError where it does not fit into this machine.
    """
    digest, material = fingerprint(config, folder), config.material.material()
    progress("node cloud")
    cloud = with_inclusions(config, folder, build_cloud(config, folder, progress), progress.warn)
    for text in plausibility(config, float(np.max(np.ptp(cloud.points, axis=0)))):
        progress.warn(text)
    tools, fixed = tool_shapes(config, cloud), fixed_nodes(config, cloud)
    _warn_of_small_tools(config, cloud, progress)
    progress.note(
        f"{cloud.n_nodes:,} nodes, {int(cloud.boundary.sum()):,} on the surface, {len(fixed)} fixed"
    )

    guess = config.surface.modes or guessed_modes(
        material,
        enclosed_volume(cloud.surface),
        float(cloud.areas.sum()),
        config.surface.band_hz[1],
        config.surface.tolerance,
    )
    support = config.discretization.support_radius
    needed = _require_memory(cloud, guess, support)
    progress("assembly, conservative")
    body = conservative.assemble(cloud, material, fixed, [], support)
    touched = _touched(config, cloud, fixed, body.basis.value)
    if thin := thin_working_area(config, cloud, touched.nodes[touched.working]):
        progress.warn(thin)
    n_rows, n_solves = body.stiffness.shape[0], int(_SURFACE_SOLVES * guess) + 3 * len(touched.nodes)
    progress(f"factor, {solver_name(n_rows, n_solves)}")
    progress.note(f"memory needed about {needed / 2**30:.1f} GiB")
    held = hold(body, fixed, n_solves=n_solves)
    progress("modes")
    sample = sample_footprints(touched.rows, touched.footprints, touched.working)
    frequencies = evidence.band_frequencies(config.surface.band_hz)
    if config.surface.modes is not None:
        modes = lowest_modes(held, config.surface.modes)
    else:
        modes = enough_modes(held, sample, material, frequencies, config.surface.tolerance, guess, progress)
    highest = float(np.sqrt(modes.squared_frequencies[-1]) / (2 * np.pi))
    progress.note(f"{len(modes.squared_frequencies):,} modes up to {highest:.3g} Hz")

    progress("residual flexibility")
    left = residual(held, modes, touched.rows, touched.free, touched.footprints, progress)
    single, shift = rounded(left.compliance, touched.free)
    progress.note(f"{len(touched.free):,} points, shift {shift:.1g} m/N")
    progress("evidence")
    shapes = _shapes(touched, modes)
    met = evidence.averaged(shapes, single, left.inertia, modes.squared_frequencies, touched.footprints)
    accuracy = _accuracy(config, cloud, touched, held, sample, met, shift)
    progress.note(f"force error in band {100 * accuracy.error_in_working_area:.2g} % in the working area")
    if accuracy.error_in_working_area > config.surface.tolerance and config.surface.modes is None:
        progress.warn(
            f"at the worst point the force is wrong by up to {100 * accuracy.error_in_working_area:.2g} %, surface.tolerance is "
            f"{100 * config.surface.tolerance:.2g} %: it was kept at a sample of the points"
        )
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
        squared_frequencies=modes.squared_frequencies,
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


def _warn_of_small_tools(config: Config, cloud: NodeCloud, progress: Progress) -> None:
    """Warn of tools that touch too few points for their radius where the points are as far apart as anywhere they work."""
    working = cloud.boundary & in_working_area(config, cloud.points)
    spacing = float(cloud.spacing[working].max())
    for tool in config.tool:
        count = points_in_contact(tool.radius_m, spacing)
        if count < FEWEST_POINTS:
            fit = tool.radius_m * np.sqrt(points_in_contact(1.0, 1.0) / FEWEST_POINTS)
            progress.warn(
                f"tool {tool.name!r}: radius_m = {tool.radius_m:g} touches about {count:.2g} points {spacing:.2g} m apart when "
                f"pressed in by half of it, its force depends on where between the points it presses; expected "
                f"{FEWEST_POINTS:g} or more, as with a spacing_m of {fit:.2g}"
            )


def _touched(config: Config, cloud: NodeCloud, fixed: NDArray[np.int64], value: csr_array) -> _Touched:
    """Raises ValueError where all points of the working areas are held."""
    nodes = np.flatnonzero(cloud.boundary)
    free = np.flatnonzero(~np.isin(nodes, fixed))
    points = cloud.points[nodes]
    working = free[in_working_area(config, points[free])]
    if not len(working):
        raise ValueError("surface.working_area: all of its points are fixed: expected some that can move")
    radius = min(tool.radius_m for tool in config.tool)
    return _Touched(
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


def _shapes(touched: _Touched, modes: LowestModes) -> NDArray[np.float32]:
    """(n_points, 3, n_modes), zero at held points."""
    values = (on_components(touched.rows) @ modes.parameters).reshape(len(touched.nodes), 3, -1)
    shapes = np.zeros(values.shape, dtype=np.float32)
    shapes[touched.free] = values[touched.free]
    return shapes


def _accuracy(
    config: Config,
    cloud: NodeCloud,
    touched: _Touched,
    held: HeldBody,
    sample: Sample,
    met: evidence.Footprints,
    shift: float,
) -> SurfaceAccuracy:
    """The evidence. Raises ValueError where the model can give out energy."""
    material, wanted = config.material.material(), config.surface
    prony, period_s = material.prony, wanted.period_s
    exact = np.einsum(
        "npi,npj->pij",
        sample.loads.reshape(len(sample.loads), -1, 3),
        held.solve(sample.loads).reshape(len(sample.loads), -1, 3),
    )
    static = evidence.static_errors(met, sample.points, exact)
    free = met.of(touched.free)
    errors = np.zeros(len(touched.nodes), dtype=np.float32)
    errors[touched.free] = evidence.error_bound(free, prony, evidence.band_frequencies(wanted.band_hz))
    margins = [
        evidence.passivity_margin(free, prony, period_s),
        evidence.passivity_margin_sampled(free, prony, period_s),
    ]
    if min(margins) < -_ROUND_OFF:
        raise ValueError(
            f"the surface model can give out energy: passivity margin {min(margins):.1e}, expected at least 0"
        )
    normals = cloud.normals[touched.nodes][touched.free]
    return SurfaceAccuracy(
        contact_radius_m=contact_radius_m(min(tool.radius_m for tool in config.tool)),
        error_static=float(static.max()),
        error_static_median=float(np.median(static)),
        error_in_band=float(errors.max()),
        error_in_band_median=float(np.median(errors[touched.free])),
        error_in_working_area=float(errors[touched.working].max()),
        passivity_margin=margins[0],
        passivity_margin_sampled=margins[1],
        largest_stiffness_n_per_m=evidence.largest_stiffness(free, normals, prony, period_s),
        residual_shift_m_per_n=shift,
        resolved_frequency_hz=resolved_frequency_hz(cloud, material),
        error_map=errors,
    )
