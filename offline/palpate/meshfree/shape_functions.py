"""Moving-least-squares shape functions and their full derivatives as sparse matrices (BaniHani & De 2009, Eq. 17-21)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from palpate.geometry.visibility import Gaps
from palpate.meshfree.kernel import Evaluated, Pairs, evaluate
from palpate.meshfree.neighbors import covering_nodes, covering_nodes_inside

SMALLEST_PIVOT = 1e-8
"""Below this relative Cholesky pivot of the moment matrix half of the digits are lost: the support counts as degenerate."""


class SupportError(ValueError):
    """A point is covered by too few nodes, or by nodes on a line, plane or quadric that the basis can't tell apart."""


@dataclass(frozen=True)
class ShapeFunctions:
    """h_J at a set of points; all matrices are (n_points, n_nodes) and share one sparsity pattern.

    value     h_J(x_i)
    gradient  dh_J/dx, dh_J/dy, dh_J/dz, 1/m; as many as the space has dimensions, or none if not asked for
    hessian   second derivatives, 1/m²: xx, yy, zz, xy, yz, zx in space, xx, yy, xy in the plane, xx on a line
    """

    value: csr_array
    gradient: tuple[csr_array, ...]
    hessian: tuple[csr_array, ...]


def shape_functions(
    points: NDArray[np.float64],
    nodes: NDArray[np.float64],
    radii: NDArray[np.float64],
    *,
    order: int = 1,
    derivatives: int = 0,
    gaps: Gaps | None = None,
) -> ShapeFunctions:
    """Evaluate the shape functions of all nodes at the points.

    points (n_points, dim), nodes (n_nodes, dim), m, with dim 1, 2 or 3; radii (n_nodes,), m, the nodes' support radii.
    order is the degree of the basis that is reproduced exactly, 1 or 2; derivatives is the highest derivative, 0 to 2.
    With gaps, a support ends where the way to it inside the body is longer than its radius (`covering_nodes_inside`).

    Raises SupportError naming the point where the support is too small or degenerate, ValueError on bad arguments.
    """
    points, nodes, radii = (np.ascontiguousarray(a, dtype=np.float64) for a in (points, nodes, radii))
    if nodes.ndim != 2 or nodes.shape[1] not in (1, 2, 3):
        raise ValueError(f"nodes has shape {nodes.shape}: expected (n_nodes, 1, 2 or 3)")
    n_nodes, dim = nodes.shape
    if points.ndim != 2 or points.shape[1] != dim:
        raise ValueError(f"points has shape {points.shape}: expected (n_points, {dim}) as the nodes have")
    if radii.shape != (n_nodes,) or not (np.all(np.isfinite(radii)) and np.all(radii > 0)):
        raise ValueError(f"radii of shape {radii.shape}: expected {n_nodes} finite numbers above 0")
    if order not in (1, 2):
        raise ValueError(f"order = {order}: expected 1 or 2")
    if derivatives not in (0, 1, 2):
        raise ValueError(f"derivatives = {derivatives}: expected 0, 1 or 2")
    for name, array in (("points", points), ("nodes", nodes)):
        if not np.all(np.isfinite(array)):
            raise ValueError(f"{name} holds numbers that are not finite")

    if gaps is None:
        indptr, indices = covering_nodes(points, nodes, radii)
        reach = radii[indices]
    else:
        (indptr, indices), reach = covering_nodes_inside(points, nodes, radii, gaps)
    n_second = dim * (dim + 1) // 2
    out = Evaluated(
        np.empty(len(indices)),
        np.empty((dim if derivatives >= 1 else 0, len(indices))),
        np.empty((n_second if derivatives >= 2 else 0, len(indices))),
        np.empty(len(points)),
    )
    evaluate(points, nodes, Pairs(indptr, indices, reach), order, derivatives, out)
    _require_regular_supports(points, np.diff(indptr), out.pivot, 1 + dim + (n_second if order == 2 else 0))

    def matrix(data: NDArray[np.float64]) -> csr_array:
        return csr_array((data, indices, indptr), shape=(len(points), n_nodes))

    return ShapeFunctions(matrix(out.value), tuple(map(matrix, out.first)), tuple(map(matrix, out.second)))


def _require_regular_supports(
    points: NDArray[np.float64], counts: NDArray[np.int32], pivot: NDArray[np.float64], size: int
) -> None:
    bad = np.flatnonzero((counts < size) | (pivot < SMALLEST_PIVOT))
    if not len(bad):
        return
    i = bad[0]
    where = f"point {i} at {np.array2string(points[i], precision=6, separator=', ')} is covered by {counts[i]} nodes"
    cause = (
        f"the basis needs at least {size}"
        if counts[i] < size
        else f"which are nearly degenerate for a basis of {size} (on one plane, for example; pivot {pivot[i]:.1e})"
    )
    raise SupportError(
        f"{where}, {cause} ({len(bad)} such points in all): enlarge the support radii or add nodes around it"
    )
