"""A body with a slit, which several rooms must not reach across."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from palpate.geometry.cloud import NodeCloud, TriangleSurface
from palpate.geometry.fill import fill_surface


def _two_prongs(gap_m: float) -> TriangleSurface:
    """A block of 60 x 40 x 30 mm with a slit along x from 15 mm to its end, in the middle of y."""
    low, high = 0.02 - gap_m / 2, 0.02 + gap_m / 2
    outline = np.array(
        [
            (0, 0),
            (0.06, 0),
            (0.06, low),
            (0.015, low),
            (0.015, high),
            (0.06, high),
            (0.06, 0.04),
            (0, 0.04),
        ]
    )
    n = len(outline)
    bottom, top = (np.column_stack([outline, np.full(n, z)]) for z in (0.0, 0.03))
    faces = [(0, 1, 2), (0, 2, 3), (0, 3, 4), (0, 4, 7), (4, 5, 6), (4, 6, 7)]
    triangles = [(a, c, b) for a, b, c in faces] + [(a + n, b + n, c + n) for a, b, c in faces]
    for i in range(n):
        j = (i + 1) % n
        triangles += [(i, j, j + n), (i, j + n, i + n)]
    return TriangleSurface(np.vstack([bottom, top]), np.array(triangles, np.int32))


@pytest.fixture(scope="session")
def two_prongs() -> Callable[[float], TriangleSurface]:
    """From the width of the gap, m, to the surface."""
    return _two_prongs


@pytest.fixture(scope="session")
def prongs() -> NodeCloud:
    """The two prongs 2 mm apart, nodes 6 mm apart."""
    return fill_surface(_two_prongs(0.002), 0.006)
