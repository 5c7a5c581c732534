"""Derive the shipped liver surface from the segmentation in Debian's `libcgal-demo`.

    apt-get download libcgal-demo=5.5.1-2
    dpkg-deb -x libcgal-demo_5.5.1-2_all.deb package
    tar -xzf package/usr/share/doc/libcgal-dev/data.tar.gz data/images/liver.inr.gz
    python scripts/derive_liver_surface.py data/images/liver.inr.gz

needs the extra `surfaces`. The steps: mask of label 255, blurred over 3 mm; resampled to 2 mm; surface at the level
that keeps the volume (marching cubes); Taubin smoothing; decimation; origin to the centroid, scaled to the volume.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import fast_simplification
import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy import ndimage, optimize
from skimage.measure import marching_cubes

from palpate.geometry.label_image import read_label_image
from palpate.geometry.measures import enclosed_volume
from palpate.geometry.sampling import depth_inside
from palpate.geometry.surface import load_surface

LIVER = 255
BLUR_M = 3e-3
STEP_M = 2e-3


def main() -> None:
    parser = argparse.ArgumentParser(description="Derive the shipped liver surface from its segmentation.")
    parser.add_argument("segmentation", type=Path, help="liver.inr.gz")
    parser.add_argument("-o", "--output", type=Path, default=Path("configs/liver.ply"))
    parser.add_argument("--triangles", type=int, default=3000)
    arguments = parser.parse_args()

    image = read_label_image(arguments.segmentation)
    mask, voxel_m = image.labels == LIVER, image.voxel_m
    volume = float(np.count_nonzero(mask) * np.prod(voxel_m))
    mesh = simplified(smooth_surface(mask, voxel_m, volume), arguments.triangles)
    origin = mesh.center_mass
    mesh.apply_translation(-origin)
    mesh.apply_scale((volume / mesh.volume) ** (1 / 3))
    arguments.output.parent.mkdir(parents=True, exist_ok=True)
    arguments.output.write_bytes(mesh.export(file_type="ply", encoding="binary", vertex_normal=False))

    surface = load_surface(arguments.output).surface  # raises if the decimation damaged it
    rind = np.argwhere(mask & ~ndimage.binary_erosion(mask))
    distance = np.abs(depth_inside((rind + 0.5) * voxel_m - origin, surface)) * 1e3
    size = np.ptp(surface.vertices, axis=0) * 1e3
    print(f"segmentation  {volume * 1e6:.1f} cm³")
    print(f"surface       {enclosed_volume(surface) * 1e6:.1f} cm³, {size.round(1).tolist()} mm")
    print(f"              {len(surface.vertices)} vertices, {len(surface.triangles)} triangles")
    print(f"origin        {(origin * 1e3).round(2).tolist()} mm from the image's corner")
    median, most, all_ = np.quantile(distance, [0.5, 0.95, 1])
    print(f"distance of outermost voxels: median {median:.2f}, 95 % {most:.2f}, largest {all_:.2f} mm")


def smooth_surface(mask: NDArray[np.bool_], voxel_m: NDArray[np.float64], volume: float) -> trimesh.Trimesh:
    """Surface of the blurred mask (nx, ny, nz) at the level where it encloses `volume`, m³; its largest piece.

    In m from the image's corner: the center of voxel i is at (i + 0.5) voxel_m.
    """
    margin = np.ceil(6 * BLUR_M / voxel_m).astype(int)
    blurred = ndimage.gaussian_filter(
        np.pad(mask, [(int(m), int(m)) for m in margin]).astype(np.float32), BLUR_M / voxel_m
    )
    grid = ndimage.zoom(blurred, voxel_m / STEP_M, order=1, grid_mode=True, mode="grid-constant")
    step_m = voxel_m * blurred.shape / grid.shape

    def surface(level: float) -> trimesh.Trimesh:
        vertices, faces, *_ = marching_cubes(grid, level, spacing=tuple(step_m), gradient_direction="ascent")
        pieces = trimesh.Trimesh(vertices + step_m / 2 - margin * voxel_m, faces).split()
        return max(pieces, key=lambda piece: piece.volume)

    return surface(optimize.brentq(lambda level: surface(level).volume - volume, 0.2, 0.8, xtol=1e-3))


def simplified(mesh: trimesh.Trimesh, n_triangles: int) -> trimesh.Trimesh:
    """The mesh smoothed without shrinking (Taubin 1995), then decimated by quadric errors (Garland & Heckbert 1997)."""
    trimesh.smoothing.filter_taubin(mesh, lamb=0.5, nu=0.53, iterations=60)
    return trimesh.Trimesh(
        *fast_simplification.simplify(mesh.vertices, mesh.faces, target_count=n_triangles, agg=3)
    )


if __name__ == "__main__":
    main()
