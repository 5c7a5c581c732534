"""Which nodes are held, which move as rigid tips, and which are free."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import csr_array, eye_array, hstack

from palpate.geometry.cloud import NodeCloud

Indices = NDArray[np.int64]


@dataclass(frozen=True)
class Supports:
    """A partition of the nodes.

    fixed     (n_fixed,), held at zero displacement
    contacts  one array of node indices a patch; the nodes of a patch move as one rigid tip, without rotation
    free      (n_free,), all others, ascending
    n_nodes   all together
    """

    fixed: Indices
    contacts: tuple[Indices, ...]
    free: Indices
    n_nodes: int

    @property
    def prescribed(self) -> Indices:
        """(n_fixed + nodes of all patches,), the nodes whose displacement is given."""
        return np.concatenate([self.fixed, *self.contacts])

    @property
    def tips(self) -> csr_array:
        """(n_nodes, n_contacts): 1 where a node belongs to a patch, so nodal values = tips @ tip values."""
        nodes = np.concatenate([np.zeros(0, np.int64), *self.contacts])
        patch = np.repeat(np.arange(len(self.contacts)), [len(c) for c in self.contacts])
        return csr_array((np.ones(len(nodes)), (nodes, patch)), shape=(self.n_nodes, len(self.contacts)))

    @property
    def kinematics(self) -> csr_array:
        """(n_nodes, n_free + n_contacts): nodal values from the values of the free nodes and of the tips."""
        free = eye_array(self.n_nodes, format="csr")[:, self.free]
        return csr_array(hstack([free, self.tips]))


def supports(n_nodes: int, fixed: ArrayLike, contacts: Sequence[ArrayLike]) -> Supports:
    """Check the node indices of the supports and patches and find the free nodes.

    Raises ValueError naming the argument when an index is out of range, used twice, or a patch is empty.
    """
    groups = {"fixed": fixed} | {f"contacts[{k}]": c for k, c in enumerate(contacts)}
    checked: dict[str, Indices] = {}
    owner = np.full(n_nodes, "", dtype=object)
    for name, group in groups.items():
        indices = np.asarray(group)
        if indices.size == 0:
            indices = np.zeros(0, np.int64)
        if indices.ndim != 1 or not np.issubdtype(indices.dtype, np.integer):
            raise ValueError(f"{name} is {indices.dtype} {indices.shape}: expected a list of node indices")
        outside = indices[(indices < 0) | (indices >= n_nodes)]
        if len(outside):
            raise ValueError(f"{name} holds node {outside[0]}: expected indices from 0 to {n_nodes - 1}")
        if name != "fixed" and not len(indices):
            raise ValueError(f"{name} is empty: expected at least one node")
        if len(np.unique(indices)) < len(indices):
            raise ValueError(f"{name} names a node twice: expected distinct indices")
        taken = indices[owner[indices] != ""]
        if len(taken):
            raise ValueError(
                f"node {taken[0]} is in {owner[taken[0]]} and in {name}: expected it in one of them"
            )
        owner[indices] = name
        checked[name] = indices.astype(np.int64)
    free = np.flatnonzero(owner == "")
    if not len(free):
        raise ValueError(f"all {n_nodes} nodes are fixed or in a contact patch: expected some to be free")
    fixed_nodes, *patches = checked.values()
    return Supports(fixed_nodes, tuple(patches), free, n_nodes)


def components(nodes: Indices, n: int) -> Indices:
    """(n len(nodes),): the indices of the nodes' n components each, where those of node 0 come first."""
    return (n * nodes[:, None] + np.arange(n)).ravel()


def require_volumes(cloud: NodeCloud) -> None:
    """Raises ValueError naming the first node that stands for no volume."""
    bad = np.flatnonzero(~(cloud.volumes > 0))
    if len(bad):
        raise ValueError(
            f"node {bad[0]} has volume {cloud.volumes[bad[0]]} m³: expected above 0 "
            "(two nodes at the same place, or one outside the body)"
        )
