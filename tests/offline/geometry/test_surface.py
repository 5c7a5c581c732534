"""Surfaces: what is read, and what is refused with which words."""

from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest
import trimesh

from palpate.geometry.cloud import TriangleSurface
from palpate.geometry.shapes import box_surface
from palpate.geometry.sharp_edges import sharp_edges
from palpate.geometry.surface import (
    SurfaceError,
    check_surface,
    enclosed_volume,
    load_surface,
    triangle_normals,
)

BOX = box_surface((0, 0, 0), (1, 2, 3))


def changed(vertices=BOX.vertices, triangles=BOX.triangles):
    return TriangleSurface(np.array(vertices, dtype=float), np.array(triangles, dtype=np.int32))


def two_boxes(second_lower, second_upper):
    other = box_surface(second_lower, second_upper)
    vertices = np.vstack([BOX.vertices, other.vertices])
    merged, index = np.unique(vertices, axis=0, return_inverse=True)
    triangles = index.ravel()[np.vstack([BOX.triangles, other.triangles + len(BOX.vertices)])]
    return changed(merged, triangles)


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
    "damaged": (changed(vertices=BOX.vertices[:-1]), r"damaged: triangles name vertices 0..7, expected 0..6"),
    "not finite": (
        with_vertex_moved((0, 0, 0), (0, np.nan, 0)),
        "not finite: 1 vertices, the first is number 0",
    ),
    "degenerate": (
        changed(triangles=np.vstack([BOX.triangles, [[0, 0, 1]]])),
        "degenerate: 1 triangles without area, the first is 12",
    ),
    "needle": (with_vertex_moved((1, 2, 3), (1, 2, 0)), "degenerate: .* triangles without area"),
    "open": (changed(triangles=BOX.triangles[1:]), r"open: 3 edges with one triangle, the first from vertex"),
    "non-manifold": (two_boxes((1, 2, 0), (2, 3, 3)), "not manifold: 1 edges with more than two triangles"),
    "inconsistent": (with_triangle_run_the_other_way(), "not oriented consistently: 3 edges"),
    "two bodies": (two_boxes((5, 5, 5), (6, 6, 6)), r"2 separate pieces, expected 1 .* 12 triangles near"),
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


@pytest.mark.parametrize("suffix", ["stl", "obj", "ply"])
@pytest.mark.parametrize("unit_m", [1.0, 1e-3])
def test_files_of_each_format_come_back_as_they_were(tmp_path, suffix, unit_m):
    path = tmp_path / f"box.{suffix}"
    trimesh.Trimesh(BOX.vertices, BOX.triangles, process=False).export(path)
    surface = load_surface(path, unit_m)
    assert len(surface.vertices) == 8
    np.testing.assert_array_equal(surface.vertices, np.unique(BOX.vertices, axis=0) * unit_m)
    assert surface.triangles.dtype == np.int32
    assert len(surface.triangles) == 12
    assert enclosed_volume(surface) == pytest.approx(6 * unit_m**3)


def test_a_refused_file_is_named_with_its_fault(tmp_path):
    path = tmp_path / "open.stl"
    trimesh.Trimesh(BOX.vertices, BOX.triangles[1:], process=False).export(path)
    with pytest.raises(SurfaceError, match=r"open\.stl: the surface is open: 3 edges"):
        load_surface(path)


def test_files_that_cannot_be_read_are_refused(tmp_path):
    with pytest.raises(FileNotFoundError, match="no such surface file"):
        load_surface(tmp_path / "missing.stl")
    foreign = tmp_path / "liver.step"
    foreign.write_text("ISO-10303-21;")
    with pytest.raises(SurfaceError, match=r"liver\.step: expected one of \.stl, \.obj, \.ply"):
        load_surface(foreign)
    for suffix in ("stl", "obj", "ply"):
        path = tmp_path / f"noise.{suffix}"
        path.write_bytes(bytes(range(256)))
        with pytest.raises(SurfaceError, match=f"noise.{suffix}: "):
            load_surface(path)
    with pytest.raises(ValueError, match="unit_m = 0"):
        load_surface(liver_path(), 0)


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
    surface = load_surface(liver_path())
    # 3,160,496 voxels of label 255, each 0.617188 x 0.617188 x 1.33333 mm.
    segmented = 3_160_496 * 0.617188e-3**2 * 1.33333e-3
    assert enclosed_volume(surface) == pytest.approx(segmented, rel=0.02)
    np.testing.assert_allclose(np.ptp(surface.vertices, axis=0), (0.206, 0.172, 0.152), atol=0.003)
    mesh = trimesh.Trimesh(surface.vertices, surface.triangles, process=False)
    np.testing.assert_allclose(mesh.center_mass, 0, atol=1e-6)
    assert mesh.euler_number == 2
    assert liver_path().stat().st_size < 200_000
