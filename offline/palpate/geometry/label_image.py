"""Reads labelled images: NIfTI by nibabel, NRRD by pynrrd, Inrimage by a reader of our own.

Places are in m in the patient's frame of DICOM: x to the left, y to the back, z to the head. An image that states no
orientation (every Inrimage, some NRRD files) has its places along its own axes.
"""

from __future__ import annotations

import gzip
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.geometry.readers import ReadError

Array = NDArray[np.float64]

_NIFTI = (".nii", ".nii.gz")
_NRRD = (".nrrd",)
_INRIMAGE = (".inr", ".inr.gz")
_RAS_TO_LPS = np.diag([-1.0, -1.0, 1.0])
_NIFTI_UNITS_M = {"meter": 1.0, "mm": 1e-3, "micron": 1e-6, "unknown": 1e-3}
_NRRD_UNITS_M = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6, "µm": 1e-6, "": 1e-3}
_NRRD_SPACES = {
    "left-posterior-superior": np.eye(3),
    "lps": np.eye(3),
    "right-anterior-superior": _RAS_TO_LPS,
    "ras": _RAS_TO_LPS,
    "left-anterior-superior": np.diag([1.0, -1.0, 1.0]),
    "las": np.diag([1.0, -1.0, 1.0]),
}
_INRIMAGE_MAGIC = b"#INRIMAGE-4#{"
_INRIMAGE_TYPES = {
    ("unsigned fixed", "8"): "u1", ("unsigned fixed", "16"): "u2", ("unsigned fixed", "32"): "u4",
    ("signed fixed", "8"): "i1", ("signed fixed", "16"): "i2", ("signed fixed", "32"): "i4",
    ("float", "32"): "f4", ("float", "64"): "f8",
}  # fmt: skip
_BYTE_ORDERS = {"decm": "<", "alpha": "<", "pc": "<", "sun": ">", "sgi": ">"}


@dataclass(frozen=True)
class LabelImage:
    """A label at each voxel.

    labels    (nx, ny, nz)
    origin_m  (3,), the center of voxel (0, 0, 0)
    axes_m    (3, 3), column i is the step to the next voxel along axis i
    """

    labels: NDArray[np.generic]
    origin_m: Array
    axes_m: Array

    @property
    def voxel_m(self) -> Array:
        """(3,), the voxel's edges."""
        return np.asarray(np.linalg.norm(self.axes_m, axis=0))


def read_label_image(path: Path) -> LabelImage:
    """Raises FileNotFoundError, ReadError."""
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such image")
    name = path.name.lower()
    try:
        if name.endswith(_INRIMAGE):
            image = _read_inrimage(path.read_bytes())
        elif name.endswith(_NIFTI):
            image = _read_nifti(path)
        elif name.endswith(_NRRD):
            image = _read_nrrd(path)
        else:
            raise ReadError(f"expected a file that ends in {', '.join((*_NIFTI, *_NRRD, *_INRIMAGE))}")
        _check_axes(image)
    except ReadError as error:
        raise ReadError(f"{path}: {error}") from error
    return image


def _check_axes(image: LabelImage) -> None:
    if image.labels.ndim != 3 or image.labels.dtype.kind not in "iuf":
        raise ReadError(
            f"{' x '.join(map(str, image.labels.shape))} values of type {image.labels.dtype}: expected one label for each "
            "voxel of three dimensions"
        )
    lengths = image.voxel_m
    if not (np.all(np.isfinite(image.origin_m)) and np.all(np.isfinite(image.axes_m))):
        raise ReadError("its origin or axes are not finite numbers")
    if not abs(np.linalg.det(image.axes_m)) > 1e-3 * np.prod(lengths):
        raise ReadError(f"voxels of {(lengths * 1e3).tolist()} mm do not span a volume")


def _read_nifti(path: Path) -> LabelImage:
    """Raises ReadError."""
    import nibabel

    try:
        image: Any = nibabel.load(path)
        labels = np.squeeze(np.asanyarray(image.dataobj), axis=tuple(range(3, len(image.shape))))
        unit_m = _NIFTI_UNITS_M[image.header.get_xyzt_units()[0]]
    except (nibabel.filebasedimages.ImageFileError, nibabel.spatialimages.HeaderDataError) as error:
        raise ReadError(f"nibabel can't read it: {error}") from error
    except (ValueError, KeyError, OSError, EOFError, OverflowError, zlib.error) as error:
        raise ReadError(f"truncated or damaged, or with more than one value a voxel: {error}") from error
    affine = _RAS_TO_LPS @ image.affine[:3] * unit_m
    return LabelImage(labels, affine[:, 3], affine[:, :3])


def _read_nrrd(path: Path) -> LabelImage:
    """Raises ReadError."""
    import nrrd

    try:
        labels, header = nrrd.read(str(path))
        space = str(header.get("space", "")).lower()
        axes = np.array(
            header.get("space directions", np.diag(header.get("spacings", np.full(3, np.nan)))), float
        )
        origin = np.array(header.get("space origin", np.zeros(3)), float)
        units = set(header.get("space units", header.get("units", [""])))
    except (
        nrrd.NRRDError,
        ValueError,
        KeyError,
        TypeError,
        StopIteration,
        OSError,
        EOFError,
        zlib.error,
    ) as error:
        raise ReadError(f"pynrrd can't read it: {error}") from error
    if axes.shape != (3, 3) or origin.shape != (3,):
        raise ReadError(f"space directions of shape {axes.shape}: expected three of three numbers each")
    if len(units) != 1 or not units <= set(_NRRD_UNITS_M):
        raise ReadError(
            f"space units {sorted(units)}: expected one of {', '.join(filter(None, _NRRD_UNITS_M))}"
        )
    if space and space not in _NRRD_SPACES:
        raise ReadError(f"space {space[:60]!r}: expected one of {', '.join(_NRRD_SPACES)}")
    unit_m = _NRRD_UNITS_M[units.pop()]
    to_lps = _NRRD_SPACES.get(space, np.eye(3))
    return LabelImage(labels, to_lps @ origin * unit_m, to_lps @ axes.T * unit_m)


def _read_inrimage(data: bytes) -> LabelImage:
    """An INRIMAGE-4 file, plain or gzipped; lengths are in mm. Raises ReadError."""
    if data[:2] == b"\x1f\x8b":
        try:
            data = gzip.decompress(data)
        except (OSError, EOFError, zlib.error) as error:
            raise ReadError(f"truncated or damaged: {error}") from error
    end = data.find(b"##}")
    if not data.startswith(_INRIMAGE_MAGIC) or end < 0:
        raise ReadError("not an Inrimage: expected '#INRIMAGE-4#{' first, and '##}' at the end of the header")
    lines = data[len(_INRIMAGE_MAGIC) : end].decode("latin-1").splitlines()
    header = {key.strip(): value.strip() for key, _, value in (line.partition("=") for line in lines)}
    try:
        shape = tuple(int(header[key]) for key in ("XDIM", "YDIM", "ZDIM"))
        voxel_mm = np.array([float(header[key]) for key in ("VX", "VY", "VZ")])
        origin_mm = np.array([float(header.get(key, "0")) for key in ("TX", "TY", "TZ")])
        bits = header["PIXSIZE"].removesuffix("bits").strip()
        kind = _INRIMAGE_TYPES[header["TYPE"], bits]
        order = _BYTE_ORDERS[header["CPU"]]
    except (KeyError, ValueError) as error:
        raise ReadError(f"the header lacks a field, or has one that is not understood: {error}") from error
    if header.get("VDIM", "1") != "1":
        raise ReadError(f"VDIM={header['VDIM']}: expected one label a voxel")
    if min(shape) < 1 or not np.all(voxel_mm > 0) or not np.all(np.isfinite([voxel_mm, origin_mm])):
        raise ReadError(f"{shape} voxels of {voxel_mm.tolist()} mm: expected positive numbers")
    body = data[(end + len(b"##}") + 255) // 256 * 256 :]  # the header fills blocks of 256 bytes
    expected = int(np.prod([int(n) for n in shape], dtype=object)) * int(kind[1])
    if len(body) != expected:
        raise ReadError(
            f"truncated or damaged: the header states {expected:,} bytes of voxels, the file has {len(body):,}"
        )
    labels = np.frombuffer(body, order + kind).reshape(shape[::-1]).T
    return LabelImage(labels, origin_mm * 1e-3, np.diag(voxel_mm) * 1e-3)
