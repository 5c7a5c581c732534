"""Tip stiffness of the shipped liver: palpate beside quadratic tetrahedra of scikit-fem on the same surface.

    python benchmarks/finite_elements_organ.py [--edges-mm 40 24 16 12 8] [--spacings-mm 16 12 8 6.2] [--without-mkl]

The surface, the held region, the material at rest and the bonded tip (5 mm radius, no rotation) are those of
`configs/liver-coarse.toml`. fTetWild (package pytetwild, with pyvista) fills the surface with tetrahedra of the given edge; those
near the rims of the tip and of the held region are bisected until their longest edge is at most a share of their distance
from the rim, and nodes next to the rims are moved onto them. palpate's spacing on the patch is 0.15 of that of the cloud, as
in the scene. The reference is the finest finite element mesh.

Both solve with the same direct solver, in one run; each body has a process of its own. Processor seconds of the mesh (the
cloud), of assembly and of factorizing and solving, and the peak memory of the process; areas of what the held region and the
tip hold, because they decide, too.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import logging
import platform
import resource
import subprocess
import sys
import tempfile
import time
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.factorization import factorize, pardiso, solver_name
from palpate.geometry.sampling import closest_point
from palpate.geometry.surface import load_surface
from palpate.scene.material import Material
from palpate.scene.schema import Config
from palpate.scene_cloud import build_cloud, contact_patches, fixed_nodes

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

CONFIGS = Path(__file__).parents[1] / "configs"
PATCH_SPACING = 0.15
"""Spacing on the patch over that of the cloud: 1.8 mm at 12 mm."""

AT_TIP, AT_SUPPORT = 1 / 12, 1 / 2
"""Longest edges at the rims of the tip and of the held region over the mesh's edge."""

SLOPE = 1.2
"""Longest edge of a tetrahedron over the distance of its nearer end from a rim."""


def scene(spacing_mm: float) -> Config:
    """The scene with the spacings of cloud and patch changed together."""
    table = tomllib.loads((CONFIGS / "liver-coarse.toml").read_text(encoding="utf-8"))
    table["geometry"]["spacing_m"] = spacing_mm / 1000
    table["contact"][0]["spacing_m"] = PATCH_SPACING * spacing_mm / 1000
    return Config.model_validate(table)


class Clock:
    """Processor seconds of the stages."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._last = time.process_time()

    def __call__(self, stage: str) -> None:
        now = time.process_time()
        self.seconds[stage], self._last = now - self._last, now


def of_palpate(spacing_mm: float) -> dict[str, Any]:
    """The row of a node cloud."""
    from palpate.discretization import conservative
    from palpate.modes.held_body import hold

    clock, config = Clock(), scene(spacing_mm)
    cloud = build_cloud(config, CONFIGS)
    fixed = fixed_nodes(config, cloud)
    (patch,) = contact_patches(config, cloud, fixed)
    clock("mesh")
    body = conservative.assemble(cloud, config.material.material(), fixed, [patch.nodes])
    clock("assembly")
    rigid: Array = np.kron(body.basis.parameters(body.supports.tips.toarray()), np.eye(3)).astype(float)
    field = rigid - hold(body, body.supports.prescribed).solve(body.stiffness @ rigid)
    stiffness = field.T @ (body.stiffness @ field)
    clock("solution")
    return {
        "unknowns": 3 * cloud.n_nodes,
        "volume": float(cloud.volumes.sum()),
        "held": float(cloud.areas[fixed].sum()),
        "tip": float(cloud.areas[patch.nodes].sum()),
        "stiffness": stiffness.tolist(),
        **clock.seconds,
    }


def of_finite_elements(edge_mm: float) -> dict[str, Any]:
    """The row of a mesh."""
    import skfem
    from scipy.sparse import csr_array
    from skfem.models.elasticity import linear_elasticity

    logging.getLogger("skfem").setLevel(logging.ERROR)  # it warns of its own meshes' memory order
    clock, config = Clock(), scene(12.0)
    (contact,) = config.contact
    (plane,) = config.fixed
    center, *_ = tip(config)
    height = Height(np.array(plane.point_m), np.array(plane.normal))  # type: ignore[union-attr]
    mesh = meshed(config, edge_mm / 1000, Ball(center, contact.radius_m), height)
    clock("mesh")

    material: Material = config.material.material()
    basis = skfem.Basis(mesh, skfem.ElementVector(skfem.ElementTetP2()), intorder=2)
    weak_form = linear_elasticity(material.lame_lambda_pa, material.shear_modulus_pa)
    stiffness = csr_array(skfem.asm(weak_form, basis))
    facets = mesh.boundary_facets()
    corners = mesh.p[:, mesh.facets[:, facets]]  # (3, 3 corners, n)
    sides = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0], axis=0)
    areas = np.linalg.norm(sides, axis=0) / 2
    in_tip = np.all(Ball(center, contact.radius_m)(corners) <= 1e-9, axis=0)
    in_held = np.all(height(corners) <= 1e-9, axis=0)
    held = basis.get_dofs(facets[in_held]).all()
    rigid = np.zeros((basis.N, 3))
    for k in range(3):
        rigid[basis.get_dofs(facets[in_tip]).all([f"u^{k + 1}"]), k] = 1.0
    free = np.setdiff1d(np.flatnonzero(~rigid.any(axis=1)), held)
    clock("assembly")

    load = stiffness @ rigid
    places = basis.doflocs[:, free[::3]].T  # the components of a node follow each other
    factor = factorize(csr_array(stiffness[free][:, free]), points=places)
    field = rigid.copy()
    field[free] = -factor.solve(load[free])
    clock("solution")
    return {
        "unknowns": len(free),
        "volume": float(volumes(mesh).sum()),
        "held": float(areas[in_held].sum()),
        "tip": float(areas[in_tip].sum()),
        "stiffness": (field.T @ (stiffness @ field)).tolist(),
        **clock.seconds,
    }


def tip(config: Config) -> tuple[Array, Any, Array]:
    """Center of the patch on the surface, the surface, and its normal there."""
    surface = load_surface(CONFIGS / config.geometry.file).surface  # type: ignore[union-attr]
    (contact,) = config.contact
    (center,), (triangle,) = closest_point(np.array([contact.point_m]), surface.vertices, surface.triangles)
    a, b, c = surface.vertices[surface.triangles[triangle]]
    across = np.cross(b - a, c - a)
    return center, surface, across / np.linalg.norm(across)


# Regions: signed distances of points (3, ...), m, negative inside


class Ball:
    def __init__(self, center: Array, radius: float) -> None:
        self.center, self.radius = center, radius

    def __call__(self, points: Array) -> Array:
        return np.linalg.norm(np.moveaxis(points, 0, -1) - self.center, axis=-1) - self.radius


class Height:
    def __init__(self, point: Array, normal: Array) -> None:
        self.point, self.normal = point, normal / np.linalg.norm(normal)

    def __call__(self, points: Array) -> Array:
        return -((np.moveaxis(points, 0, -1) - self.point) @ self.normal)


# The mesh


def meshed(config: Config, edge_m: float, ball: Ball, height: Height) -> Any:
    """Tetrahedra of the organ, fine at the rims of tip and held region, with nodes on them."""
    import pytetwild
    import skfem

    _, surface, _ = tip(config)
    triangles = surface.triangles.astype(np.int32)
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):  # where it leaves a file
        points, tetrahedra = pytetwild.tetrahedralize(
            surface.vertices, triangles, edge_length_abs=edge_m, num_threads=1
        )
    mesh = skfem.MeshTet(np.ascontiguousarray(points.T), np.ascontiguousarray(tetrahedra.T.astype(np.int64)))
    mesh = refined(mesh, surface, ball, AT_TIP * edge_m)
    mesh = refined(mesh, surface, height, AT_SUPPORT * edge_m)
    return on_rim(on_rim(mesh, height), ball)


def refined(mesh: Any, surface: Any, region: Any, finest_m: float) -> Any:
    """Bisected until every tetrahedron's longest edge suits its distance from the region's rim."""
    for _ in range(60):
        corners = mesh.p[:, mesh.t]  # (3, 4, n)
        middle = corners.mean(axis=1)
        foot, _ = closest_point(middle.T, surface.vertices, surface.triangles)
        # The rim lies on the surface where the region's distance is zero.
        away = np.hypot(region(foot.T), np.linalg.norm(middle - foot.T, axis=0))
        longest = longest_edges(corners)
        large = np.flatnonzero(longest > np.maximum(finest_m, SLOPE * (away - longest / 2)))
        if not len(large):
            break
        mesh = mesh.refined(large)
    return mesh


def longest_edges(corners: Array) -> Array:
    """(n,): of tetrahedra with corners (3, 4, n)."""
    first, second = np.triu_indices(4, 1)
    return np.linalg.norm(corners[:, first] - corners[:, second], axis=0).max(axis=0)


def on_rim(mesh: Any, region: Any) -> Any:
    """Of every surface edge that the rim cuts, the nearer end moved along the edge onto the rim, where no cell turns over."""
    p = mesh.p.copy()
    on_surface = mesh.facets[:, mesh.boundary_facets()]
    edges = np.unique(
        np.sort(np.hstack([on_surface[[0, 1]], on_surface[[1, 2]], on_surface[[0, 2]]]), axis=0), axis=1
    )
    value = region(p)
    a, b = edges[:, value[edges[0]] * value[edges[1]] < 0]
    share, step = np.full(len(a), 0.5), 0.25
    for _ in range(50):  # bisection
        share += np.where(region(p[:, a] + share * (p[:, b] - p[:, a])) * value[a] > 0, step, -step)
        step /= 2
    nearer = np.where(share < 0.5, a, b)
    target = p[:, a] + share * (p[:, b] - p[:, a])
    sign = np.sign(signed_volumes(p, mesh.t))
    done: set[int] = set()
    for i in np.argsort(np.linalg.norm(target - p[:, nearer], axis=0)):
        node = int(nearer[i])
        if node in done:
            continue
        before = p[:, node].copy()
        p[:, node] = target[:, i]
        around = np.flatnonzero(np.any(mesh.t == node, axis=0))
        if np.all(signed_volumes(p, mesh.t[:, around]) * sign[around] > 0):
            done.add(node)
        else:
            p[:, node] = before
    return type(mesh)(p, mesh.t)


def signed_volumes(p: Array, t: Indices) -> Array:
    """(n,), m³, of tetrahedra t (4, n)."""
    a, b, c, d = (p[:, k] for k in t)
    return np.einsum("in,in->n", np.cross(b - a, c - a, axis=0), d - a) / 6


def volumes(mesh: Any) -> Array:
    return np.abs(signed_volumes(mesh.p, mesh.t))


# The run


def row(kind: str, size_mm: float, without_mkl: bool) -> dict[str, Any] | None:
    """What a process of its own found; None where it fails."""
    command = [sys.executable, str(Path(__file__).resolve()), "--one", kind, str(size_mm)]
    command += ["--without-mkl"] * without_mkl
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        print(f"{kind} {size_mm:g} mm failed: {(done.stderr.strip().splitlines() or ['?'])[-1][:100]}")
        return None
    found: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return found


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--edges-mm", type=float, nargs="+", default=[40.0, 24.0, 16.0, 12.0, 8.0])
    parser.add_argument("--spacings-mm", type=float, nargs="+", default=[16.0, 12.0, 8.0, 6.2])
    parser.add_argument("--without-mkl", action="store_true", help="as if MKL PARDISO were not installed")
    parser.add_argument("--one", nargs=2, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.without_mkl:
        pardiso.library = lambda: None  # type: ignore[assignment]
    if options.one:
        kind, size = options.one
        found = (of_palpate if kind == "palpate" else of_finite_elements)(float(size))
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
        print(json.dumps({**found, "gib": peak}))
        return
    *_, normal = tip(scene(12.0))
    print(
        f"{platform.processor() or platform.machine()}, Python {platform.python_version()}, {solver_name()}"
    )
    bodies = [("elements", e) for e in sorted(options.edges_mm)] + [
        ("palpate", s) for s in options.spacings_mm
    ]
    print(
        f"{'':9} {'mm':>5} {'unknowns':>9} {'mesh s':>7} {'assembly':>8} {'solution':>8} {'GiB':>5} {'cm³':>7} "
        f"{'held cm²':>8} {'tip mm²':>7} {'normal N/m':>10} {'off':>7} {'whole':>7}"
    )
    reference: Array | None = None
    for kind, size in bodies:
        found = row(kind, size, options.without_mkl)
        if found is None:
            continue
        reference = np.array(found["stiffness"]) if reference is None else reference
        print(line(kind, size, found, normal, reference), flush=True)


def line(kind: str, size_mm: float, found: dict[str, Any], normal: Array, reference: Array) -> str:
    """A body's line of the table."""
    stiffness = np.array(found["stiffness"])
    along, finest = float(normal @ stiffness @ normal), float(normal @ reference @ normal)
    whole = np.linalg.norm(stiffness - reference, 2) / np.linalg.norm(reference, 2)
    return (
        f"{kind:9} {size_mm:5.3g} {found['unknowns']:9,} {found['mesh']:7.1f} {found['assembly']:8.1f} "
        f"{found['solution']:8.1f} {found['gib']:5.2f} {1e6 * found['volume']:7.1f} {1e4 * found['held']:8.1f} "
        f"{1e6 * found['tip']:7.2f} {along:10.2f} {100 * (along / finest - 1):+6.2f}% {100 * whole:6.2f}%"
    )


if __name__ == "__main__":
    main()
