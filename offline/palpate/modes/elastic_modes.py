"""The elastic modes of a supported body seen from its contact patches: what a discretization hands to the reduction."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class ElasticModes:
    """Modes of the body, held at its supports and contact patches, and their coupling to the patches.

    With patch displacements u (n_inputs,), modal coordinates q (n_modes,) and the Prony factor h(s):

        s² q + h(s) diag(squared_frequencies) q = -h(s) input_coupling u
        force = h(s) (direct_stiffness u + output_coupling q)
        parameters of the displacement field: parameters q + patch_parameters u

    so force(s) = h(s) [K_tt - sum_k c_k b_k^T h(s) / (s² + mu_k h(s))] u(s). The patch's own inertia is dropped.

    squared_frequencies  (n_modes,), (rad/s)²; real and ascending for `conservative`, else complex, ascending in size
    input_coupling       (n_modes, n_inputs), b_k, mass-normalized
    output_coupling      (n_outputs, n_modes), c_k; the transpose of input_coupling for `conservative`
    direct_stiffness     (n_outputs, n_inputs), K_tt, N/m at rest
    parameters           (3 n_nodes, n_modes), x, y, z of node 0, then of node 1, ...; m per unit q. The basis of the body
                         gives the field anywhere from them
    patch_parameters     (3 n_nodes, n_inputs), m per m: nodal values are one on the patch, zero elsewhere; with
                         `collocation` the traction-free surface follows the patch at once, and its part stands here too

    Inputs and outputs run over the contact patches in order, x, y, z each.
    """

    squared_frequencies: NDArray[np.float64] | NDArray[np.complex128]
    input_coupling: NDArray[np.float64] | NDArray[np.complex128]
    output_coupling: NDArray[np.float64] | NDArray[np.complex128]
    direct_stiffness: NDArray[np.float64]
    parameters: NDArray[np.float64] | NDArray[np.complex128]
    patch_parameters: NDArray[np.float64]

    @property
    def n_modes(self) -> int:
        return len(self.squared_frequencies)

    @property
    def static_stiffness(self) -> NDArray[np.float64]:
        """(n_outputs, n_inputs), N/m: what a hand feels when it stays, K_tt - sum_k c_k b_k^T / mu_k."""
        scaled = self.input_coupling / self.squared_frequencies[:, None]
        return np.real(self.direct_stiffness - self.output_coupling @ scaled)

    def scaled(self, youngs_modulus_pa: float, density_kg_per_m3: float) -> ElasticModes:
        """The modes of a body of this E and rho from those with E = 1 Pa, rho = 1 kg/m³ and the same Poisson's ratio."""
        stiffer, lighter = youngs_modulus_pa, density_kg_per_m3**-0.5
        return replace(
            self,
            squared_frequencies=stiffer * lighter**2 * self.squared_frequencies,
            input_coupling=stiffer * lighter * self.input_coupling,
            output_coupling=stiffer * lighter * self.output_coupling,
            direct_stiffness=stiffer * self.direct_stiffness,
            parameters=lighter * self.parameters,
        )
