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
from scipy import ndimage

from palpate.geometry.label_image import read_label_image
from palpate.geometry.label_surface import blurred_surface
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
    voxel_m = image.voxel_m
    mask = image.labels == LIVER
    volume = float(np.count_nonzero(mask) * np.prod(voxel_m))
    blurred = trimesh.Trimesh(*blurred_surface(mask, voxel_m, BLUR_M, STEP_M, volume))
    mesh = simplified(blurred, arguments.triangles)
    origin = mesh.center_mass
    mesh.apply_translation(-origin)
    mesh.apply_scale((volume / mesh.volume) ** (1 / 3))
    arguments.output.parent.mkdir(parents=True, exist_ok=True)
    arguments.output.write_bytes(mesh.export(file_type="ply", encoding="binary", vertex_normal=False))

    surface = load_surface(arguments.output).surface  # raises if the decimation damaged it
    rind = np.argwhere(mask & ~ndimage.binary_erosion(mask))
    distance = np.abs(depth_inside(rind * voxel_m - origin, surface)) * 1e3
    size = np.ptp(surface.vertices, axis=0) * 1e3
    print(f"segmentation  {volume * 1e6:.1f} cm³")
    print(f"surface       {enclosed_volume(surface) * 1e6:.1f} cm³, {size.round(1).tolist()} mm")
    print(f"              {len(surface.vertices)} vertices, {len(surface.triangles)} triangles")
    print(f"origin        {(origin * 1e3).round(2).tolist()} mm from the center of the first voxel")
    median, most, all_ = np.quantile(distance, [0.5, 0.95, 1])
    print(f"distance of outermost voxels: median {median:.2f}, 95 % {most:.2f}, largest {all_:.2f} mm")


def simplified(mesh: trimesh.Trimesh, n_triangles: int) -> trimesh.Trimesh:
    """The mesh smoothed without shrinking (Taubin 1995), then decimated by quadric errors (Garland & Heckbert 1997)."""
    trimesh.smoothing.filter_taubin(mesh, lamb=0.5, nu=0.53, iterations=60)
    return trimesh.Trimesh(
        *fast_simplification.simplify(mesh.vertices, mesh.faces, target_count=n_triangles, agg=3)
    )


if __name__ == "__main__":
    main()
