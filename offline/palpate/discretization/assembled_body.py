"""The body after discretization: sparse matrices and supports, nothing solved."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from palpate.discretization.nodal import NodalBasis
from palpate.discretization.supports import Supports


@dataclass(frozen=True)
class AssembledBody:
    """What every solver takes: the balance of forces at the nodes of a supported body.

    The unknowns are the parameters U of the shape functions, with nodal displacements u = H U. With W the viscoelastic
    image of U (Eq. 7-9 of BaniHani & De 2009), the nodal masses m, and f the forces that supports and tips exert,

        symmetric:      H^T (m u'' - f) + stiffness W = 0
        not symmetric:       m u'' - f  + stiffness W = 0

    so row I of a symmetric body is weighted with the shape function of node I, and row I of a collocated one is the
    balance at node I itself. f is zero at free nodes.

    basis      shape functions of the nodes, H
    stiffness  (c n_nodes, c n_nodes), N/m at rest, c components a node, those of node 0 first; acts on parameters
    mass       (n_nodes,), kg, of each component; zero where the row has no inertia (a free surface by `collocation`).
               Supports and tips hold their nodes, whose mass has no effect
    supports   which nodes are held, which move as rigid tips, which are free
    symmetric  whether stiffness is symmetric and its rows are weighted with the shape functions
    """

    basis: NodalBasis
    stiffness: csr_array
    mass: NDArray[np.float64]
    supports: Supports
    symmetric: bool

    def scaled(self, stiffness: float, mass: float) -> AssembledBody:
        """With so many times the stiffness and the mass: from unit constants to those of a material."""
        return replace(self, stiffness=self.stiffness * stiffness, mass=self.mass * mass)

    def inertia(self, parameters: NDArray[np.float64]) -> NDArray[np.float64]:
        """(c n_nodes, k): M U = Hᵀ m H U of a symmetric body, for parameters (c n_nodes, k)."""
        mass = np.repeat(self.mass, self.n_components)[:, None]
        return self.basis.loads(mass * self.basis.values(parameters))

    @property
    def n_nodes(self) -> int:
        return len(self.mass)

    @property
    def n_components(self) -> int:
        """Displacement components a node: 3 of a solid, 1 of a membrane."""
        return self.stiffness.shape[0] // self.n_nodes
