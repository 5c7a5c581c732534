"""Labelled images: read in one frame, and each label's surface has its volume and its place."""

from __future__ import annotations

import gzip
import subprocess
import sys
from pathlib import Path

import nibabel
import nrrd
import numpy as np
import pytest

from palpate.geometry.label_image import LabelImage, read_label_image
from palpate.geometry.label_surface import LabelSurface, label_surface
from palpate.geometry.measures import enclosed_volume
from palpate.geometry.readers import ReadError
from palpate.geometry.soundness import check_surface
from palpate.geometry.surface import load_surface

SHAPE, RADIUS_MM = (60, 50, 30), 20.0
TURN = np.array([[0.8, -0.6, 0], [0.6, 0.8, 0], [0, 0, 1.0]])
AXES_MM = TURN * np.array([1.0, 1.2, 2.0])
ORIGIN_MM = np.array([-100.0, 50.0, 7.0])
CENTER = np.array([28.0, 24.0, 15.0])  # voxels


def places_mm() -> np.ndarray:
    """(nx, ny, nz, 3), from the ball's center."""
    indices = np.moveaxis(np.indices(SHAPE), 0, -1)
    return (indices - CENTER) @ AXES_MM.T


def two_labels() -> np.ndarray:
    """A ball of labels 2 and 7 cut in the middle across x, and a crumb of 7."""
    places = places_mm()
    ball = np.linalg.norm(places, axis=-1) < RADIUS_MM
    labels = np.where(ball, np.where(places @ TURN[:, 0] < 0, 7, 2), 0).astype(np.int16)
    labels[1:3, 1:3, 1:3] = 7
    return labels


IMAGE = LabelImage(two_labels(), ORIGIN_MM * 1e-3, AXES_MM * 1e-3)
LPS_TO_RAS = np.diag([-1.0, -1.0, 1.0])


def write_nifti(path: Path, unit: str = "mm", per_mm: float = 1.0) -> None:
    affine = np.eye(4)
    affine[:3, :3], affine[:3, 3] = LPS_TO_RAS @ AXES_MM * per_mm, LPS_TO_RAS @ ORIGIN_MM * per_mm
    image = nibabel.Nifti1Image(two_labels(), affine)
    image.header.set_xyzt_units(unit)
    nibabel.save(image, path)


def write_nrrd(
    path: Path, space: str, to_space: np.ndarray, unit: str | None = None, per_mm: float = 1.0
) -> None:
    header = {
        "space": space,
        "space directions": (to_space @ AXES_MM * per_mm).T,
        "space origin": to_space @ ORIGIN_MM * per_mm,
    }
    nrrd.write(str(path), two_labels(), header | ({} if unit is None else {"space units": [unit] * 3}))


def inrimage(axis_mm: tuple[float, float, float] = (1.0, 1.2, 2.0)) -> bytes:
    fields = dict(zip(("XDIM", "YDIM", "ZDIM"), SHAPE, strict=True)) | {"VDIM": 1, "TYPE": "signed fixed"}
    fields |= {"PIXSIZE": "16 bits", "CPU": "sun"} | dict(zip(("VX", "VY", "VZ"), axis_mm, strict=True))
    header = "#INRIMAGE-4#{\n" + "".join(f"{key}={value}\n" for key, value in fields.items())
    return (header.ljust(252, "\n") + "##}\n").encode() + two_labels().T.astype(">i2").tobytes()


def assert_is_the_image(read: LabelImage) -> None:
    np.testing.assert_array_equal(read.labels, IMAGE.labels)
    np.testing.assert_allclose(read.origin_m, IMAGE.origin_m, rtol=1e-6)
    np.testing.assert_allclose(read.axes_m, IMAGE.axes_m, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize(("unit", "per_mm"), [("mm", 1.0), ("meter", 1e-3), ("micron", 1e3)])
@pytest.mark.parametrize("suffix", ["nii", "nii.gz"])
def test_a_nifti_gives_the_frame_of_the_patient_in_m(
    tmp_path: Path, suffix: str, unit: str, per_mm: float
) -> None:
    write_nifti(tmp_path / f"organ.{suffix}", unit, per_mm)
    assert_is_the_image(read_label_image(tmp_path / f"organ.{suffix}"))


@pytest.mark.parametrize(
    ("space", "to_space", "unit", "per_mm"),
    [
        ("left-posterior-superior", np.eye(3), None, 1.0),
        ("right-anterior-superior", LPS_TO_RAS, "mm", 1.0),
        ("left-anterior-superior", np.diag([1.0, -1.0, 1.0]), "m", 1e-3),
    ],
)
def test_a_nrrd_gives_the_frame_of_the_patient_in_m(
    tmp_path: Path, space: str, to_space: np.ndarray, unit: str | None, per_mm: float
) -> None:
    write_nrrd(tmp_path / "organ.nrrd", space, to_space, unit, per_mm)
    assert_is_the_image(read_label_image(tmp_path / "organ.nrrd"))


@pytest.mark.parametrize("packed", [False, True])
def test_an_inrimage_gives_its_own_axes_in_m(tmp_path: Path, packed: bool) -> None:
    path = tmp_path / ("organ.inr.gz" if packed else "organ.inr")
    path.write_bytes(gzip.compress(inrimage()) if packed else inrimage())
    read = read_label_image(path)
    np.testing.assert_array_equal(read.labels, IMAGE.labels)
    np.testing.assert_allclose(read.axes_m, np.diag([1.0, 1.2, 2.0]) * 1e-3)
    np.testing.assert_array_equal(read.origin_m, 0)


@pytest.mark.parametrize("name", ["organ.nii", "organ.nii.gz", "organ.nrrd", "organ.inr", "organ.inr.gz"])
def test_a_damaged_image_is_refused(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    if name.endswith(("nii", "nii.gz")):
        write_nifti(path)
    elif name.endswith("nrrd"):
        write_nrrd(path, "left-posterior-superior", np.eye(3))
    else:
        path.write_bytes(gzip.compress(inrimage()) if name.endswith("gz") else inrimage())
    data = path.read_bytes()
    for part in (0.0, 0.001, 0.1, 0.5, 0.95):
        path.write_bytes(data[: int(part * len(data))])
        with pytest.raises(ReadError, match=name):
            read_label_image(path)


def test_images_that_are_no_labelled_volume_are_refused(tmp_path: Path) -> None:
    nibabel.save(nibabel.Nifti1Image(np.zeros((4, 4, 4, 2), np.int16), np.eye(4)), tmp_path / "four.nii")
    with pytest.raises(ReadError, match=r"four.nii: .*more than one value a voxel"):
        read_label_image(tmp_path / "four.nii")
    with pytest.raises(ReadError, match=r"expected a file that ends in \.nii"):
        (tmp_path / "organ.dcm").write_bytes(b"")
        read_label_image(tmp_path / "organ.dcm")
    nrrd.write(str(tmp_path / "plain.nrrd"), np.zeros((4, 4, 4), np.uint8))
    with pytest.raises(ReadError, match="not finite"):
        read_label_image(tmp_path / "plain.nrrd")


@pytest.fixture(scope="module")
def halves() -> dict[int, LabelSurface]:
    return {label: label_surface(IMAGE, label, 4000) for label in (2, 7)}


@pytest.mark.parametrize("label", [2, 7])
def test_the_surface_of_each_label_is_sound_with_the_volume_of_its_voxels(
    halves: dict[int, LabelSurface], label: int
) -> None:
    found = halves[label]
    check_surface(found.surface)
    n_voxels = int(np.sum(IMAGE.labels == label)) - (8 if label == 7 else 0)
    assert found.label_m3 == pytest.approx(n_voxels * 2.4e-9, rel=1e-12)
    assert enclosed_volume(found.surface) == pytest.approx(found.label_m3, rel=0.01)
    assert found.n_islands == (1 if label == 7 else 0)
    assert len(found.surface.triangles) <= 4000


def test_a_ball_of_voxels_gives_a_ball_in_its_place() -> None:
    ball = LabelImage((np.linalg.norm(places_mm(), axis=-1) < RADIUS_MM) * 3, IMAGE.origin_m, IMAGE.axes_m)
    found = label_surface(ball, 3, 8000)
    assert enclosed_volume(found.surface) == pytest.approx(found.label_m3, rel=0.01)
    assert found.label_m3 == pytest.approx(4 / 3 * np.pi * 0.02**3, rel=0.01)
    center = IMAGE.origin_m + IMAGE.axes_m @ CENTER
    radii = np.linalg.norm(found.surface.vertices - center, axis=1)
    # Smooth: a voxel's own step is 2 mm along z, half of it the most that its center tells.
    np.testing.assert_allclose(radii, 0.02, atol=1e-3)
    assert radii.std() < 0.2e-3
    assert found.distance_m[1] < 2e-3


def test_a_cavity_is_filled_and_told() -> None:
    distance = np.linalg.norm(places_mm(), axis=-1)
    hollow = LabelImage(((distance < RADIUS_MM) & (distance > 8)).astype(int), IMAGE.origin_m, IMAGE.axes_m)
    found = label_surface(hollow, 1, 8000)
    assert found.cavities_m3 == pytest.approx(4 / 3 * np.pi * 0.008**3, rel=0.05)
    assert enclosed_volume(found.surface) == pytest.approx(4 / 3 * np.pi * 0.02**3, rel=0.02)


def test_what_has_no_surface_is_refused() -> None:
    with pytest.raises(ValueError, match="label 5 is not in the image: it has 0, 2, 7"):
        label_surface(IMAGE, 5, 4000)
    line = np.zeros((20, 20, 20), np.uint8)
    line[5:15, 10, 10] = 1
    with pytest.raises(ValueError, match=r"too thin for voxels of \[1.0, 1.0, 1.0\] mm"):
        label_surface(LabelImage(line, np.zeros(3), np.eye(3) * 1e-3), 1, 4000)


def test_the_command_writes_a_surface_that_a_scene_takes_in_m(tmp_path: Path) -> None:
    write_nifti(tmp_path / "organ.nii.gz")
    command = [sys.executable, "-m", "palpate", "surface", "organ.nii.gz", "--label", "7", "-o", "half.ply"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=240, check=False)
    assert done.returncode == 0, done.stderr
    assert "left out 1 pieces of the label" in done.stdout
    assert "triangles, in m\n" in done.stdout
    surface = load_surface(tmp_path / "half.ply").surface
    assert enclosed_volume(surface) == pytest.approx(2 / 3 * np.pi * 0.02**3, rel=0.05)
    center = IMAGE.origin_m + IMAGE.axes_m @ CENTER
    np.testing.assert_allclose(surface.vertices.mean(axis=0), center - 0.375 * 0.02 * TURN[:, 0], atol=0.002)
