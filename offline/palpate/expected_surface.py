"""What the build of a scene with tools will take: nodes, points and memory."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from palpate.build_surface import memory_needed, surface_cloud
from palpate.memory import machine_memory
from palpate.progress import NO_PROGRESS, Progress
from palpate.scene.schema import Config
from palpate.scene_cloud import tool_shapes
from palpate.stage_cache import NO_CACHE, StageCache

_TIME_WITH_TOOLS = (
    "Time is not estimated for a scene with tools: 3,893 nodes, 1,900 of them on the surface, take five to eight minutes on two "
    "cores (configs/liver-surface.toml)."
)


@dataclass(frozen=True)
class ExpectedSurfaceModel:
    """What `palpate build --dry-run` says of a scene with tools. Nodes and points are counted, memory is estimated."""

    name: str
    n_nodes: int
    n_points: int
    peak_bytes: float
    machine_memory_bytes: float

    def text(self) -> str:
        size = (
            f"{self.name}: {self.n_nodes:,} nodes, {3 * self.n_nodes:,} unknowns, {self.n_points:,} of the nodes on the surface, "
            "as the points that tools touch"
        )
        memory = f"memory about {self.peak_bytes / 2**30:.1f} GiB; this machine has {self.machine_memory_bytes / 2**30:.1f}"
        if self.peak_bytes > self.machine_memory_bytes:
            memory += ": expected a larger surface.spacing_m or a smaller surface.working_area"
        return "\n".join((size, memory, _TIME_WITH_TOOLS))


def expected_surface_model(
    config: Config, folder: Path, progress: Progress = NO_PROGRESS, cache: StageCache = NO_CACHE
) -> ExpectedSurfaceModel:
    """What the model of a scene with tools will be. Makes the node cloud, which the build then finds in the cache.

    Raises as `palpate.build_surface.build_surface_model`, but for what comes after the node cloud.
    """
    cloud, _ = surface_cloud(config, folder, progress, cache)
    tool_shapes(config, cloud)
    return ExpectedSurfaceModel(
        name=config.name,
        n_nodes=cloud.n_nodes,
        n_points=int(cloud.boundary.sum()),
        peak_bytes=memory_needed(config, cloud),
        machine_memory_bytes=machine_memory(),
    )
