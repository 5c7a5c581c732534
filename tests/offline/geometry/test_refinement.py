"""A refined surface is the same shape with shorter edges and no cracks."""

from __future__ import annotations

import numpy as np
import trimesh

from palpate.geometry.cloud import TriangleSurface
from palpate.geometry.refinement import refine_surface


def test_refining_keeps_the_shape_closed_and_honours_the_lengths() -> None:
    ball = trimesh.creation.icosphere(subdivisions=2, radius=1.0)
    top = np.array([0.0, 0.0, 1.0])

    def longest(points: np.ndarray) -> np.ndarray:
        return 0.05 + 0.3 * np.linalg.norm(points - top, axis=1)

    refined = refine_surface(
        TriangleSurface(np.array(ball.vertices), np.array(ball.faces, np.int32)), longest
    )
    mesh = trimesh.Trimesh(refined.vertices, refined.triangles, process=False)
    assert mesh.is_watertight
    assert mesh.is_winding_consistent
    np.testing.assert_allclose([mesh.volume, mesh.area], [ball.volume, ball.area], rtol=1e-12)
    ends = refined.vertices[mesh.edges_unique]
    assert np.all(np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1) <= longest(ends.mean(axis=1)))
    assert len(refined.triangles) > len(ball.faces)
    assert np.all(mesh.area_faces > 0)


def test_a_surface_that_is_fine_enough_stays_as_it_is() -> None:
    box = trimesh.creation.box()
    surface = TriangleSurface(np.array(box.vertices), np.array(box.faces, np.int32))
    refined = refine_surface(surface, lambda points: np.full(len(points), 10.0))
    np.testing.assert_array_equal(refined.triangles, surface.triangles)
