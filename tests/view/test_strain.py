"""Strain of a surface: deformations whose stretches are known."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from palpate_view.strain import SurfaceStrain


@pytest.fixture(scope="module")
def ball() -> trimesh.Trimesh:
    return trimesh.creation.icosphere(subdivisions=3, radius=0.05)


def strain_of(mesh: trimesh.Trimesh, deformed: np.ndarray) -> np.ndarray:
    return SurfaceStrain(np.asarray(mesh.vertices), np.asarray(mesh.faces, np.int32)).largest(deformed)


def test_a_body_that_is_only_moved_and_turned_has_none(ball: trimesh.Trimesh) -> None:
    turned = Rotation.from_rotvec([0.5, 1.0, 1.5]).apply(ball.vertices)
    assert strain_of(ball, turned + 0.3).max() < 1e-12


@pytest.mark.parametrize("factor", [1.1, 0.9])
def test_a_body_that_grows_or_shrinks_has_it_everywhere(ball: trimesh.Trimesh, factor: float) -> None:
    np.testing.assert_allclose(strain_of(ball, ball.vertices * factor), 0.1, rtol=1e-9)


@pytest.mark.parametrize(
    ("gradient", "largest"),
    [
        ([[1.05, 0.0], [0.0, 0.98]], 0.05),
        ([[1.01, 0.0], [0.0, 0.9]], 0.1),
        # Simple shear by g: the stretches are sqrt(1 + g²/4) ± g/2.
        ([[1.0, 0.2], [0.0, 1.0]], np.sqrt(1.01) + 0.1 - 1),
    ],
)
def test_a_plane_has_the_larger_of_its_two_principal_strains(
    gradient: list[list[float]], largest: float
) -> None:
    x, y = (grid.ravel() for grid in np.meshgrid(np.linspace(0, 1, 5), np.linspace(0, 1, 4)))
    flat = np.stack([x + 0.1 * y, y, 0 * x], axis=1)
    corners = np.add.outer([0, 5, 10], np.arange(4)).ravel()
    faces = np.concatenate([corners[:, None] + [0, 1, 6], corners[:, None] + [0, 6, 5]]).astype(np.int32)
    deformed = flat.copy()
    deformed[:, :2] = flat[:, :2] @ np.array(gradient).T
    np.testing.assert_allclose(SurfaceStrain(flat, faces).largest(deformed), largest, rtol=1e-9)


def test_a_triangle_that_is_a_line_counts_for_nothing() -> None:
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [2, 0, 0]], float)
    faces = np.array([[0, 1, 2], [0, 1, 3], [0, 0, 1]], np.int32)
    np.testing.assert_allclose(SurfaceStrain(vertices, faces).largest(2 * vertices), [1, 1, 1, 0])


def test_a_vertex_has_the_mean_of_its_triangles_by_their_areas() -> None:
    """One of two triangles is stretched, and has twice the area."""
    vertices = np.array([[0, 0, 0], [0, 1, 0], [2, 0, 0], [-1, 0, 0]], float)
    faces = np.array([[0, 2, 1], [0, 1, 3]], np.int32)
    deformed = vertices * [1.3, 1, 1]
    deformed[3] = vertices[3]
    np.testing.assert_allclose(SurfaceStrain(vertices, faces).largest(deformed), [0.2, 0.2, 0.3, 0])
