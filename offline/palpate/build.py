"""From a scene to a model: cloud, assembled body, modes, linear system, reduction, and what the model file holds."""

from __future__ import annotations

from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from palpate.discretization import collocation, conservative
from palpate.discretization.assembled_body import AssembledBody
from palpate.discretization.resolution import resolved_frequency_hz
from palpate.expected import expected_size, require_memory
from palpate.factorization import solver_name
from palpate.geometry.cloud import NodeCloud
from palpate.geometry.regions import ContactPatch
from palpate.inclusions import with_inclusions
from palpate.lti.block_form import to_block_form
from palpate.lti.errors import ReductionError
from palpate.lti.pole_residue import PoleResidueSystem
from palpate.lti.sampling import Sampling
from palpate.lti.viscoelastic import viscoelastic_system
from palpate.model_file import Contact, ReducedModel, Surface
from palpate.modes.body_modes import by_ritz, ritz_body_modes
from palpate.modes.dense import elastic_modes
from palpate.modes.elastic_modes import ElasticModes
from palpate.modes.ritz import StaticSpace
from palpate.progress import NO_PROGRESS, Progress
from palpate.reduction.accuracy import measure, refuse_meaningless
from palpate.reduction.methods import Reduction, reduce
from palpate.reduction.passive import RitzSubspace, passive
from palpate.reduction.surface import fit_surface_output
from palpate.scene.material import Material
from palpate.scene.plausibility import plausibility
from palpate.scene.schema import Config, ReductionTable, canonical_text, fingerprint
from palpate.scene_cloud import cloud_and_warnings, contact_patches, fixed_nodes, shown_surface
from palpate.stage_cache import NO_CACHE, StageCache
from palpate.stage_keys import StageKeys, stage_keys
from palpate.thin_parts import thin_patch

Array = NDArray[np.float64]

_ASSEMBLE = {"conservative": conservative.assemble, "collocation": collocation.assemble}


@dataclass(frozen=True)
class ShownSurface:
    """The surface that a client draws, and what its displacement is made of.

    vertices (n, 3), m, triangles (n_triangles, 3)
    shapes        (3 n, n_modes), the displacements of the modes
    patch_shapes  (3 n, n_inputs), those of the patch displacements
    """

    vertices: Array
    triangles: NDArray[np.int32]
    shapes: NDArray[np.float64] | NDArray[np.complex128]
    patch_shapes: Array


@dataclass(frozen=True)
class FullModel:
    """The whole body before reduction.

    patches  of the contacts, in the order of the inputs
    body     assembled in unit constants, E = 1 Pa and rho = 1 kg/m³; all that follows is in the material's
    change_over_last_vectors  of the force in the band, by the last 60 Ritz vectors of a patch, relative; 0 for all modes
    system   from patch displacement (m) to reaction force (N), exact in time for the assembled body
    """

    cloud: NodeCloud
    material: Material
    patches: tuple[ContactPatch, ...]
    body: AssembledBody
    modes: ElasticModes
    change_over_last_vectors: float
    system: PoleResidueSystem


def build_model(
    config: Config, folder: Path, progress: Progress = NO_PROGRESS, cache: StageCache = NO_CACHE
) -> ReducedModel:
    """Build, reduce and judge the scene; files in it are relative to `folder`.

    cache  of the node cloud, the assembled body and its modes: what is in it is not computed again

    Raises FileNotFoundError or ValueError (ConfigError, SurfaceError, RegionError, SupportError, ReductionError) with
    what is wrong; MemoryError when the body has too many nodes for this machine.
    """
    digest = fingerprint(config, folder)
    full = build_full_model(config, folder, progress, cache)
    reduction, running, surface, surface_error = _reduce_with_surface(full, config, progress)
    discrete = to_block_form(running)
    progress("accuracy")
    accuracy = measure(
        full.system,
        reduction,
        running,
        period_s=config.reduction.period_s,
        band_hz=config.reduction.band_hz,
        error_surface_in_band=surface_error,
        resolved_frequency_hz=resolved_frequency_hz(full.cloud, full.material),
        change_over_last_vectors=full.change_over_last_vectors,
    )
    progress.note(f"force error in band {100 * accuracy.error_in_band:.2g} %")
    refuse_meaningless(accuracy, config.reduction.method)
    return ReducedModel(
        name=config.name,
        method=config.reduction.method,
        period_s=config.reduction.period_s,
        n_nodes=full.cloud.n_nodes,
        n_states_full=full.system.n_states,
        contacts=tuple(_contact(t.name, p) for t, p in zip(config.contact, full.patches, strict=True)),
        continuous=to_block_form(reduction.system),
        discrete=discrete,
        full=full.system,
        static_stiffness=full.modes.static_stiffness,
        surface=surface,
        accuracy=accuracy,
        config=canonical_text(config),
        config_sha256=digest,
        built_with=f"palpate {version('palpate')}",
    )


def build_full_model(
    config: Config, folder: Path, progress: Progress = NO_PROGRESS, cache: StageCache = NO_CACHE
) -> FullModel:
    """Everything up to the reduction. Arguments and errors as `build_model`."""
    material = config.material.material()
    keys = stage_keys(config, folder)
    require_memory(expected_size(config, folder))
    cloud, fixed = node_cloud(config, folder, keys, progress, cache)
    patches = contact_patches(config, cloud, fixed)
    progress.note(
        f"{cloud.n_nodes:,} nodes, {int(cloud.boundary.sum()):,} on the surface, {len(fixed)} fixed, "
        f"{' + '.join(str(len(p.nodes)) for p in patches)} in contact"
    )
    for table, patch in zip(config.contact, patches, strict=True):
        if thin := thin_patch(table.name, patch, cloud):
            progress.warn(thin)

    progress(f"assembly, {config.discretization.method}")
    assemble = _ASSEMBLE[config.discretization.method]
    nodes, radius = [p.nodes for p in patches], config.discretization.support_radius
    body = cache.kept("body", keys.body, lambda: assemble(cloud, material.unit, fixed, nodes, radius))
    progress.note(f"{body.stiffness.nnz / body.stiffness.shape[0]:.0f} nonzeros a row")

    progress(_modes_stage(body))
    modes, change = _modes(body, config, keys, cache)
    frequencies = np.sqrt(np.abs(modes.squared_frequencies)) / (2 * np.pi)
    progress.note(f"{modes.n_modes:,} modes from {frequencies.min():.3g} to {frequencies.max():.3g} Hz")

    progress("viscoelastic system")
    system = viscoelastic_system(modes, material.prony)
    progress.note(f"{system.n_states:,} states")
    return FullModel(cloud, material, patches, body, modes, change, system)


def _modes(
    body: AssembledBody, config: Config, keys: StageKeys, cache: StageCache
) -> tuple[ElasticModes, float]:
    """The modes in the material's constants, and the change of the force by the last of them."""
    material = config.material.material()
    if not by_ritz(body.n_nodes, body.symmetric):
        unit = cache.kept("modes", keys.modes, lambda: elastic_modes(body))
        return unit.scaled(material.youngs_modulus_pa, material.density_kg_per_m3), 0.0
    with cache.alone("modes", keys.modes):
        known: StaticSpace | None = cache.load("modes", keys.modes)
        found = ritz_body_modes(body, material, config.reduction.band_hz[1], known)
        if found.space is not known:
            cache.store("modes", keys.modes, found.space)
    return found.modes, found.change


def node_cloud(
    config: Config, folder: Path, keys: StageKeys, progress: Progress, cache: StageCache
) -> tuple[NodeCloud, NDArray[np.int64]]:
    """The nodes with the stiffness of their inclusions, and those that are fixed. Errors as `build_model`."""
    progress("node cloud")
    cloud, warnings = cache.kept("cloud", keys.cloud, lambda: cloud_and_warnings(config, folder))
    for text in (*warnings, *plausibility(config, float(np.max(np.ptp(cloud.points, axis=0))))):
        progress.warn(text)
    cloud = with_inclusions(config, folder, cloud, progress.warn)
    return cloud, fixed_nodes(config, cloud)


def _modes_stage(body: AssembledBody) -> str:
    """The name of the stage, with the direct solver and what the other one would save."""
    if not by_ritz(body.n_nodes, body.symmetric):
        return "modes, all"
    name = solver_name()
    better = "" if name == "MKL PARDISO" else "; palpate[pardiso] takes about 0.6 of the time and memory"
    return f"modes, Ritz, {name}{better}"


def _reduce_with_surface(
    full: FullModel, config: Config, progress: Progress
) -> tuple[Reduction, PoleResidueSystem, Surface, float]:
    """The reduced system, the same sampled, its surface and the surface's error.

    Where a tolerance chooses the order, it is tightened until the surface keeps to its own, or the method has no more.
    """
    wanted = config.reduction
    progress("surface")
    shown = _shown(full, config)
    progress.note(f"{len(shown.vertices):,} vertices")
    subspace = None
    if wanted.method == "passive":
        progress("Krylov subspace")
        subspace = RitzSubspace.of(full.modes)
    reduction, running = _reduce(full, subspace, wanted, wanted.tolerance, progress)
    surface, error = _surface(full, shown, running, wanted, progress)
    tolerance = wanted.tolerance
    while tolerance is not None and error > wanted.tolerance_surface:
        tolerance /= 3
        try:
            reduction, running = _reduce(full, subspace, wanted, tolerance, progress)
        except ReductionError:
            progress.warn(
                f"the surface is wrong by {100 * error:.2g} %, reduction.tolerance_surface is "
                f"{100 * wanted.tolerance_surface:.2g} %: {wanted.method} comes no nearer"
            )
            break
        surface, error = _surface(full, shown, running, wanted, progress)
    return reduction, running, surface, error


def _reduce(
    full: FullModel,
    subspace: RitzSubspace | None,
    wanted: ReductionTable,
    tolerance: float | None,
    progress: Progress,
) -> tuple[Reduction, PoleResidueSystem]:
    """The reduced system, and the same sampled. The subspace is that of the method "passive"."""
    progress(f"reduction, {wanted.method}")
    sampling = Sampling(wanted.period_s, wanted.sampling, wanted.band_hz)
    if wanted.method == "passive":
        assert subspace is not None
        reduction = passive(
            full.system, subspace, full.material.prony, sampling, order=wanted.order, tolerance=tolerance
        )
    else:
        reduction = reduce(
            full.system,
            wanted.method,
            order=wanted.order,
            tolerance=tolerance,
            band_hz=wanted.band_hz,
            response=sampling.response,
        )
    progress.note(f"{full.system.n_states:,} → {reduction.order} states")
    return reduction, sampling.sample(reduction.system)


def _shown(full: FullModel, config: Config) -> ShownSurface:
    shown, basis = shown_surface(config, full.cloud), full.body.basis
    return ShownSurface(
        shown.vertices,
        shown.triangles,
        basis.values_at(shown.vertices, full.modes.parameters),
        basis.values_at(shown.vertices, full.modes.patch_parameters),
    )


def _surface(
    full: FullModel,
    shown: ShownSurface,
    running: PoleResidueSystem,
    wanted: ReductionTable,
    progress: Progress,
) -> tuple[Surface, float]:
    """The surface with its read-out of the sampled model, and its error in the band, a fraction."""
    progress("surface read-out")
    fitted = fit_surface_output(
        full.modes,
        full.material.prony,
        shown.shapes,
        shown.patch_shapes,
        to_block_form(running),
        period_s=wanted.period_s,
        band_hz=wanted.band_hz,
    )
    progress.note(f"error in band {100 * fitted.error_in_band:.2g} %")
    surface = Surface(shown.vertices, shown.triangles, fitted.output, fitted.feedthrough)
    return surface, fitted.error_in_band


def _contact(name: str, patch: ContactPatch) -> Contact:
    x, y, z = (float(v) for v in patch.center_m)
    nx, ny, nz = (float(v) for v in patch.normal)
    return Contact(name, (x, y, z), (nx, ny, nz), patch.radius_m, len(patch.nodes))
