"""Presets have the loss tangent of what was published, and say what was measured."""

from __future__ import annotations

import json
import math
import re
from pathlib import Path

import numpy as np
import pytest

from palpate import commands
from palpate.fitting.power_law import power_law
from palpate.scene.schema import MaterialTable
from palpate.scene.tissues import LOSS_FREQUENCIES_HZ, TISSUES, tissue_json

# Shear moduli, Pa, and viscosity, Pa s, as published.
ZENER = {
    "liver-healthy": (1160.0, 1970.0, 7.3),
    "liver-fibrotic": (2910.0, 4830.0, 14.4),
    "brain": (840.0, 2030.0, 6.7),
}
BAND_HZ = {"liver-power-law": (0.01, 62.5), "muscle": (1.0, 62.5)}
EXPONENT = {"liver-power-law": 0.15, "muscle": 0.253}


def shear_modulus(name: str, f: float) -> complex:
    material = TISSUES[name].material
    factor = material.prony.transfer_factor(np.array(2j * np.pi * f))
    return complex(material.shear_modulus_pa * factor)


@pytest.mark.parametrize("name", ZENER)
@pytest.mark.parametrize("f", [*LOSS_FREQUENCIES_HZ, 62.5])
def test_a_solid_of_two_springs_and_a_dashpot_is_the_published_one(name: str, f: float) -> None:
    rest, spring, viscosity = ZENER[name]
    dashpot = 2j * math.pi * f * viscosity
    published = rest + 1 / (1 / spring + 1 / dashpot)  # the branch: spring and dashpot in series
    assert shear_modulus(name, f) == pytest.approx(published, rel=1e-12)
    assert TISSUES[name].material.prony.loss_tangent(f) == pytest.approx(published.imag / published.real)


@pytest.mark.parametrize("f", [*LOSS_FREQUENCIES_HZ, 50.0])
def test_the_kidney_is_voigts_solid_far_below_the_end_of_its_band(f: float) -> None:
    """A branch in place of the dashpot alone: relative error (f / 500 Hz), squared in the loss."""
    published = 1810.0 + 2j * math.pi * f * 1.48
    assert abs(shear_modulus("kidney", f) - published) < 1.01 * f / 500 * published.imag


@pytest.mark.parametrize("name", EXPONENT)
def test_a_power_law_loses_alike_at_all_frequencies(name: str) -> None:
    law = power_law(EXPONENT[name], BAND_HZ[name])
    assert len(law.prony.gamma) == 5
    assert law.error < 0.016
    shipped = TISSUES[name].material.prony  # rounded to four digits
    assert shipped.gamma == pytest.approx(law.prony.gamma, rel=1e-3)
    assert shipped.tau_s == pytest.approx(law.prony.tau_s, rel=1e-3)
    published = math.tan(EXPONENT[name] * math.pi / 2)
    for f in LOSS_FREQUENCIES_HZ:
        # An error of e in the modulus turns it by e at most.
        assert shipped.loss_tangent(f) == pytest.approx(published, abs=1.1 * law.error * (1 + published**2))


def test_the_power_laws_have_the_published_magnitude() -> None:
    assert abs(shear_modulus("liver-power-law", 40.0)) == pytest.approx(
        abs(shear_modulus("liver-healthy", 40.0)), rel=0.02
    )
    # Klatt 2010: mu^(1 - alpha) (i omega eta)^alpha with mu = 2.68 kPa, eta = 1 Pa s
    for f in (25.0, 62.5):
        published = 2680 ** (1 - 0.253) * (2 * math.pi * f) ** 0.253
        assert abs(shear_modulus("muscle", f)) == pytest.approx(published, rel=0.015)


@pytest.mark.parametrize(("exponent", "n"), [(0.15, 5), (0.253, 5), (0.15, 9), (0.5, 8)])
def test_the_stated_error_of_a_power_law_is_the_largest_one_in_its_band(exponent: float, n: int) -> None:
    band = (0.1, 40.0)
    law = power_law(exponent, band, n)
    f = np.geomspace(*band, 1999)
    modulus = law.rest * law.prony.transfer_factor(2j * np.pi * f)
    error = np.abs(modulus / (1j * f) ** exponent - 1).max()
    assert error == pytest.approx(law.error, rel=0.05)
    assert error < (0.1 if exponent == 0.5 else 0.015)


def test_more_branches_are_nearer_to_the_law() -> None:
    errors = [power_law(0.2, (0.01, 60.0), n).error for n in (3, 5, 8)]
    assert errors[0] > 2 * errors[1] > 4 * errors[2]


def test_a_power_law_needs_an_exponent_and_a_band() -> None:
    with pytest.raises(ValueError, match=r"exponent = 1\.0: expected between 0 and 1"):
        power_law(1.0, (1.0, 10.0))
    with pytest.raises(ValueError, match="band_hz = "):
        power_law(0.2, (10.0, 1.0))


def test_every_preset_says_what_was_measured_and_can_be_named_by_a_scene() -> None:
    for name, preset in TISSUES.items():
        assert all((preset.about, preset.measured, preset.spread, preset.source, preset.caution))
        assert MaterialTable(preset=name).material() == preset.material
        assert preset.loss_tangents == tuple(entry["value"] for entry in tissue_json(name)["loss_tangent"])


def test_the_liver_of_the_shipped_scenes_says_that_it_loses_too_little() -> None:
    loss = TISSUES["liver"].material.prony.loss_tangent
    assert loss(1.0) < 0.2 < TISSUES["liver-power-law"].material.prony.loss_tangent(1.0)
    assert "loses far less than measured livers" in TISSUES["liver"].caution


def test_the_command_lists_all_tells_one_and_refuses_others(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def printed(*arguments: str) -> str:
        monkeypatch.setattr("sys.argv", ["palpate tissues", *arguments])
        commands.tissues()
        return capsys.readouterr().out

    table = printed()
    assert [line.split()[0] for line in table.splitlines()[1 : 1 + len(TISSUES)]] == list(TISSUES)
    assert "Asbach" in printed("liver-healthy")
    assert json.loads(printed("--json", "brain", "muscle")) == [tissue_json("brain"), tissue_json("muscle")]
    assert [entry["name"] for entry in json.loads(printed("--json"))] == list(TISSUES)
    with pytest.raises(ValueError, match="there is no tissue 'bone': expected one of paper-cube, liver"):
        printed("bone")


def test_the_page_has_the_numbers_of_the_presets() -> None:
    page = (Path(__file__).parents[3] / "docs" / "tissue.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| `([\w-]+)` \| ([\d.]+) \| ([\d., ]+) \|", page, re.MULTILINE)
    assert {name for name, _, _ in rows} == set(TISSUES) - {"paper-cube"}
    for name, modulus, losses in rows:
        preset = TISSUES[name]
        assert modulus == f"{preset.material.youngs_modulus_pa:.4g}"
        assert losses == ", ".join(f"{loss:.2g}" for loss in preset.loss_tangents)
