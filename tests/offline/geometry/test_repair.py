"""Surfaces with faults are mended, or refused with what can't be; the mended file is one that a scene accepts."""

from __future__ import annotations

import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import trimesh

from palpate.geometry.fill import fill_surface
from palpate.geometry.holes import close, rims
from palpate.geometry.measures import enclosed_volume
from palpate.geometry.ply import ply_bytes
from palpate.geometry.repair import repair_surface
from palpate.geometry.soundness import SurfaceError
from palpate.geometry.surface import load_surface

CASES = Path(__file__).parents[2] / "data" / "cases"
BALL = trimesh.creation.icosphere(subdivisions=3, radius=50.0)
VERTICES, TRIANGLES = np.asarray(BALL.vertices), np.asarray(BALL.faces, np.int64)
N = len(VERTICES)


def written(folder: Path, vertices: np.ndarray, triangles: np.ndarray) -> Path:
    path = folder / "body.ply"
    path.write_bytes(ply_bytes(np.asarray(vertices, float), np.asarray(triangles)))
    return path


def mended(path: Path, folder: Path) -> tuple[float, str]:
    """Volume of the mended surface, in the file's unit cubed, and what was changed."""
    data, changes = repair_surface(path)
    (folder / "mended.ply").write_bytes(data)
    loaded = load_surface(folder / "mended.ply")
    assert loaded.notes == ()
    return enclosed_volume(loaded.surface), "\n".join(changes)


def crumb() -> tuple[np.ndarray, np.ndarray]:
    return np.vstack([VERTICES, VERTICES[:12] * 0.01 + 90]), np.vstack([TRIANGLES, [[N, N + 1, N + 2]]])


def with_flat_triangle() -> tuple[np.ndarray, np.ndarray]:
    """The first edge gets a vertex in its middle on one side only, and a flat triangle closes the slit."""
    a, b, c = TRIANGLES[0]
    middle = (VERTICES[a] + VERTICES[b]) / 2
    return np.vstack([VERTICES, [middle]]), np.vstack([TRIANGLES[1:], [[a, N, c], [N, b, c], [a, b, N]]])


def with_flap() -> tuple[np.ndarray, np.ndarray]:
    a, b, _ = TRIANGLES[0]
    return np.vstack([VERTICES, [[0, 0, 0]]]), np.vstack([TRIANGLES, [[a, b, N]]])


def with_sheet_inside() -> tuple[np.ndarray, np.ndarray]:
    """A square with 15 % of the body's area, through its center."""
    corners = [[-35.0, -35.0, 0.0], [35.0, -35.0, 0.0], [35.0, 35.0, 0.0], [-35.0, 35.0, 0.0]]
    return np.vstack([VERTICES, corners]), np.vstack([TRIANGLES, [[N, N + 1, N + 2], [N, N + 2, N + 3]]])


def with_fold() -> tuple[np.ndarray, np.ndarray]:
    vertices = VERTICES.copy()
    vertices[100] *= -0.2  # through the body's center, not to the other side
    vertices[100] += 1.3 * VERTICES[200]
    return vertices, TRIANGLES


FAULTS: dict[str, tuple[Callable[[], tuple[np.ndarray, np.ndarray]], str]] = {
    "crumb": (crumb, "left out pieces apart from the body: 1, of 1 triangles"),
    "hole": (lambda: (VERTICES, TRIANGLES[5:]), "closed holes: "),
    "duplicate": (lambda: (VERTICES, np.vstack([TRIANGLES, TRIANGLES[:7]])), "left out 7 triangles with the vertices of"),
    "double-sided": (lambda: (VERTICES, np.vstack([TRIANGLES, TRIANGLES[:, ::-1]])), f"left out {len(TRIANGLES):,} triangles"),
    "turned": (lambda: (VERTICES, np.vstack([TRIANGLES[:30, ::-1], TRIANGLES[30:]])), "turned 30 triangles against"),
    "inside-out": (lambda: (VERTICES, TRIANGLES[:, ::-1]), "inside-out"),
    "flat": (with_flat_triangle, "without area: 1 by exchanging an edge"),
    "flap": (with_flap, "cut the surface at 1 edges with more than two triangles"),
    "fold": (with_fold, "triangles that intersect others"),
    "apart": (
        lambda: (VERTICES[TRIANGLES].reshape(-1, 3) * (1 + 1e-6 * (np.arange(3 * len(TRIANGLES)) % 7)[:, None]),
                 np.arange(3 * len(TRIANGLES)).reshape(-1, 3)),
        "merged .* vertices",
    ),
}  # fmt: skip


@pytest.mark.parametrize("fault", FAULTS)
def test_each_fault_is_mended_and_told(tmp_path: Path, fault: str) -> None:
    make, words = FAULTS[fault]
    path = written(tmp_path, *make())
    before = path.read_bytes()
    volume, changes = mended(path, tmp_path)
    assert re.search(words, changes), changes
    assert volume == pytest.approx(BALL.volume, rel=0.01)
    assert path.read_bytes() == before


def test_a_sound_surface_stays_as_it_is(tmp_path: Path) -> None:
    volume, changes = mended(written(tmp_path, VERTICES, TRIANGLES), tmp_path)
    assert volume == pytest.approx(BALL.volume, rel=1e-12)
    assert changes.startswith("nothing to mend")


@pytest.mark.parametrize(
    "name", ["geo-crumb-outside.stl", "geo-hole.stl", "geo-inside-out.stl", "geo-near-duplicate-vertices.obj"]
)
def test_the_cases_are_mended_and_fill_with_nodes(tmp_path: Path, name: str) -> None:
    good = enclosed_volume(load_surface(CASES / "good-ellipsoid.stl").surface)
    volume, _ = mended(CASES / name, tmp_path)
    assert volume == pytest.approx(good, rel=0.005)
    surface = load_surface(tmp_path / "mended.ply", "mm").surface
    assert fill_surface(surface, 0.012).volumes.sum() == pytest.approx(good * 1e-9, rel=0.005)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: (np.vstack([VERTICES, VERTICES + 200]), np.vstack([TRIANGLES, TRIANGLES + N])), "more than one body"),
        (lambda: (VERTICES, TRIANGLES[VERTICES[TRIANGLES][:, :, 2].mean(axis=1) > 0]), "its 1 holes have 5.* % of its area"),
        (with_sheet_inside, "a sheet inside the body encloses nothing"),
    ],
    ids=["two bodies", "half a body", "sheet inside"],
)  # fmt: skip
def test_what_can_not_be_mended_is_refused(
    tmp_path: Path, make: Callable[[], tuple[np.ndarray, np.ndarray]], words: str
) -> None:
    path = written(tmp_path, *make())
    with pytest.raises(SurfaceError, match=f"could not be mended: .*{words}"):
        repair_surface(path)


def test_a_hole_is_closed_by_the_least_area() -> None:
    # A saddle of four vertices has two triangulations; a flat concave outline has the area that it encloses.
    saddle = np.array([[0, 0, 0], [1, 0, 1], [1, 1, 0], [0, 1, 3.0]])
    areas = []
    for split in ([[0, 1, 2], [0, 2, 3]], [[0, 1, 3], [1, 2, 3]], close(saddle, np.arange(4))):
        a, b, c = np.moveaxis(saddle[np.array(split)], 1, 0)
        areas.append(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2)
    assert areas[2] == pytest.approx(min(areas[:2]), rel=1e-12)
    ell = np.array([[0, 0, 0], [3, 0, 0], [3, 1, 0], [1, 1, 0], [1, 2, 0], [0, 2, 0.0]])
    a, b, c = np.moveaxis(ell[close(ell, np.arange(6))], 1, 0)
    assert np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2 == pytest.approx(4, rel=1e-12)


def test_rims_run_so_that_their_caps_close_the_surface() -> None:
    open_ = TRIANGLES[~np.any(np.isin(TRIANGLES, [0, 200]), axis=1)]
    caps = [close(VERTICES, rim) for rim in rims(open_)]
    whole = trimesh.Trimesh(VERTICES, np.vstack([open_, *caps]), process=False)
    assert whole.is_watertight
    assert whole.is_winding_consistent


def palpate(*arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "palpate", "repair", *arguments]
    return subprocess.run(command, capture_output=True, text=True, timeout=240, check=False)


def test_the_command_says_what_it_changed_and_never_overwrites_its_input(tmp_path: Path) -> None:
    path = written(tmp_path, *crumb())
    before = path.read_bytes()
    done = palpate(str(path), "-o", str(tmp_path / "out.ply"))
    assert done.returncode == 0, done.stderr
    assert "left out pieces apart from the body: 1" in done.stdout
    assert f"wrote {tmp_path / 'out.ply'}" in done.stdout
    refused = palpate(str(path), "-o", str(path))
    assert refused.returncode == 2
    assert "is an input of this command" in refused.stderr
    assert path.read_bytes() == before
    assert "ends in .ply" in palpate(str(path), "-o", str(tmp_path / "out.stl")).stderr
    assert sorted(p.name for p in tmp_path.iterdir()) == ["body.ply", "out.ply"]
