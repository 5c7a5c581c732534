"""Surfaces: what is read, and what is refused with which words."""

import re
from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest
import trimesh

from palpate.geometry.cloud import TriangleSurface
from palpate.geometry.measures import enclosed_volume, triangle_normals
from palpate.geometry.shapes import box_lattice
from palpate.geometry.sharp_edges import sharp_edges
from palpate.geometry.soundness import Naming, SurfaceError, check_surface
from palpate.geometry.surface import load_surface
from palpate.scene.quantities import UNITS_M

BOX = box_lattice((0, 0, 0), (1, 2, 3), (2, 2, 2)).surface


def changed(vertices=BOX.vertices, triangles=BOX.triangles):
    return TriangleSurface(np.array(vertices, dtype=float), np.array(triangles, dtype=np.int32))


def two_boxes(second_lower, second_upper):
    other = box_lattice(second_lower, second_upper, (2, 2, 2)).surface
    vertices = np.vstack([BOX.vertices, other.vertices])
    merged, index = np.unique(vertices, axis=0, return_inverse=True)
    triangles = index.ravel()[np.vstack([BOX.triangles, other.triangles + len(BOX.vertices)])]
    return changed(merged, triangles)


def boxes(*bounds):
    """Boxes from lower to upper corner; one given as (upper, lower) has its triangles turned, as a cavity's are."""
    vertices, triangles = [], []
    for k, (a, b) in enumerate(bounds):
        surface = box_lattice(min(a, b), max(a, b), (2, 2, 2)).surface
        vertices.append(surface.vertices)
        triangles.append((surface.triangles if a < b else surface.triangles[:, ::-1]) + 8 * k)
    return changed(np.vstack(vertices), np.vstack(triangles))


OUTER, HOLE, SECOND_HOLE = ((0, 0, 0), (9, 9, 9)), ((4, 4, 4), (1, 1, 1)), ((8, 8, 8), (5, 5, 5))


def with_vertex_moved(corner, to):
    vertices = BOX.vertices.copy()
    vertices[np.all(vertices == corner, axis=1)] = to
    return changed(vertices)


def with_triangle_run_the_other_way():
    triangles = BOX.triangles.copy()
    triangles[4] = triangles[4, ::-1]
    return changed(triangles=triangles)


REFUSED = {
    "empty": (changed(triangles=np.empty((0, 3))), "empty"),
    "degenerate": (
        changed(triangles=np.vstack([BOX.triangles, [[0, 0, 1]]])),
        "degenerate: 1 triangles without area, the first is 12",
    ),
    "needle": (with_vertex_moved((1, 2, 3), (1, 2, 0)), "degenerate: .* triangles without area"),
    "open": (changed(triangles=BOX.triangles[1:]), r"open: 3 edges with one triangle, the first from vertex"),
    "non-manifold": (two_boxes((1, 2, 0), (2, 3, 3)), "not manifold: 1 edges with more than two triangles"),
    "inconsistent": (with_triangle_run_the_other_way(), "not oriented consistently: 3 edges"),
    "two bodies": (two_boxes((5, 5, 5), (6, 6, 6)), r"2 separate pieces, expected 1: .* 12 triangles near"),
    "body in a cavity": (boxes(OUTER, HOLE, ((2, 2, 2), (3, 3, 3))), "1 pieces inside its cavities"),
    "cavity turned": (boxes(OUTER, HOLE[::-1], SECOND_HOLE), "1 cavities whose triangles face as the body's"),
    "inside-out with a cavity": (boxes(OUTER[::-1], HOLE[::-1]), "inside-out: it encloses -702 m³"),
    "inside-out": (changed(triangles=BOX.triangles[:, ::-1]), "inside-out: it encloses -6 m³"),
    "self-intersecting": (
        with_vertex_moved((0, 0, 0), (0.5, 1.0, 3.5)),
        "intersects itself: .* pairs of triangles",
    ),
}


@pytest.mark.parametrize("case", REFUSED)
def test_a_surface_that_bounds_no_body_is_refused_by_name(case):
    surface, message = REFUSED[case]
    with pytest.raises(SurfaceError, match=message):
        check_surface(surface)


def test_the_fault_is_located():
    # Twice the corner (0, 0, 0) and once (0, 0, 3).
    with pytest.raises(SurfaceError, match=r"near \(0, 0, 1\) m"):
        check_surface(REFUSED["degenerate"][0])


def test_a_sound_surface_passes():
    check_surface(BOX)
    assert enclosed_volume(BOX) == pytest.approx(6)
    normals, areas = triangle_normals(BOX)
    assert areas.sum() == pytest.approx(22)
    np.testing.assert_allclose(areas @ normals, 0, atol=1e-13)


@pytest.mark.parametrize("holes", [[HOLE], [HOLE, SECOND_HOLE]])
def test_closed_surfaces_inside_the_body_are_cavities(holes):
    surface = boxes(OUTER, *holes)
    check_surface(surface)
    assert enclosed_volume(surface) == pytest.approx(9**3 - 3**3 * len(holes))


@pytest.mark.parametrize("suffix", ["stl", "obj", "ply"])
@pytest.mark.parametrize("unit", ["m", "mm"])
def test_files_of_each_format_come_back_as_they_were(tmp_path, suffix, unit):
    path = tmp_path / f"box.{suffix}"
    trimesh.Trimesh(BOX.vertices, BOX.triangles, process=False).export(path)
    loaded = load_surface(path, unit)
    surface, unit_m = loaded.surface, UNITS_M[unit]
    assert loaded.notes == ()
    assert len(surface.vertices) == 8
    np.testing.assert_array_equal(surface.vertices, np.unique(BOX.vertices, axis=0) * unit_m)
    assert surface.triangles.dtype == np.int32
    assert len(surface.triangles) == 12
    assert enclosed_volume(surface) == pytest.approx(6 * unit_m**3)


def test_all_faults_of_a_file_are_told_at_once_in_its_numbers_and_unit(tmp_path):
    path = tmp_path / "bad.obj"
    vertices = np.vstack([BOX.vertices * 1000, BOX.vertices * 1000 + 9000])
    triangles = np.vstack([BOX.triangles[1:], BOX.triangles + 8])
    lines = ["v {} {} {}".format(*v) for v in vertices] + ["f {} {} {}".format(*t) for t in triangles + 1]
    path.write_text("\n".join(lines))
    with pytest.raises(SurfaceError) as caught:
        load_surface(path, "mm")
    open_, pieces = str(caught.value).splitlines()
    assert open_.startswith(f"{path}: the surface is open: 3 edges with one triangle, the first from vertex ")
    first, second = (int(word) - 1 for word in re.findall(r"from vertex (\d+) to (\d+)", open_)[0])
    assert {first, second} < set(BOX.triangles[0])
    x, y, z = vertices[[first, second]].mean(axis=0)
    assert (
        f"near ({x:g}, {y:g}, {z:g}) mm = ({x / 1000:g}, {y / 1000:g}, {z / 1000:g}) m. To mend: palpate repair {path} -o "
        in open_
    )
    assert "2 separate pieces" in pieces
    assert "To mend: " in pieces


def test_triangles_that_share_no_vertices_are_one_fault():
    corners = BOX.vertices[BOX.triangles].reshape(-1, 3)
    apart = corners * (1 + 1e-3 * np.arange(len(corners))[:, None])
    with pytest.raises(SurfaceError, match=r"36 of its 36 edges .* To mend: palpate repair") as caught:
        check_surface(changed(apart, np.arange(len(corners)).reshape(-1, 3)))
    assert len(str(caught.value).splitlines()) == 1


@pytest.mark.parametrize("corners", [3, 4, 6])
@pytest.mark.parametrize("size", [1e-300, 1e-9, 1e9, 1e29])
@pytest.mark.filterwarnings("error")
def test_a_size_that_no_body_has_is_one_plain_error(tmp_path, size, corners):
    path = tmp_path / "prism.obj"
    turn = 2 * np.pi * np.arange(corners) / corners
    ring = size * np.column_stack([np.cos(turn), np.sin(turn), np.zeros(corners)])
    below, above = (ring + np.array([0, 0, z * size]) for z in (-1.5, 1.5))
    side = np.arange(corners)
    faces = [side[::-1], side + corners]
    faces += [np.array([i, (i + 1) % corners, (i + 1) % corners + corners, i + corners]) for i in side]
    lines = ["v {} {} {}".format(*v) for v in np.vstack([below, above])]
    path.write_text("\n".join(lines + ["f " + " ".join(map(str, face + 1)) for face in faces]))
    with pytest.raises(
        SurfaceError, match=re.escape(f"is {3 * size:.3g} m across: expected 1e-06 to 10000 m")
    ) as caught:
        load_surface(path)
    assert len(str(caught.value).splitlines()) == 1


def test_a_naming_says_places_in_metres_once():
    assert Naming().place(np.array([1.0, 0.0, 0.5])) == "(1, 0, 0.5) m"


def test_files_that_cannot_be_read_are_refused(tmp_path):
    with pytest.raises(FileNotFoundError, match="no such surface file"):
        load_surface(tmp_path / "missing.stl")
    for suffix in ("stl", "obj", "ply"):
        path = tmp_path / f"noise.{suffix}"
        path.write_bytes(bytes(range(256)))
        with pytest.raises(SurfaceError, match=f"noise.{suffix}: "):
            load_surface(path)


def test_a_box_has_twelve_sharp_edges_and_eight_corners():
    edges, corners = sharp_edges(BOX)
    assert len(edges) == 12
    assert len(corners) == 8


def test_a_cylinder_has_two_sharp_rims_without_corners():
    mesh = trimesh.creation.cylinder(radius=1, height=2, sections=24)
    surface = TriangleSurface(np.asarray(mesh.vertices), np.asarray(mesh.faces, dtype=np.int32))
    edges, corners = sharp_edges(surface)
    assert len(edges) == 48
    assert len(corners) == 0


def liver_path() -> Path:
    return Path(str(files("palpate_configs") / "liver.ply"))


def test_the_shipped_liver_is_sound_and_as_large_as_its_segmentation():
    surface = load_surface(liver_path()).surface
    # 3,160,496 voxels of label 255, each 0.617188 x 0.617188 x 1.33333 mm.
    segmented = 3_160_496 * 0.617188e-3**2 * 1.33333e-3
    assert enclosed_volume(surface) == pytest.approx(segmented, rel=0.02)
    np.testing.assert_allclose(np.ptp(surface.vertices, axis=0), (0.206, 0.172, 0.152), atol=0.003)
    mesh = trimesh.Trimesh(surface.vertices, surface.triangles, process=False)
    np.testing.assert_allclose(mesh.center_mass, 0, atol=1e-6)
    assert mesh.euler_number == 2
    assert liver_path().stat().st_size < 200_000
