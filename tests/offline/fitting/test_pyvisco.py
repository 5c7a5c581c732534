"""Our fit beside that of pyvisco, on pyvisco's own example of a relaxation over 30 decades."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from palpate.fitting.branches import fit_branches
from palpate.fitting.equations import equations_of
from palpate.fitting.records import Signal, time_record

DATA = Path(__file__).parents[2] / "data" / "pyvisco"

Array = NDArray[np.float64]


@pytest.fixture(scope="module")
def example() -> tuple[Array, Array]:
    """Time, s, and relaxation modulus, MPa."""
    time_s, modulus = np.loadtxt(DATA / "time_user_master.csv", delimiter=",", skiprows=2, unpack=True)
    return time_s, modulus


def relaxing(time_s: Array, at_rest: float, strengths: Array, tau_s: Array) -> Array:
    return at_rest + np.exp(-time_s[:, None] / tau_s) @ strengths


@pytest.fixture(scope="module")
def of_pyvisco(example: tuple[Array, Array]) -> Array:
    """The modulus, MPa, at the example's times, of the terms that pyvisco 2.1.3 found."""
    path = DATA / "time_user_master_terms.csv"
    tau_s, strengths = np.loadtxt(path, delimiter=",", unpack=True)
    at_rest = float(path.read_text().partition("at rest ")[2].split()[0])
    return relaxing(example[0], at_rest, strengths, tau_s)


def test_with_fewer_terms_it_is_as_near_to_the_record_and_nearer_to_pyvisco_than_a_percent(
    example: tuple[Array, Array], of_pyvisco: Array
) -> None:
    time_s, modulus = example
    # The example is the answer to a step. Our record needs its history: a ramp to the first sample, at 2.8 ms.
    strain = Signal("strain", "", np.concatenate([[0.0], np.ones(len(time_s))]))
    stress = Signal("stress", "Pa", np.concatenate([[0.0], modulus]))
    found = fit_branches(
        equations_of(time_record("example", np.concatenate([[0.0], time_s]), strain, stress))
    ).branches
    ours = relaxing(time_s, found.amplitudes[0], found.amplitudes[1:], found.times)

    def rms(values: Array) -> float:
        return float(np.sqrt(np.mean(values[time_s > 0.1] ** 2))) / modulus[0]

    assert len(found.times) < 31  # terms of pyvisco
    assert rms(ours - modulus) < 1.2 * rms(of_pyvisco - modulus)
    assert rms(ours - of_pyvisco) < 0.002
    assert np.max(np.abs(ours / of_pyvisco - 1)[time_s > 0.1]) < 0.05


def test_the_terms_on_file_are_those_that_pyvisco_finds(
    example: tuple[Array, Array], of_pyvisco: Array
) -> None:
    pytest.importorskip(
        "pyvisco", reason="not installed, it brings JupyterLab with it: pip install --no-deps pyvisco pandas"
    )
    import matplotlib

    matplotlib.use("Agg")
    from pyvisco import load, prony

    data = load.file(str(DATA / "time_user_master.csv"))
    master, _ = load.user_master(data, "time", 20, "E")
    master["E_relax_filt"] = master["E_relax"]
    terms, _ = prony.fit(prony.discretize(master), master)
    strengths = terms["E_0"] * terms["df_terms"]["alpha_i"].to_numpy()
    again = relaxing(
        example[0], terms["E_0"] - strengths.sum(), strengths, terms["df_terms"]["tau_i"].to_numpy()
    )
    assert np.max(np.abs(again / of_pyvisco - 1)) < 1e-3
