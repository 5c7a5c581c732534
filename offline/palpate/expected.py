"""What a build will take, before anything dear is computed: nodes, and time and memory of each stage."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from scipy.integrate import quad

from palpate.factorization import solver_name
from palpate.geometry.measures import enclosed_volume, triangle_normals
from palpate.geometry.spacing import Refinement
from palpate.geometry.surface import load_surface
from palpate.inclusions import finer_around_inclusions
from palpate.memory import machine_memory
from palpate.modes.body_modes import STEPS_EXPECTED, by_ritz, factor_memory, stiffness_memory
from palpate.modes.dense import dense_memory
from palpate.scene.schema import BallGeometry, BoxGeometry, Config, SurfaceGeometry
from palpate.scene_cloud import refinements


@dataclass(frozen=True)
class BodySize:
    """What time and memory depend on. Nodes of a surface's inside are estimated, to some 5 %."""

    n_nodes: int
    n_contacts: int
    symmetric: bool
    support_radius: float
    on_surface: bool


@dataclass(frozen=True)
class ExpectedStage:
    """processor seconds of a core of 2.5 GHz; peak_bytes of the process."""

    name: str
    seconds: float
    peak_bytes: float


def expected_size(config: Config, folder: Path) -> BodySize:
    """The size of a scene's body; files are relative to `folder`. Raises FileNotFoundError, SurfaceError."""
    geometry = config.geometry
    match geometry:
        case BoxGeometry(counts=counts):
            nodes = float(math.prod(counts))
        case BallGeometry(radius_m=radius, spacing_m=spacing):
            nodes = 4 / 3 * math.pi * (radius / spacing + 0.5) ** 3
        case SurfaceGeometry():
            nodes = _nodes_inside(config, geometry, folder)
    discretization = config.discretization
    return BodySize(
        n_nodes=round(nodes),
        n_contacts=len(config.contact),
        symmetric=discretization.method == "conservative",
        support_radius=discretization.support_radius,
        on_surface=isinstance(geometry, SurfaceGeometry),
    )


def _nodes_inside(config: Config, geometry: SurfaceGeometry, folder: Path) -> float:
    """The integral of one node per spacing³ over the body, and of half a node per spacing² over its surface.

    The spacing grows away from a refined contact, about which the body is taken for a half-space, and on both sides of the
    surface of a refined inclusion, which is taken to be flat.
    """
    surface = load_surface(folder / geometry.file, geometry.file_unit).surface
    h = geometry.spacing_m
    nodes = enclosed_volume(surface) / h**3 + float(triangle_normals(surface)[1].sum()) / h**2 / 2
    for patch in refinements(config):
        reach = patch.radius_m + (h - patch.spacing_m) / patch.growth

        def more(r: float, patch: Refinement = patch) -> float:
            fine = patch.spacing_m + patch.growth * max(0.0, r - patch.radius_m)
            return 2 * math.pi * r**2 * (fine**-3 - h**-3) + math.pi * r * (fine**-2 - h**-2)

        if reach > 0:
            nodes += quad(more, 0, reach, points=[patch.radius_m])[0]
    for part in finer_around_inclusions(config, folder):
        finest, growth = part.spacing_m, part.growth
        nodes += 2 * part.area_m2 * ((finest**-2 - h**-2) / 2 - (h - finest) / h**3) / growth
    return nodes


def require_memory(size: BodySize) -> None:
    """Raise MemoryError where the machine has less memory than the build needs."""
    needed, present = max(stage.peak_bytes for stage in expected_stages(size)), machine_memory()
    if needed > present:
        kind = "Ritz" if by_ritz(size.n_nodes, size.symmetric) else "all"
        raise MemoryError(
            f"{kind} modes of about {size.n_nodes:,} nodes need about {needed / 2**30:.1f} GiB, this machine has "
            f"{present / 2**30:.1f}: use a coarser cloud, graded towards the contact patches"
        )


_PROGRAM = 0.25 * 2**30
"""Bytes of the interpreter and the libraries."""

_BESIDE = 0.45 * 2**30
"""Bytes that the direct solvers' libraries, the cloud and the basis hold beside the matrices: from the peaks of 15,364 and
31,648 nodes with MKL PARDISO, 2.73 and 6.36 GiB."""

_UPPER_TRIANGLE = 0.35
"""Size of the triangle that MKL PARDISO gets in blocks, over the stiffness matrix, whose indices are stored for each entry."""


def expected_stages(size: BodySize) -> list[ExpectedStage]:
    """In order, by what `benchmarks/organ_scale.py` has measured up to 31,648 nodes (docs/validation.md)."""
    n, support = size.n_nodes, size.support_radius
    stiffness = stiffness_memory(n, support)
    cloud = ExpectedStage("node cloud", 1.1e-3 * n if size.on_surface else 0.0, _PROGRAM + 8e4 * n)
    seconds = 1.2e-3 * n * (support / 2.2) ** 4
    assembly = ExpectedStage("assembly", seconds, _PROGRAM + max(8e4 * n, 3 * stiffness))
    if not by_ritz(n, size.symmetric):
        needed = _PROGRAM + dense_memory(n, n, 3, size.symmetric)
        return [cloud, assembly, ExpectedStage("modes, all", 1e-8 * n**3, needed)]
    solver = solver_name()
    vectors = 2 * 8 * 9 * n * STEPS_EXPECTED * size.n_contacts
    matrices = (1 + _UPPER_TRIANGLE) * stiffness + factor_memory(n, support)
    needed = _PROGRAM + _BESIDE + matrices + vectors
    # Measured 38, 83, 202 and 552 s from 4,174 to 31,648 nodes, and without MKL 397 s at 15,368.
    seconds = 552 * (n / 31_648) ** 1.35 * (1 if solver == "MKL PARDISO" else 2.0)
    return [cloud, assembly, ExpectedStage(f"modes, Ritz, {solver}", seconds, needed)]


def expectation_text(config: Config, folder: Path) -> str:
    """What `palpate build --dry-run` prints for a scene with contacts. Raises as `expected_size`."""
    size = expected_size(config, folder)
    stages = expected_stages(size)
    lines = [f"{config.name}: about {size.n_nodes:,} nodes, {3 * size.n_nodes:,} unknowns", ""]
    lines += [f"{'stage':28} {'cpu s':>8} {'peak GiB':>9}"]
    lines += [f"{s.name:28} {s.seconds:8.0f} {s.peak_bytes / 2**30:9.1f}" for s in stages]
    most = max(s.peak_bytes for s in stages)
    lines += [
        f"{'all':28} {sum(s.seconds for s in stages):8.0f} {most / 2**30:9.1f}",
        "",
        f"Processor seconds of a core of 2.5 GHz; two cores, when quiet, take somewhat more than half. "
        f"The first build also compiles, for some 40 s. This machine has {machine_memory() / 2**30:.1f} GiB"
        + ("." if most <= machine_memory() else ": too little, use a coarser cloud."),
    ]
    return "\n".join(lines)


def expectation_json(config: Config, folder: Path) -> dict[str, Any]:
    """The same with plain numbers, lists and names; docs/commands.md lists the fields."""
    size = expected_size(config, folder)
    return {
        "name": config.name,
        "n_nodes": size.n_nodes,
        "stages": [asdict(stage) for stage in expected_stages(size)],
        "machine_memory_bytes": machine_memory(),
    }
