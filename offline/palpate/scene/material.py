"""Linear isotropic viscoelastic material: elastic constants, density and a Prony series."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

_RANGES = {
    "youngs_modulus_pa": (1e-3, 1e13),
    # At 0.5 no bulk modulus is finite; 0.49 is near enough for soft tissue.
    "poissons_ratio": (-0.999, 0.49999),
    "density_kg_per_m3": (1e-3, 1e6),
    "gamma": (1e-9, 1e4),
    "tau_s": (1e-9, 1e6),
}
"""Limits of the constants that a scene may state: a number beyond them is a mistake, whatever the body is made of."""


@dataclass(frozen=True)
class PronySeries:
    """Relaxation of the stress, Eq. 9 of BaniHani & De 2009: gamma_j = E_j / E with time constant tau_j.

    E is the modulus at rest (fully relaxed). Many publications divide by the instant modulus instead: with
    g_j = E_j / E_instant, gamma_j = g_j / (1 - sum of all g).

    gamma  (n_terms,), dimensionless, > 0
    tau_s  (n_terms,), s, > 0 and distinct

    Raises ValueError unless there are as many gamma as distinct tau_s.
    """

    gamma: tuple[float, ...] = ()
    tau_s: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        if len(self.gamma) != len(self.tau_s):
            raise ValueError(
                f"gamma has {len(self.gamma)} terms and tau_s has {len(self.tau_s)}: expected as many"
            )
        if len(set(self.tau_s)) != len(self.tau_s):
            raise ValueError(
                f"tau_s = {list(self.tau_s)}: expected distinct time constants (add up equal ones)"
            )

    @property
    def instant_factor(self) -> float:
        """Stiffness at an instant over stiffness at rest, 1 + sum_j gamma_j."""
        return 1.0 + sum(self.gamma)

    def transfer_factor(self, s: NDArray[np.complex128]) -> NDArray[np.complex128]:
        """h(s) = 1 + sum_j gamma_j s tau_j / (1 + s tau_j), the factor from elastic to viscoelastic stress.

        s: any shape, rad/s. Eq. 9 differentiated and Laplace transformed.
        """
        h = np.ones_like(s, dtype=np.complex128)
        for gamma, tau in zip(self.gamma, self.tau_s, strict=True):
            h += gamma * s * tau / (1 + s * tau)
        return h

    def loss_tangent(self, frequency_hz: float) -> float:
        """Loss modulus over storage modulus."""
        h = self.transfer_factor(np.array(2j * np.pi * frequency_hz))
        return float(h.imag / h.real)


@dataclass(frozen=True)
class Material:
    """Isotropic linear viscoelastic material, constants at rest (fully relaxed).

    youngs_modulus_pa   E > 0, Pa
    poissons_ratio      -1 < nu < 0.5
    density_kg_per_m3   rho > 0, kg/m³
    """

    youngs_modulus_pa: float
    poissons_ratio: float
    density_kg_per_m3: float
    prony: PronySeries = PronySeries()

    @property
    def unit(self) -> Material:
        """The elastic material of the same Poisson's ratio with E = 1 Pa and rho = 1 kg/m³."""
        return Material(1.0, self.poissons_ratio, 1.0)

    @property
    def shear_modulus_pa(self) -> float:
        """G = E / (2 (1 + nu)), Pa."""
        return self.youngs_modulus_pa / (2 * (1 + self.poissons_ratio))

    @property
    def lame_lambda_pa(self) -> float:
        """lambda = E nu / ((1 + nu)(1 - 2 nu)), Pa."""
        nu = self.poissons_ratio
        return self.youngs_modulus_pa * nu / ((1 + nu) * (1 - 2 * nu))


def check_constant(name: str, value: float) -> None:
    """Raise ValueError unless a material constant lies within its range; the name is that of its field."""
    low, high = _RANGES[name]
    if not low <= value <= high:
        hint = " (45 % is 0.45)" if name == "poissons_ratio" else ""
        raise ValueError(f"{name} = {value}: expected from {low:g} to {high:g}{hint}")
