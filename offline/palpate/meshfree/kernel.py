"""The compiled loop that evaluates moving-least-squares shape functions: plain arrays in, plain arrays out."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

CHUNK = 64
"""Points that share one set of work arrays: large enough to hide the allocation, small enough to balance threads."""

# Sums over neighbors may be reordered (so that they vectorize); infinities and NaN keep their meaning.
REORDER = {"reassoc", "contract", "nsz"}


@njit(cache=True)
def quartic_spline(s: NDArray[np.float64]) -> NDArray[np.float64]:
    """W(s) = 1 - 6 s² + 8 s³ - 3 s⁴ for 0 <= s <= 1, Eq. 21; s any shape."""
    t = 1.0 - s
    return t * t * t * (1.0 + 3.0 * s)


class Pairs(NamedTuple):
    """The pairs of a point and a node whose support covers it, point by point.

    indptr (n_points + 1,), indices (nnz,): the nodes of each point, as in a sparse matrix
    reach   (nnz,), m, the support radius of each pair
    """

    indptr: NDArray[np.int32]
    indices: NDArray[np.int32]
    reach: NDArray[np.float64]


class Evaluated(NamedTuple):
    """What `evaluate` fills: value (nnz,), first (dim, nnz), second (dim (dim + 1) / 2, nnz), pivot (n_points,)."""

    value: NDArray[np.float64]
    first: NDArray[np.float64]
    second: NDArray[np.float64]
    pivot: NDArray[np.float64]


@njit(parallel=True, cache=True, fastmath=REORDER)
def evaluate(
    points: NDArray[np.float64],
    nodes: NDArray[np.float64],
    pairs: Pairs,
    order: int,
    derivatives: int,
    out: Evaluated,
) -> None:
    """Fill `out` with the shape functions at the points (n_points, dim) and their derivatives up to `derivatives`.

    With the basis p centered at the point and frozen there, h_J = w_J p_J^T c and A c = p, so differentiating A c = p
    gives every derivative from the same Cholesky factor, with A's own derivatives only ever applied:

        A c_a  = p_a  - sum_J w_J,a g_J p_J                                       g_J  = p_J^T c
        A c_ab = p_ab - sum_J (w_J,ab g_J + w_J,a g_J,b + w_J,b g_J,a) p_J        g_J,a = p_J^T c_a

    pivot is the smallest Cholesky pivot over its diagonal entry: 0 where A is singular (the row is then left unset).
    """
    # One function, long as it is: its steps share a dozen work arrays of a few kilobytes, which stay in the cache.
    indptr, indices, reach = pairs.indptr, pairs.indices, pairs.reach
    value, first, second, pivot = out.value, out.first, out.second, out.pivot
    n_points, dim = points.shape
    n_second = dim * (dim + 1) // 2
    size = 1 + dim if order == 1 else 1 + dim + n_second
    first_axis = np.empty(n_second, np.int64)
    second_axis = np.empty(n_second, np.int64)
    k = 0
    for a in range(dim):
        first_axis[k], second_axis[k] = a, a
        k += 1
    for a in range(dim if dim == 3 else dim - 1):  # xy, yz, zx in space, xy in the plane
        first_axis[k], second_axis[k] = a, (a + 1) % dim
        k += 1
    n_solves = 1
    if derivatives >= 1:
        n_solves += dim
    if derivatives >= 2:
        n_solves += n_second
    most = 0
    for i in range(n_points):
        most = max(most, indptr[i + 1] - indptr[i])

    for chunk in prange((n_points + CHUNK - 1) // CHUNK):
        weights = np.empty((n_solves, most))  # w, its first and its second derivatives, in scaled coordinates
        basis = np.empty((size, most))
        weighted = np.empty(most)
        g = np.empty((n_solves, most))
        factor = np.empty((size, size))
        c = np.empty((n_solves, size))
        for i in range(chunk * CHUNK, min((chunk + 1) * CHUNK, n_points)):
            start = indptr[i]
            count = indptr[i + 1] - start
            scale = 0.0
            for j in range(count):
                scale = max(scale, reach[start + j])
            for j in range(count):
                node = indices[start + j]
                ratio = scale / reach[start + j]
                squared = 0.0
                basis[0, j] = 1.0
                for a in range(dim):
                    y = (nodes[node, a] - points[i, a]) / scale
                    basis[1 + a, j] = y
                    squared += y * y
                s = min(np.sqrt(squared) * ratio, 1.0)
                t = 1.0 - s
                weights[0, j] = quartic_spline(s)
                if derivatives >= 1:
                    slope = -12.0 * t * t * ratio * ratio  # W'(s) / s
                    for a in range(dim):
                        weights[1 + a, j] = -slope * basis[1 + a, j]
                    if derivatives >= 2:
                        curvature = (
                            24.0 * t / max(s, 1e-300) * ratio**4
                        )  # (W'(s) / s)' / s; times y y it is 0 at s = 0
                        for k in range(n_second):
                            a, b = first_axis[k], second_axis[k]
                            weights[1 + dim + k, j] = curvature * basis[1 + a, j] * basis[1 + b, j]
                            if a == b:
                                weights[1 + dim + k, j] += slope
            if order == 2:
                for k in range(n_second):
                    a, b = first_axis[k], second_axis[k]
                    for j in range(count):
                        basis[1 + dim + k, j] = basis[1 + a, j] * basis[1 + b, j]

            smallest = 1.0
            for p in range(size):
                for j in range(count):
                    weighted[j] = weights[0, j] * basis[p, j]
                for q in range(p + 1):
                    total = 0.0
                    for j in range(count):
                        total += weighted[j] * basis[q, j]
                    factor[p, q] = total
            for p in range(size):
                diagonal = factor[p, p]
                for q in range(p):
                    total = factor[p, q]
                    for k in range(q):
                        total -= factor[p, k] * factor[q, k]
                    factor[p, q] = total * factor[q, q]  # the diagonal holds reciprocals
                rest = diagonal
                for q in range(p):
                    rest -= factor[p, q] * factor[p, q]
                if not rest > 1e-15 * diagonal:
                    smallest = 0.0
                    break
                smallest = min(smallest, rest / diagonal)
                factor[p, p] = 1.0 / np.sqrt(rest)
            pivot[i] = smallest
            if smallest == 0.0:
                continue

            begin = 0
            for level in range(derivatives + 1):
                end = 1 if level == 0 else 1 + dim if level == 1 else n_solves
                for r in range(begin, end):
                    for p in range(size):
                        c[r, p] = 0.0
                    if level == 0:
                        c[r, 0] = 1.0
                    elif level == 1:
                        c[r, r] = 1.0
                        for j in range(count):
                            weighted[j] = weights[r, j] * g[0, j]
                    else:
                        a, b = first_axis[r - 1 - dim], second_axis[r - 1 - dim]
                        if order == 2:
                            c[r, r] = 2.0 if a == b else 1.0
                        for j in range(count):
                            weighted[j] = (
                                weights[r, j] * g[0, j]
                                + weights[1 + a, j] * g[1 + b, j]
                                + weights[1 + b, j] * g[1 + a, j]
                            )
                    if level > 0:
                        for p in range(size):
                            total = 0.0
                            for j in range(count):
                                total += weighted[j] * basis[p, j]
                            c[r, p] -= total
                    for p in range(size):
                        total = c[r, p]
                        for q in range(p):
                            total -= factor[p, q] * c[r, q]
                        c[r, p] = total * factor[p, p]
                    for p in range(size - 1, -1, -1):
                        c[r, p] *= factor[p, p]
                        for q in range(p):
                            c[r, q] -= factor[p, q] * c[r, p]
                    for j in range(count):
                        g[r, j] = c[r, 0]
                    for p in range(1, size):
                        for j in range(count):
                            g[r, j] += c[r, p] * basis[p, j]
                    if level == 0:
                        for j in range(count):
                            value[start + j] = weights[0, j] * g[0, j]
                    elif level == 1:
                        for j in range(count):
                            first[r - 1, start + j] = (weighted[j] + weights[0, j] * g[r, j]) / scale
                    else:
                        for j in range(count):
                            second[r - 1 - dim, start + j] = (
                                weighted[j] + weights[0, j] * g[r, j]
                            ) / scale**2
                begin = end
