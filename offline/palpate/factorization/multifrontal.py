"""Cholesky's factorization of a sparse matrix whose unknowns have places in space, by LAPACK on dense fronts.

Nested dissection (George 1973): a plane divides the nodes into two halves. The nodes of one half that are coupled to the other
are eliminated after both; each half is divided again. A front is the dense matrix of the unknowns that are eliminated together and of
the later ones that they are coupled to. Their elimination changes the matrix of the later ones; this update is added to the
parent's front (the multifrontal method: Duff & Reid 1983, Liu 1992). So LAPACK and BLAS do nearly all the arithmetic.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.linalg.blas import dsyrk, dtrsm
from scipy.linalg.lapack import dpotrf
from scipy.sparse import bsr_array, csr_array

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

_LEAF = 150
"""Number of nodes up to which they are not divided."""


@dataclass(frozen=True)
class Dissection:
    """An order of elimination.

    order     (n_nodes,): the node that is eliminated at each place
    starts    (n_fronts + 1,): front k eliminates the places starts[k] to starts[k + 1]
    children  of each front, all before it
    """

    order: Indices
    starts: Indices
    children: tuple[tuple[int, ...], ...]


@dataclass(frozen=True)
class _Front:
    """Columns of the factor: diagonal (m, m), lower triangle; below (k, m); border (k,), their rows, ascending."""

    diagonal: Array
    below: Array
    border: Indices


class MultifrontalCholesky:
    """The factor of a symmetric positive definite matrix. Raises LinAlgError where it is not definite.

    nnz         entries of the factor
    n_negative  negative eigenvalues of the matrix: none
    """

    n_negative = 0

    def __init__(self, terms: tuple[csr_array, ...], points: Array) -> None:
        """The sum of the terms (n, n); points (n_nodes, dim): places of the nodes, n / n_nodes unknowns each, in sequence."""
        block = terms[0].shape[0] // len(points)
        dissection = dissect(_of_nodes(terms, block), points)
        self._order = (block * dissection.order[:, None] + np.arange(block)).ravel()
        starts = block * dissection.starts
        self._fronts = _factorized(terms, self._order, starts, dissection.children)
        self._columns = [slice(*pair) for pair in pairwise(starts)]
        self.nnz = sum(f.diagonal.size + f.below.size for f in self._fronts)

    def solve(self, right: Array) -> Array:
        """(n, k) for right-hand sides (n, k)."""
        x = right[self._order]
        # Of few right-hand sides BLAS multiplies the transposes twice as fast.
        for columns, front in zip(self._columns, self._fronts, strict=True):
            x[columns] = dtrsm(1.0, front.diagonal, x[columns], lower=1)
            x[front.border] -= (x[columns].T @ front.below.T).T
        for columns, front in zip(reversed(self._columns), reversed(self._fronts), strict=True):
            known = x[columns] - (x[front.border].T @ front.below).T
            x[columns] = dtrsm(1.0, front.diagonal, known, lower=1, trans_a=1)
        solution = np.empty_like(x)
        solution[self._order] = x
        return solution


def _of_nodes(terms: tuple[csr_array, ...], block: int) -> csr_array:
    """(n_nodes, n_nodes), symmetric: 1 and more where two nodes are coupled."""
    n = terms[0].shape[0] // block
    graph = csr_array((n, n))
    for term in terms:
        blocks = term if block == 1 else bsr_array(term, blocksize=(block, block))
        graph = graph + csr_array((np.ones(len(blocks.indices)), blocks.indices, blocks.indptr), shape=(n, n))
    return csr_array(graph + graph.T)


def dissect(graph: csr_array, points: Array) -> Dissection:
    """An order of elimination by planes across the longest side of the nodes' bounding box, with equally many nodes on both sides.

    graph (n, n), symmetric, not negative: above 0 where two nodes are coupled; points (n, dim), m.
    """
    pieces: list[Indices] = []
    children: list[tuple[int, ...]] = []

    def divide(nodes: Indices) -> int:
        below, between, above = (
            _divided(graph, points, nodes) if len(nodes) > _LEAF else (nodes[:0], nodes, nodes[:0])
        )
        parts = tuple(divide(half) for half in (below, above) if len(half))
        pieces.append(between)
        children.append(parts)
        return len(pieces) - 1

    divide(np.arange(graph.shape[0]))
    starts = np.concatenate([[0], np.cumsum([len(piece) for piece in pieces])])
    return Dissection(np.concatenate(pieces), starts, tuple(children))


def _divided(graph: csr_array, points: Array, nodes: Indices) -> tuple[Indices, Indices, Indices]:
    """The nodes below a plane, those above that are coupled to one below, and the others above."""
    axis = int(np.argmax(np.ptp(points[nodes], axis=0)))
    nodes = nodes[np.argsort(points[nodes, axis], kind="stable")]
    rows = graph[nodes]
    n_between = 0
    for _ in range(2):  # the second time so that, without those between, the halves are equal
        n_below = max(1, (len(nodes) - n_between) // 2)
        is_below = np.zeros(graph.shape[0])
        is_below[nodes[:n_below]] = 1
        coupled = (rows @ is_below)[n_below:] > 0
        n_between = int(np.count_nonzero(coupled))
    above = nodes[n_below:]
    return nodes[:n_below], above[coupled], above[~coupled]


def _factorized(
    terms: tuple[csr_array, ...], order: Indices, starts: Indices, children: tuple[tuple[int, ...], ...]
) -> list[_Front]:
    """The fronts in the order of elimination. A front's update is freed when its parent is assembled."""
    place = np.empty(len(order), np.int64)
    place[order] = np.arange(len(order))
    fronts: list[_Front] = []
    updates: dict[int, Array] = {}
    for start, stop, below in zip(starts[:-1], starts[1:], children, strict=True):
        entries = [_entries(term[order[start:stop]], place, start) for term in terms]
        known = [fronts[child].border for child in below]
        border = np.unique(np.concatenate([*(columns for _, columns, _ in entries), *known]))
        border = border[border >= stop]
        m, k = int(stop - start), len(border)
        diagonal, coupling, update = (np.zeros(shape, order="F") for shape in ((m, m), (k, m), (k, k)))
        for row, column, value in entries:
            own = column < stop
            diagonal[column[own] - start, row[own]] += value[own]
            coupling[np.searchsorted(border, column[~own]), row[~own]] += value[~own]
        for child, rows in zip(below, known, strict=True):
            added = updates.pop(child)
            n = int(np.searchsorted(rows, stop))
            inner, outer = rows[:n] - start, np.searchsorted(border, rows[n:])
            _add(diagonal, added[:n, :n], inner, inner)
            _add(coupling, added[n:, :n], outer, inner)
            _add(update, added[n:, n:], outer, outer)
        diagonal, info = dpotrf(diagonal, lower=1, overwrite_a=1)
        if info:
            raise np.linalg.LinAlgError(
                f"Cholesky: pivot {start + info} of {len(order):,} is not positive: the matrix is not definite"
            )
        if k:  # BLAS refuses empty matrices
            coupling = dtrsm(1.0, diagonal, coupling, side=1, lower=1, trans_a=1, overwrite_b=1)
            update = dsyrk(-1.0, coupling, beta=1.0, c=update, lower=1, overwrite_c=1)
        updates[len(fronts)] = update
        fronts.append(_Front(diagonal, coupling, border))
    return fronts


def _entries(rows: csr_array, place: Indices, start: int) -> tuple[Indices, Indices, Array]:
    """Row, place of the column and value of each entry of the rows whose column is not eliminated before them."""
    row = np.repeat(np.arange(rows.shape[0]), np.diff(rows.indptr))
    column = place[rows.indices]
    kept = column >= start
    return row[kept], column[kept], rows.data[kept]


@njit(cache=True)
def _add(target: Array, added: Array, rows: Indices, columns: Indices) -> None:
    """target[rows, columns] += added. Of symmetric matrices only the lower triangle is used."""
    for j in range(len(columns)):
        for i in range(len(rows)):
            target[rows[i], columns[j]] += added[i, j]
