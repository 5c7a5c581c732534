"""Tissues by name: a material for a scene, with what was measured of it, where, and how much it varies."""

from __future__ import annotations

from dataclasses import dataclass
from math import pi
from typing import Any

from palpate.scene.material import Material, PronySeries

_POISSONS_RATIO = 0.45
_DENSITY_KG_PER_M3 = 1060.0
LOSS_FREQUENCIES_HZ = (1.0, 10.0, 30.0)
"""Where a preset's loss tangent is stated: a hand palpates at up to some 25 Hz."""


@dataclass(frozen=True)
class Preset:
    """A material and its evidence.

    about      what it is, in a line
    measured   of what, how, at which strain
    band_hz    the frequencies of the measurement; outside of them the material is extrapolated. None: no measurement
    spread     how much specimens differ, one standard deviation
    source     the publication
    caution    what a user has to know before the numbers are relied on
    """

    material: Material
    about: str
    measured: str
    band_hz: tuple[float, float] | None
    spread: str
    source: str
    caution: str

    @property
    def loss_tangents(self) -> tuple[float, ...]:
        """At LOSS_FREQUENCIES_HZ."""
        return tuple(self.material.prony.loss_tangent(f) for f in LOSS_FREQUENCIES_HZ)


def zener(rest_pa: float, branch_pa: float, viscosity_pa_s: float) -> Material:
    """The material of a standard linear solid: a spring beside a branch of a spring and a dashpot, all of them in shear."""
    prony = PronySeries((branch_pa / rest_pa,), (viscosity_pa_s / branch_pa,))
    return _of_shear(rest_pa, prony)


def _of_shear(shear_modulus_pa: float, prony: PronySeries) -> Material:
    """Poisson's ratio and density are assumed: elastography tells neither."""
    return Material(2 * (1 + _POISSONS_RATIO) * shear_modulus_pa, _POISSONS_RATIO, _DENSITY_KG_PER_M3, prony)


_ELASTOGRAPHY = "elastography in vivo; the strain, far below 1 %, is not stated in the abstract"
_ASBACH = "Asbach et al., Magn. Reson. Med. 60, 373 (2008)"
_BELOW = "slow relaxation was not measured: below 25 Hz this tissue loses too little"
_KIDNEY_END_HZ = 500.0

TISSUES: dict[str, Preset] = {
    "paper-cube": Preset(
        Material(1.0, 0.3, 10.0, PronySeries((1.0,), (1.0,))),
        "the cube of BaniHani & De",
        "nothing: numbers of the paper; E and Poisson's ratio are not stated there and are ours",
        None,
        "none",
        "BaniHani & De, Eng. Comput. 25 (2009), section 4.2",
        "no tissue",
    ),
    "liver": Preset(
        Material(5400.0, 0.45, 1060.0, PronySeries((0.5, 0.3), (0.58, 0.004))),
        "the liver of most shipped scenes: its stiffness is measured, its relaxation is not",
        "shear modulus 1.8 kPa, so E = 5.4 kPa as for an incompressible body",
        None,
        "+- 0.4 kPa of the shear modulus",
        "PMC6925591, table 1; gamma 0.5 at 0.58 s as in an example of the SOFA framework; gamma 0.3 at 4 ms is our choice",
        "it loses far less than measured livers between 1 and 10 Hz: take liver-healthy or liver-power-law for that",
    ),
    "liver-healthy": Preset(
        zener(1160.0, 1970.0, 7.3),
        "human liver, healthy",
        f"8 volunteers, {_ELASTOGRAPHY}",
        (25.0, 62.5),
        "1.16 +- 0.28 kPa, 1.97 +- 0.30 kPa, 7.3 +- 2.3 Pa s",
        _ASBACH,
        _BELOW,
    ),
    "liver-fibrotic": Preset(
        zener(2910.0, 4830.0, 14.4),
        "human liver, fibrosis of grade 3 to 4",
        f"8 patients, {_ELASTOGRAPHY}",
        (25.0, 62.5),
        "2.91 +- 0.84 kPa, 4.83 +- 1.77 kPa, 14.4 +- 6.6 Pa s",
        _ASBACH,
        _BELOW,
    ),
    # Both power laws are those of palpate.fitting.power_law: here 0.01 to 62.5 Hz, within 1.5 %.
    "liver-power-law": Preset(
        _of_shear(
            475.4,
            PronySeries((2.262, 1.249, 0.9216, 0.6229, 0.5257), (0.001846, 0.01928, 0.2013, 2.103, 21.96)),
        ),
        "liver that loses alike at all frequencies: a power law of exponent 0.15",
        "bovine, ex vivo, elastography; scaled to the modulus of liver-healthy at 40 Hz, where both were measured",
        (40.0, 100.0),
        "of the exponent not stated; of the modulus as for liver-healthy, +- 15 to 25 %",
        f"exponent: Sinkus et al., Proc. ISMRM 2006, 2560; modulus: {_ASBACH}",
        "the law is continued down to 0.01 Hz, as rheometry of bovine liver below 50 Hz suggests (Klatt, ISMRM 2009, 2503)",
    ),
    "kidney": Preset(
        zener(1810.0, 1.48 * 2 * pi * _KIDNEY_END_HZ, 1.48),
        "cortex of the pig's kidney",
        "8 excised kidneys, ultrasound vibrometry; Voigt's model; the strain is not stated in the abstract",
        (50.0, _KIDNEY_END_HZ),
        "1.81 +- 0.17 kPa, 1.48 +- 0.49 Pa s; anisotropic, and not the same throughout a kidney",
        "Amador et al., IEEE Trans. UFFC 58, 2608 (2011)",
        "slow relaxation was not measured; kidneys relax by fluid flow, too, which no Prony series shows (PMC7595329)",
    ),
    "brain": Preset(
        zener(840.0, 2030.0, 6.7),
        "human brain",
        f"5 volunteers, {_ELASTOGRAPHY}",
        (25.0, 62.5),
        "0.84 +- 0.22 kPa, 2.03 +- 0.19 kPa, 6.7 +- 1.3 Pa s",
        "Klatt et al., Phys. Med. Biol. 52, 7281 (2007)",
        f"the numbers are quoted and were not compared with the paper again; {_BELOW}",
    ),
    "muscle": Preset(
        _of_shear(  # 1 to 62.5 Hz, within 0.9 %
            280.3,
            PronySeries((4.684, 1.909, 1.351, 0.8576, 0.649), (0.0007027, 0.003761, 0.02013, 0.1078, 0.5768)),
        ),
        "human thigh muscle, relaxed, along its fibers: a power law of exponent 0.253",
        f"7 volunteers, {_ELASTOGRAPHY}",
        (25.0, 62.5),
        "2.68 +- 0.23 kPa, exponent 0.253 +- 0.009; contracted 3.87 +- 0.50 kPa and 0.270 +- 0.009",
        "Klatt et al., Phys. Med. Biol. 55, 6445 (2010)",
        "the modulus depends on a reference viscosity, here 1 Pa s; the abstract does not state it, and 3.7 Pa s, also used in "
        "such work, would make it 1.39 times as large. The law is continued down to 1 Hz; what relaxes slower counts as at rest. "
        "Muscle is anisotropic",
    ),
}

PRESETS: dict[str, Material] = {name: preset.material for name, preset in TISSUES.items()}
"""What a scene's `preset` may name."""


def tissues_text() -> str:
    """A table of all presets."""
    head = ("preset", "E at rest", *(f"{f:g} Hz" for f in LOSS_FREQUENCIES_HZ), "measured", "what it is")
    rows = [head]
    for name, preset in TISSUES.items():
        band = "-" if preset.band_hz is None else "{:g} to {:g} Hz".format(*preset.band_hz)
        losses = (f"{loss:.2g}" for loss in preset.loss_tangents)
        rows.append((name, f"{preset.material.youngs_modulus_pa:.4g} Pa", *losses, band, preset.about))
    widths = [max(len(row[column]) for row in rows) for column in range(len(head))]
    lines = ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)) for row in rows]
    return "\n".join(
        [
            *(line.rstrip() for line in lines),
            "",
            "The columns in Hz are loss tangents. `palpate tissues NAME` says more.",
        ]
    )


def tissue_text(name: str) -> str:
    """One preset with its evidence."""
    preset, material = TISSUES[name], TISSUES[name].material
    losses = zip(LOSS_FREQUENCIES_HZ, preset.loss_tangents, strict=True)
    band = "" if preset.band_hz is None else "; {:g} to {:g} Hz".format(*preset.band_hz)
    branches = zip(material.prony.gamma, material.prony.tau_s, strict=True)
    rows = [
        ("measured", f"{preset.measured}{band}"),
        ("spread", preset.spread),
        ("source", preset.source),
        ("caution", preset.caution),
        ("loss tangent", ", ".join(f"{loss:.3g} at {f:g} Hz" for f, loss in losses)),
        ("E at rest", f"{material.youngs_modulus_pa:.4g} Pa, Poisson's ratio {material.poissons_ratio:g}"),
        ("density", f"{material.density_kg_per_m3:g} kg/m³"),
        *((f"branch {i}", f"gamma {g:.4g}, tau {tau:.4g} s") for i, (g, tau) in enumerate(branches, 1)),
    ]
    return "\n".join([f"{name}: {preset.about}", *(f"  {label:<14}{text}" for label, text in rows)])


def tissue_json(name: str) -> dict[str, Any]:
    """One preset with plain numbers, lists and names; docs/commands.md lists the fields."""
    preset, material = TISSUES[name], TISSUES[name].material
    return {
        "name": name,
        "about": preset.about,
        "youngs_modulus_pa": material.youngs_modulus_pa,
        "poissons_ratio": material.poissons_ratio,
        "density_kg_per_m3": material.density_kg_per_m3,
        "gamma": list(material.prony.gamma),
        "tau_s": list(material.prony.tau_s),
        "loss_tangent": [
            {"frequency_hz": f, "value": loss}
            for f, loss in zip(LOSS_FREQUENCIES_HZ, preset.loss_tangents, strict=True)
        ],
        "measured": preset.measured,
        "measured_band_hz": None if preset.band_hz is None else list(preset.band_hz),
        "spread": preset.spread,
        "source": preset.source,
        "caution": preset.caution,
    }
