"""`palpate fit` as its user meets it."""

from __future__ import annotations

import json
import subprocess
import sys
import tomllib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from palpate.cli import main
from palpate.fitting.records import TimeRecord
from palpate.scene.schema import load_config

MATERIAL = (5400.0, (0.5, 0.3), (1.5, 12.0))


def palpate(*arguments: str, folder: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "palpate", *arguments],
        cwd=folder,
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory, relaxation: Callable[..., TimeRecord]) -> Path:
    """With tissue.csv, and short.csv, its first ten seconds."""
    path = tmp_path_factory.mktemp("records")
    for name, seconds, material in (
        ("tissue.csv", 60, MATERIAL),
        ("short.csv", 10, (5400.0, (0.5, 0.3), (1.5, 51.0))),
    ):
        record = relaxation(material, np.arange(0, seconds + 0.5, 0.05))
        table = np.column_stack([record.time_s, record.drive.values, record.response.values])
        np.savetxt(
            path / name, table, delimiter=",", header="time_s,strain,stress_pa", comments="", fmt="%.6g"
        )
    return path


def test_the_table_is_in_words_and_its_material_builds_into_a_scene(
    folder: Path, tmp_path: Path, slab_scene: Callable[..., str]
) -> None:
    done = palpate("fit", "tissue.csv", "--picture", str(tmp_path / "tissue.png"), folder=folder)
    assert done.returncode == 0, done.stderr
    for words in ("E at rest", "branch 2", "loss tangent at 10 Hz  not known", "95 % confidence", "misfit"):
        assert words in done.stdout
    assert (tmp_path / "tissue.png").read_bytes().startswith(b"\x89PNG")

    block = done.stdout[done.stdout.index("# Fitted to tissue.csv") :]
    scene = tmp_path / "slab.toml"
    scene.write_text(slab_scene().replace('[material]\npreset = "liver"\n', block))
    material = load_config(scene).material.material()
    assert material.youngs_modulus_pa == pytest.approx(5400, rel=0.01)
    assert material.prony.tau_s == pytest.approx((1.5, 12), rel=0.15)


def test_json_holds_the_same(folder: Path) -> None:
    done = palpate("fit", "tissue.csv", "--json", folder=folder)
    assert done.returncode == 0, done.stderr
    summary = json.loads(done.stdout)
    assert set(summary) == {
        "records",
        "confidence",
        "youngs_modulus_pa",
        "gamma",
        "tau_s",
        "loss_tangent",
        "rms_residual",
        "missing",
        "notes",
        "material_toml",
    }
    assert summary["youngs_modulus_pa"]["low"] < 5400 < summary["youngs_modulus_pa"]["high"]
    assert summary["loss_tangent"][2] == {"frequency_hz": 30.0, "value": None}
    assert summary["rms_residual"] == pytest.approx(0.01, rel=0.1)
    material = tomllib.loads(summary["material_toml"])["material"]
    assert material["gamma"] == pytest.approx([g["value"] for g in summary["gamma"]], rel=1e-3)


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["short.csv"], "Missing: a hold of at least"),
        (["none.csv"], "none.csv: no such record"),
        (["tissue.csv", "--area-m2", "1e-4"], "it needs no --area-m2"),
        (["tissue.csv", "--area-m2", "-1"], "'-1': expected a number above zero"),
        (["tissue.csv", "--picture", "tissue.csv"], "tissue.csv is an input of this command"),
    ],
)
def test_a_refusal_is_plain_and_has_code_2(
    folder: Path,
    arguments: list[str],
    says: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(folder)
    monkeypatch.setattr(sys, "argv", ["palpate", "fit", *arguments])
    try:
        code = main()
    except SystemExit as ended:  # by argparse
        code = ended.code  # type: ignore[assignment]
    printed = capsys.readouterr()
    assert (code, printed.out) == (2, "")
    assert says in printed.err


def test_what_is_not_known_is_said_in_table_and_material_alike(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(folder)
    monkeypatch.setattr(sys, "argv", ["palpate", "fit", "short.csv", "--partial"])
    assert main() == 0
    printed = capsys.readouterr().out
    assert "  - not known: a hold of " in printed
    assert "# Not known: a hold of " in printed
