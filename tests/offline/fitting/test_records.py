"""Reading records: what they may hold, and one clear error for what they may not."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from palpate.fitting.records import POISSONS_RATIO, Specimen, TimeRecord, indentation_area, read_record
from palpate.fitting.tissue import fit_tissue
from palpate.model_file import ToolShape
from palpate_server.diagnostics.sample_surface import half_space_model
from palpate_server.simulation import Simulation

TIME_S = np.arange(0, 10.5, 0.1)
RAMP = np.minimum(TIME_S / 0.5, 1)


def write(path: Path, header: str, *columns: NDArray[np.float64]) -> Path:
    np.savetxt(path, np.column_stack(columns), delimiter=",", header=header, comments="")
    return path


def test_columns_may_come_in_any_order_and_a_byte_order_mark_is_no_part_of_a_name(tmp_path: Path) -> None:
    path = write(tmp_path / "r.csv", "stress_pa, time_s, strain", 100 * RAMP, TIME_S, 0.05 * RAMP)
    path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes())
    record = read_record(path)
    assert isinstance(record, TimeRecord)
    assert (record.test, record.ramp_s, record.hold_s) == (
        "relaxation",
        pytest.approx(0.5),
        pytest.approx(9.9),
    )
    assert record.response.values == pytest.approx(100 * RAMP)


@pytest.mark.parametrize(
    ("header", "found"),
    [
        (
            "time,strain,stress",
            "found the columns time, strain, stress. Expected, separated by commas: time_s, ",
        ),
        ("time_s,strain,stress_kpa", "found the columns time_s, strain, stress_kpa"),
        ("time_s,strain,force_n", "found the columns time_s, strain, force_n"),
        ("time_s;strain;stress_pa", "found the columns time_s;strain;stress_pa"),
        ("time_s,strain,stress_pa,strain", "found the columns time_s, strain, stress_pa, strain"),
        ("", "found the columns none"),
    ],
)
def test_other_columns_are_refused_with_what_was_found_and_what_is_expected(
    tmp_path: Path, header: str, found: str
) -> None:
    (tmp_path / "r.csv").write_text(header + "\n0,0,0\n")
    with pytest.raises(ValueError) as caught:
        read_record(tmp_path / "r.csv")
    message = str(caught.value)
    assert found in message and "\n" not in message
    for names in (
        "time_s, strain, stress_pa",
        "time_s, displacement_m, force_n",
        "frequency_hz, storage_pa, loss_pa",
    ):
        assert names in message.replace("loss_pa, storage_pa", "storage_pa, loss_pa")


@pytest.mark.parametrize(
    ("row", "says"),
    [
        ("0.1,x,3", "r.csv, line 3: strain is 'x': expected a number"),
        ("0.1,nan,3", "line 3: strain is 'nan'"),
        ("0.1,1e308,3", "line 3: strain is '1e308': expected a number up to 1e\\+15"),
        ("0.1,2", "line 3: 2 values: expected 3"),
        ("0.1,2,3,4", "line 3: 4 values: expected 3"),
    ],
)
def test_a_wrong_row_is_named(tmp_path: Path, row: str, says: str) -> None:
    (tmp_path / "r.csv").write_text(f"time_s,strain,stress_pa\n0,0,0\n{row}\n")
    with pytest.raises(ValueError, match=says):
        read_record(tmp_path / "r.csv")


@pytest.mark.parametrize(
    ("strain", "stress", "says"),
    [
        (
            np.ones_like(RAMP),
            RAMP,
            "strain begins at 100 % of its held value: expected a record that begins at zero",
        ),
        (RAMP * (1 + 0.5 * np.sin(TIME_S)), RAMP * (1 + 0.5 * np.sin(TIME_S)), "expected a ramp and a hold"),
        (np.minimum(TIME_S / 8, 1), np.minimum(TIME_S / 8, 1), "expected a hold of at least twice the ramp"),
        (RAMP, -RAMP, "strain and stress have opposite signs"),
        (RAMP, 0 * RAMP, "stress is zero throughout"),
    ],
)
def test_what_is_no_ramp_and_hold_is_refused(
    tmp_path: Path, strain: NDArray[np.float64], stress: NDArray[np.float64], says: str
) -> None:
    path = write(tmp_path / "r.csv", "time_s,strain,stress_pa", TIME_S, strain, stress)
    with pytest.raises(ValueError, match=says):
        read_record(path)


def test_time_has_to_rise_and_a_record_has_enough_rows(tmp_path: Path) -> None:
    columns = "time_s,strain,stress_pa"
    with pytest.raises(ValueError, match=r"time_s goes from 0.1 to 0.1: expected rising values"):
        read_record(
            write(tmp_path / "r.csv", columns, np.maximum(TIME_S[::-1] * 0 + 0.1, TIME_S), RAMP, RAMP)
        )
    with pytest.raises(ValueError, match="5 rows: expected at least 20"):
        read_record(write(tmp_path / "r.csv", columns, TIME_S[:5], RAMP[:5], RAMP[:5]))
    with pytest.raises(FileNotFoundError, match=r"none\.csv: no such record"):
        read_record(tmp_path / "none.csv")


def test_compression_counted_negative_is_the_same(tmp_path: Path) -> None:
    stress = 100 * RAMP * (1 + 0.5 * np.exp(-TIME_S))
    header = "time_s,strain,stress_pa"
    pulled = fit_tissue(
        [read_record(write(tmp_path / "r.csv", header, TIME_S, 0.05 * RAMP, stress))], partial=True
    )
    pressed = fit_tissue(
        [read_record(write(tmp_path / "r.csv", header, TIME_S, -0.05 * RAMP, -stress))], partial=True
    )
    assert pressed.modulus_pa.value == pytest.approx(pulled.modulus_pa.value, rel=1e-9)


@pytest.mark.parametrize(
    ("specimen", "says"),
    [
        (Specimen(), "got none of them"),
        (Specimen(length_m=0.1), "got --length-m"),
        (Specimen(0.1, 1e-4, 0.005), "got --length-m, --area-m2, --tip-radius-m"),
    ],
)
def test_force_and_displacement_need_the_specimen(tmp_path: Path, specimen: Specimen, says: str) -> None:
    path = write(tmp_path / "r.csv", "time_s,displacement_m,force_n", TIME_S, 1e-3 * RAMP, RAMP)
    with pytest.raises(ValueError, match=says):
        read_record(path, specimen)


def test_stress_and_strain_need_none(tmp_path: Path) -> None:
    path = write(tmp_path / "r.csv", "time_s,strain,stress_pa", TIME_S, RAMP, RAMP)
    with pytest.raises(ValueError, match="it needs no --area-m2"):
        read_record(path, Specimen(area_m2=1e-4))


def test_a_bar_of_given_length_and_area(tmp_path: Path) -> None:
    """Hooke: 1 mm of 20 mm by 0.5 N on 1 cm² is 100 kPa."""
    path = write(tmp_path / "r.csv", "time_s,displacement_m,force_n", TIME_S, 1e-3 * RAMP, 0.5 * RAMP)
    tissue = fit_tissue([read_record(path, Specimen(length_m=0.02, area_m2=1e-4))])
    assert tissue.modulus_pa.value == pytest.approx(1e5, rel=1e-6)


class TestIndentation:
    HEADER = "time_s,displacement_m,force_n"

    def test_a_shallow_contact_is_that_of_hertz(self) -> None:
        """F = 4/3 E / (1 - nu²) sqrt(R) depth^1.5 (K. L. Johnson, Contact Mechanics, Eq. 4.23); Sneddon's is 1 - 0.1 depth / R of it."""
        depth = 0.005 * np.array([0.0, 1e-6, 1e-4, 1e-3])
        hertz = 4 / 3 / (1 - POISSONS_RATIO**2) * math.sqrt(0.005) * depth**1.5
        np.testing.assert_allclose(indentation_area(depth, 0.005), hertz, rtol=1.1e-4, atol=1e-22)

    def test_its_slope_is_the_diameter_of_the_contact(self) -> None:
        """dF / d(depth) = 2 a E / (1 - nu²) for every tip (I. N. Sneddon, Int. J. Eng. Sci. 3, 1965), depth = a artanh(a / R)."""
        a = 0.005 * np.array([0.1, 0.3, 0.5, 0.63])
        depth, step = a * np.arctanh(a / 0.005), 1e-7
        slope = (indentation_area(depth + step, 0.005) - indentation_area(depth - step, 0.005)) / (2 * step)
        np.testing.assert_allclose(slope * (1 - POISSONS_RATIO**2), 2 * a, rtol=1e-6)

    def test_the_tissue_of_a_simulated_half_space_is_found(self, tmp_path: Path) -> None:
        """The record is one of the contact that the server runs: points 0.6 mm apart, whose force is 1 % above Sneddon's."""
        tip = ToolShape("tip", 0.004, 0.0, (0.0, 0.0, 0.1))
        model = half_space_model([tip], 19, 6e-4, 5e3, prony=([0.6], [0.2]))
        simulation = Simulation(model, 1e6)
        time_s = model.period_s * np.arange(1, 1001)
        depth = 0.5 * 0.004 * np.clip((time_s - 0.05) / 0.05, 0, 1)
        force = [simulation.step({"tip": (0.0, 0.0, 0.004 - d)})["tip"].force_n[2] for d in depth]
        path = write(tmp_path / "r.csv", self.HEADER, time_s, depth, np.array(force))
        tissue = fit_tissue([read_record(path, Specimen(tip_radius_m=0.004))])
        # The half-space is incompressible.
        assert tissue.modulus_pa.value / (1 - POISSONS_RATIO**2) == pytest.approx(5e3 / 0.75, rel=0.025)
        (branch,) = tissue.branches
        assert branch.gamma.value == pytest.approx(0.6, rel=0.05)
        assert branch.tau_s.value == pytest.approx(0.2, rel=0.05)

    def test_the_body_that_is_needed_is_told(self, tmp_path: Path) -> None:
        path = write(tmp_path / "r.csv", self.HEADER, TIME_S, 1e-3 * RAMP, RAMP**1.5)
        notes = fit_tissue([read_record(path, Specimen(tip_radius_m=0.005))]).notes
        assert any("0.022 m thick" in note for note in notes)

    def test_a_contact_that_shrinks_is_refused(self, tmp_path: Path) -> None:
        path = write(
            tmp_path / "r.csv", self.HEADER, TIME_S, 1e-3 * RAMP * np.where(TIME_S > 9, 0.5, 1), RAMP
        )
        with pytest.raises(ValueError, match="displacement_m falls"):
            read_record(path, Specimen(tip_radius_m=0.005))

    def test_an_indentation_too_deep_for_a_linear_tissue_is_refused(self, tmp_path: Path) -> None:
        path = write(tmp_path / "r.csv", self.HEADER, TIME_S, 3e-3 * RAMP, RAMP)
        with pytest.raises(ValueError, match=r"reaches 0\.003: expected at most half of --tip-radius-m"):
            read_record(path, Specimen(tip_radius_m=0.005))


def test_a_noisy_strain_is_said(tmp_path: Path) -> None:
    noisy = RAMP * (1 + 0.01 * np.random.default_rng(0).standard_normal(len(RAMP)))
    record = read_record(write(tmp_path / "r.csv", "time_s,strain,stress_pa", TIME_S, noisy, RAMP))
    assert any("strain itself has a noise of" in note for note in record.notes)
