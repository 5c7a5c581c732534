"""What each stage of a build depends on, as the keys under which it is kept."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from functools import cache
from importlib.metadata import version
from pathlib import Path

from palpate.factorization import solver_name
from palpate.scene.schema import Config, SurfaceGeometry, surface_files
from palpate.stage_cache import key_of

_CLOUD = ("files.py", "scene", "geometry", "scene_cloud.py", "inclusions.py")
_BODY = (*_CLOUD, "meshfree", "discretization", "factorization")
_MODES = (*_BODY, "modes")
_SURFACE = (*_MODES, "surface_model", "build_surface.py")
_LIBRARIES = ("numpy", "scipy", "numba", "libigl")


@dataclass(frozen=True)
class StageKeys:
    """Keys of the node cloud, the assembled body, its modes, and what a surface model is made of.

    Each holds the code that computes the stage and the versions of the libraries. Young's modulus, density, Prony series,
    band and reduction are in none: bodies are assembled in unit constants, and the vectors at 0 Hz serve every band.
    Only the stages of a surface model depend on the whole scene beside `surface`.
    """

    cloud: str
    body: str
    modes: str
    surface: str


def stage_keys(config: Config, folder: Path) -> StageKeys:
    """The keys of a scene, whose files are relative to `folder`. Raises FileNotFoundError where the surface is not there."""
    scene = config.model_dump(
        mode="json",
        include={"geometry", "fixed", "contact", "discretization", "surface", "tool", "inclusion"},
    )
    geometry = scene["geometry"]
    patches = [[c["point_m"], c["radius_m"], c["spacing_m"]] for c in scene["contact"]]
    files = [hashlib.sha256((folder / file).read_bytes()).hexdigest() for _, file in surface_files(config)]
    for table in (geometry, *scene["inclusion"]):
        table.pop("file", None)
    shapes = [
        {key: value for key, value in table.items() if key != "relative_stiffness"}
        for table in scene["inclusion"]
        if table["spacing_m"] is not None
    ]
    refined: list[object] = []
    held: list[object] = []
    if isinstance(config.geometry, SurfaceGeometry):
        refined = [p for p in patches if p[2] is not None]
        held = scene["fixed"]
    area = {name: scene["surface"][name] for name in ("spacing_m", "working_area")}
    finer = [refined, shapes, area, bool(scene["tool"])]
    cloud = key_of(_code(_CLOUD), geometry, files, finer, held)
    body = key_of(
        _code(_BODY), cloud, scene["fixed"], patches, scene["discretization"], scene["inclusion"],
        config.material.material().poissons_ratio, solver_name(),
    )  # fmt: skip
    return StageKeys(cloud, body, key_of(_code(_MODES), body), key_of(_code(_SURFACE), body))


@cache
def _code(parts: tuple[str, ...]) -> str:
    """A hash of the sources of some rooms and modules, and of the libraries' versions."""
    digest = hashlib.sha256(" ".join(f"{name} {version(name)}" for name in _LIBRARIES).encode())
    root = Path(__file__).parent
    for part in parts:
        for path in sorted((root / part).rglob("*.py")) if (root / part).is_dir() else [root / part]:
            digest.update(path.relative_to(root).as_posix().encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()
