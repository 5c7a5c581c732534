"""The command line as its user meets it: real processes, real files."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from palpate.cli import COMMANDS


def palpate(*arguments: str, folder: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "palpate", *arguments],
        cwd=folder,
        capture_output=True,
        text=True,
        timeout=240,
        check=False,
    )


@pytest.fixture(scope="module")
def slab(tmp_path_factory: pytest.TempPathFactory, slab_scene: Callable[..., str]) -> tuple[Path, str]:
    """A folder with slab.toml and the slab.npz built from it, and what the build printed."""
    folder = tmp_path_factory.mktemp("slab")
    (folder / "slab.toml").write_text(slab_scene())
    done = palpate("build", "slab.toml", folder=folder)
    assert done.returncode == 0, done.stderr
    return folder, done.stdout


def test_build_shows_its_stages_and_a_verdict_in_plain_words_and_writes_one_file(
    slab: tuple[Path, str],
) -> None:
    folder, printed = slab
    assert sorted(p.name for p in folder.iterdir()) == ["slab.npz", "slab.toml"]
    for words in (
        "node cloud",
        "modes",
        "reduction",
        "force while moving",
        "force at rest",
        "verdict: ",
        "wrote",
    ):
        assert words in printed
    for words in ("H-infinity", "passivity margin", "spectral abscissa"):
        assert words not in printed


def test_every_figure_is_there_on_request(slab: tuple[Path, str]) -> None:
    printed = palpate("inspect", "slab.npz", "--verbose", folder=slab[0]).stdout
    for words in (
        "verdict",
        "error, H-infinity",
        "passivity margin",
        "spectral abscissa",
        "error of the surface",
    ):
        assert words in printed


def test_inspect_prints_what_the_file_states(slab: tuple[Path, str]) -> None:
    folder, _ = slab
    done = palpate("inspect", "slab.npz", "--json", folder=folder)
    assert done.returncode == 0, done.stderr
    summary = json.loads(done.stdout)
    assert summary["name"] == "slab"
    assert summary["method"] == "passive"
    assert summary["n_nodes"] == 7 * 7 * 4
    assert summary["period_s"] == 1e-3
    assert summary["order"] < summary["n_states_full"]
    assert summary["accuracy"]["error_in_band"] <= 0.01
    assert summary["accuracy"]["error_bound"] is None
    assert summary["accuracy"]["gain_above_band"] < 2
    assert summary["accuracy"]["change_over_last_vectors"] == 0
    assert palpate("inspect", "slab.npz", folder=folder).returncode == 0


def test_a_reader_that_stops_reading_ends_the_command_without_a_message(slab: tuple[Path, str]) -> None:
    reading, writing = os.pipe()
    os.close(reading)
    try:
        done = subprocess.run(
            [sys.executable, "-m", "palpate", "inspect", "slab.npz"],
            cwd=slab[0],
            stdout=writing,
            stderr=subprocess.PIPE,
            timeout=240,
            check=False,
        )
    finally:
        os.close(writing)
    assert (done.returncode, done.stderr) == (128 + signal.SIGPIPE, b"")


def test_the_same_configuration_builds_the_same_evidence(slab: tuple[Path, str]) -> None:
    folder, _ = slab
    assert palpate("build", "slab.toml", "-o", "again.npz", folder=folder).returncode == 0
    first, second = (
        json.loads(palpate("inspect", name, "--json", folder=folder).stdout)
        for name in ("slab.npz", "again.npz")
    )
    (folder / "again.npz").unlink()
    assert first["config_sha256"] == second["config_sha256"]
    assert first["order"] == second["order"]
    assert first["accuracy"]["error_in_band"] == pytest.approx(second["accuracy"]["error_in_band"], rel=0.05)


@pytest.mark.parametrize("method", ["tbr", "modal-static"])
def test_method_and_order_can_be_chosen_on_the_command_line(slab: tuple[Path, str], method: str) -> None:
    folder, _ = slab
    done = palpate(
        "build", "slab.toml", "-o", f"{method}.npz", "--method", method, "--order", "30", folder=folder
    )
    assert done.returncode == 0, done.stderr
    summary = json.loads(palpate("inspect", f"{method}.npz", "--json", folder=folder).stdout)
    (folder / f"{method}.npz").unlink()
    assert summary["method"] == method
    assert summary["order"] <= 30
    assert summary["accuracy"]["error_hinf"] <= summary["accuracy"]["error_bound"]
    assert "force is wrong by" in done.stdout  # plain methods are poor in the band at this order
    assert ("Force at rest" in done.stdout) == (method != "modal-static")


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["build", "none.toml"], "none.toml: no such configuration"),
        (["build", "slab.toml", "--order", "1"], "reduction.order = 1"),
        (["build", "slab.toml", "--tolerance", "200%"], "reduction.tolerance = 2.0: expected below 1"),
        (["build", "slab.toml", "--tolerance", "much"], "--tolerance 'much': expected a fraction"),
        (["build", "slab.toml", "--tolerance", "2%", "--order", "20"], "not allowed with argument"),
        (["build", "slab.toml", "--method", "pod"], "reduction.method = 'pod'"),
        (
            ["build", "slab.toml", "-o", "slab.toml/x.npz"],
            "slab.toml/x.npz: can't write to slab.toml",
        ),
        (["build", "slab.toml", "-o", "."], "is a folder"),
        (["build", "slab.toml", "-o", "slab.toml"], "slab.toml is an input of this command"),
        (["build", "slab.toml", "-o", "/dev/null"], "/dev/null is a device"),
        (["inspect", "a\nb\x1b[31m"], r"argument 2, 'a\nb\x1b[31m', has characters that can't be shown"),
        (["biuld"], "there is no command 'biuld': expected one of demo, build"),
        (["inspect", "slab.toml"], "slab.toml: damaged or not an .npz archive"),
        (["inspect", "none.npz"], "none.npz: no such model file"),
    ],
)
def test_a_mistake_ends_in_one_plain_message_and_exit_code_2(
    slab: tuple[Path, str], arguments: list[str], says: str
) -> None:
    folder, _ = slab
    before = sorted(folder.iterdir())
    done = palpate(*arguments, folder=folder)
    assert done.returncode == 2
    assert says in done.stderr
    assert "Traceback" not in done.stderr
    if "usage" not in done.stderr:
        assert len(done.stderr.splitlines()) == 1
    assert sorted(folder.iterdir()) == before


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ("point_m = [0.03, 0.03, 0.03]", "point_m = [0.03, 0.03, 0.93]", "contact 'tip': point_m = [0.03, 0.03, 0.93] is 0.9 m"),
        ("radius_m = 0.011", "radius_m = 10.0", "contact 'tip': radius_m = 10 holds"),
        ("point_m = [0.03, 0.03, 0.03]", "point_m = [0.03, 0.03, 0.0]", "contact 'tip' and a fixed region share node"),
        ("normal = [0.0, 0.0, -1.0]", "normal = [0.0, 0.0, 0.0]", "fixed[0].normal = [0.0, 0.0, 0.0]"),
        ("counts = [7, 7, 4]\njitter = 0.1", 'counts = [30, 30, 30]\n[discretization]\nmethod = "collocation"\n[reduction]\nmethod = "tbr"\norder = 20', "GiB"),
    ],
)  # fmt: skip
def test_a_scene_that_makes_no_sense_is_refused_by_the_name_of_its_part(
    tmp_path: Path, slab_scene: Callable[..., str], old: str, new: str, says: str
) -> None:
    (tmp_path / "odd.toml").write_text(slab_scene().replace(old, new))
    done = palpate("build", "odd.toml", folder=tmp_path)
    assert done.returncode == 2
    assert says in done.stderr
    assert "Traceback" not in done.stderr
    assert [p.name for p in tmp_path.iterdir()] == ["odd.toml"]


@pytest.mark.parametrize("command", ["serve", "client", "health", "record", "replay", "check-host"])
def test_programs_that_palpate_starts_show_their_own_help_under_its_name(
    tmp_path: Path, command: str
) -> None:
    done = palpate(command, "--help", folder=tmp_path)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith(f"usage: palpate {command}")


def test_a_scene_that_can_not_be_built_leaves_no_file(
    slab: tuple[Path, str], tmp_path: Path, slab_scene: Callable[..., str]
) -> None:
    elastic = slab_scene().replace('preset = "liver"', 'preset = "liver"\ngamma = []\ntau_s = []')
    (tmp_path / "elastic.toml").write_text(elastic)
    done = palpate("build", "elastic.toml", folder=tmp_path)
    assert done.returncode == 2
    assert "Prony" in done.stderr or "elastic" in done.stderr
    assert [p.name for p in tmp_path.iterdir()] == ["elastic.toml"]


def test_the_help_groups_the_commands(tmp_path: Path) -> None:
    done = palpate("--help", folder=tmp_path)
    assert done.returncode == 0
    assert done.stdout == palpate(folder=tmp_path).stdout
    places = [done.stdout.index(f"\n{group}:\n") for group in ("Build a model", "Run it", "Touch it")]
    assert places == sorted(places)
    assert all(f"\n  {name} " in done.stdout for name in COMMANDS)


class TestInterrupt:
    """Ctrl-C ends a build with code 130 and one line, whatever it is at."""

    START = "from palpate.__main__ import main; print('ready', flush=True); main()"

    @pytest.mark.parametrize("delay_s", [0.0, 0.1, 0.3, 0.75, 1.5])
    def test_some_time_after_the_start(
        self, tmp_path: Path, slab_scene: Callable[..., str], delay_s: float
    ) -> None:
        (tmp_path / "slab.toml").write_text(slab_scene())
        with self.started(tmp_path) as build:
            time.sleep(delay_s)  # a moment of the build, not a condition that is waited for
            self.interrupt(build)
        assert [p.name for p in tmp_path.iterdir()] == ["slab.toml"]

    def test_an_interrupt_that_a_library_swallows(
        self, tmp_path: Path, slab_scene: Callable[..., str]
    ) -> None:
        (tmp_path / "slab.toml").write_text(slab_scene())
        # As trimesh does around its own imports.
        (tmp_path / "scipy.py").write_text(
            "import time\ntry:\n    print('importing', flush=True)\n    time.sleep(60)\nexcept BaseException:\n    pass\n"
        )
        with self.started(tmp_path, PYTHONPATH=str(tmp_path)) as build:
            assert build.stdout is not None
            while "importing" not in build.stdout.readline():
                assert build.poll() is None
            self.interrupt(build)

    def started(self, folder: Path, **more: str) -> subprocess.Popen[str]:
        build = subprocess.Popen(
            [sys.executable, "-c", self.START, "build", "slab.toml"],
            cwd=folder,
            env=os.environ | more,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
        )
        assert build.stdout is not None
        assert build.stdout.readline() == "ready\n"
        return build

    def interrupt(self, build: subprocess.Popen[str]) -> None:
        build.send_signal(signal.SIGINT)
        _, err = build.communicate(timeout=120)
        assert (build.returncode, err) == (130, "palpate: interrupted\n")
