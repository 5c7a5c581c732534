"""The surface of one label of an image: smooth, closed, with the label's volume."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import fast_simplification
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, optimize
from skimage.measure import marching_cubes

from palpate.geometry.cloud import TriangleSurface
from palpate.geometry.label_image import LabelImage, read_label_image
from palpate.geometry.measures import enclosed_volume
from palpate.geometry.ply import ply_bytes
from palpate.geometry.repair import Repair, mend
from palpate.geometry.sampling import depth_inside

Array = NDArray[np.float64]

_SIGMA_IN_VOXELS = 1.0
"""Standard deviation of the blur over the longest edge of a voxel: the steps of the voxels vanish."""
_STEPS_PER_SIGMA = 1.5
_LEVELS = (0.15, 0.85)
"""Of the blurred mask. The level of a flat side is 0.5."""
_LARGEST_VOLUME_ERROR = 0.02


@dataclass(frozen=True)
class LabelSurface:
    """The surface of a label.

    surface       in m, in the image's frame
    label_m3      volume of the label's voxels in the body
    n_islands     pieces of the label apart from the body, left out
    cavities_m3   volume of the cavities in the body, filled
    distance_m    (3,), of the centers of the outermost voxels from the surface: median, 95 % of them, largest
    """

    surface: TriangleSurface
    label_m3: float
    n_islands: int
    cavities_m3: float
    distance_m: Array


def surface_file(path: Path, label: int, n_triangles: int) -> tuple[bytes, list[str]]:
    """A PLY file, in m, with the surface of a label of an image file; and lines about it. Raises as `label_surface`."""
    image = read_label_image(path)
    found = label_surface(image, label, n_triangles)
    body, (median, most, largest) = found.surface, found.distance_m * 1e3
    lines = [f"image    {' x '.join(map(str, image.labels.shape))} voxels"]
    if found.n_islands:
        lines.append(f"left out {found.n_islands:,} pieces of the label apart from the largest")
    if found.cavities_m3:
        lines.append(f"filled cavities of {found.cavities_m3 * 1e6:.4g} cm³")
    lines += [
        f"label    {found.label_m3 * 1e6:.5g} cm³",
        f"surface  {enclosed_volume(body) * 1e6:.5g} cm³, {len(body.triangles):,} triangles, in m",
        f"outermost voxels are {median:.2g} mm from it (median), {most:.2g} mm (95 %), {largest:.2g} mm (largest)",
    ]
    return ply_bytes(body.vertices, body.triangles), lines


def label_surface(image: LabelImage, label: int, n_triangles: int) -> LabelSurface:
    """The surface of the largest piece of a label, of about so many triangles or fewer.

    The piece is blurred, its surface found at the level that keeps the volume (marching cubes), and simplified (M. Garland,
    P. Heckbert: Surface simplification using quadric error metrics, SIGGRAPH 1997). Raises ValueError if the image does not
    have the label, or if the surface would miss its volume by more than 2 %: the label is too thin for its voxels.
    """
    mask, n_islands, n_filled = _body(image, label)
    voxel_m3 = abs(float(np.linalg.det(image.axes_m)))
    volume = mask.sum() * voxel_m3
    sigma_m = _SIGMA_IN_VOXELS * float(image.voxel_m.max())
    vertices, triangles = blurred_surface(
        mask, image.voxel_m, sigma_m, sigma_m / _STEPS_PER_SIGMA, mask.sum() * float(np.prod(image.voxel_m))
    )
    if len(triangles) > n_triangles:
        vertices, triangles = fast_simplification.simplify(
            vertices, triangles.astype(np.int32), target_count=n_triangles
        )
    # From m along the image's axes to the frame.
    directions = image.axes_m / image.voxel_m
    places = np.asarray(vertices, np.float64) @ directions.T + image.origin_m
    mended = Repair(places, np.asarray(triangles, np.int64))
    mend(mended)
    surface = mended.surface
    error = enclosed_volume(surface) / volume - 1
    if abs(error) > _LARGEST_VOLUME_ERROR:
        raise ValueError(
            f"label {label}: the surface has {100 * error:+.2g} % of the volume of its voxels, expected within "
            f"{100 * _LARGEST_VOLUME_ERROR:g} %: it has parts that are too thin for the voxels, or too few triangles"
        )
    rind = np.argwhere(mask & ~ndimage.binary_erosion(mask)) @ image.axes_m.T + image.origin_m
    distance = np.quantile(np.abs(depth_inside(rind, surface)), [0.5, 0.95, 1])
    return LabelSurface(surface, float(volume), n_islands, n_filled * voxel_m3, distance)


def _body(image: LabelImage, label: int) -> tuple[NDArray[np.bool_], int, int]:
    """The largest piece of the label, filled (nx, ny, nz), how many other pieces there are, and how many voxels were filled."""
    mask = image.labels == label
    if not mask.any():
        present = np.unique(image.labels)
        shown = ", ".join(f"{value:g}" for value in present[:20]) + (", ..." if len(present) > 20 else "")
        raise ValueError(f"label {label} is not in the image: it has {shown}")
    pieces, n_pieces = ndimage.label(mask)
    sizes = np.bincount(pieces.ravel())
    sizes[0] = 0
    piece = pieces == int(np.argmax(sizes))
    body = ndimage.binary_fill_holes(piece)
    return body, n_pieces - 1, int(body.sum() - piece.sum())


def blurred_surface(
    mask: NDArray[np.bool_], voxel_m: Array, sigma_m: float, step_m: float, volume_m3: float
) -> tuple[Array, NDArray[np.int64]]:
    """Surface of the blurred mask (nx, ny, nz) at the level where it encloses the volume; its largest piece.

    voxel_m   (3,), edges of a voxel
    sigma_m   standard deviation of the blur
    step_m    about the distance of the places where the blurred mask is sampled

    Returns vertices (n, 3), m along the axes of the mask from the center of voxel (0, 0, 0), and triangles (m, 3), outward.
    Raises ValueError if the mask is too thin.
    """
    first = np.array([s.start for s in ndimage.find_objects(mask.astype(np.int8))[0]])
    part = mask[ndimage.find_objects(mask.astype(np.int8))[0]]
    margin = np.ceil(6 * sigma_m / voxel_m).astype(int)
    padded = np.pad(part, [(int(m), int(m)) for m in margin]).astype(np.float32)
    blurred = ndimage.gaussian_filter(padded, sigma_m / voxel_m)
    grid = ndimage.zoom(blurred, voxel_m / step_m, order=1, grid_mode=True, mode="grid-constant")
    steps_m = voxel_m * blurred.shape / grid.shape
    # The grid begins at the corner of the padded mask.
    corner = (first - margin - 0.5) * voxel_m + steps_m / 2

    def surface(level: float) -> Repair:
        vertices, triangles, *_ = marching_cubes(
            grid, level, spacing=tuple(steps_m), gradient_direction="ascent", allow_degenerate=False
        )
        return Repair(vertices.astype(np.float64) + corner, triangles.astype(np.int64)).largest_piece()

    low, high = _LEVELS
    if grid.max() <= high or not surface(high).volume < volume_m3 < surface(low).volume:
        raise ValueError(
            f"too thin for voxels of {(voxel_m * 1e3).round(3).tolist()} mm: no surface has its volume"
        )
    level = optimize.brentq(lambda level: surface(level).volume - volume_m3, low, high, xtol=1e-3)
    body = surface(level)
    return body.vertices, body.triangles
