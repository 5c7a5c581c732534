"""What is installed with which extra, and that each program starts with no more than its own."""

from __future__ import annotations

import re
import subprocess
import sys
from collections.abc import Iterable
from importlib.metadata import distribution
from pathlib import Path

import pytest

from palpate.cli import COMMANDS

_OFFLINE = {"scipy", "trimesh", "pydantic", "igl", "matplotlib", "skfem"}


def run(code: str, without: Iterable[str] = ()) -> subprocess.CompletedProcess[str]:
    """A fresh Python in which the packages of `without` can't be imported."""
    blocked = f"import sys; sys.modules |= dict.fromkeys({sorted(without)!r}); "
    return subprocess.run(
        [sys.executable, "-c", blocked + code], capture_output=True, text=True, timeout=120, check=False
    )


def loaded_after(imports: str) -> set[str]:
    """Top-level packages that a fresh Python has loaded after some imports."""
    done = run(f"import sys; import {imports}; print(*{{name.partition('.')[0] for name in sys.modules}})")
    assert done.returncode == 0, done.stderr
    return set(done.stdout.split())


def needs(extra: str) -> set[str]:
    """Names of the packages that an extra installs, the extras that it names included; '' for none."""
    found = set()
    for line in distribution("palpate").requires or []:
        name, marker = (*line.split(";"), "")[:2]
        of = re.search(r"extra == .([a-z]+)", marker)
        if (of[1] if of else "") != extra:
            continue
        package, inner = re.match(r"([A-Za-z0-9_-]+)(?:\[([a-z,]+)\])?", name.strip()).groups()  # type: ignore[union-attr]
        if package == "palpate":
            found |= set().union(*(needs(part) for part in inner.split(",")))
        else:
            found.add(package)
    return found


def test_a_plain_installation_is_a_client() -> None:
    assert needs("") == {"eclipse-zenoh", "msgpack"}
    assert needs("server") == {"numpy", "numba"}
    assert needs("all") >= needs("build") | needs("plots") | needs("recorder") | needs("metrics") | needs(
        "view"
    )
    assert {c.extra for c in COMMANDS.values()} <= {
        "",
        "server",
        "build",
        "recorder",
        "experiments",
        "images",
        "completion",
        "view",
        "all",
    }


def test_every_requirement_is_pinned() -> None:
    text = (Path(__file__).parents[1] / "constraints.txt").read_text(encoding="utf-8")
    pinned = {line.partition("==")[0].lower().replace("_", "-") for line in text.splitlines()}
    assert (
        needs("")
        | needs("all")
        | needs("dev")
        | needs("experiments")
        | needs("surfaces")
        | needs("images")
        | needs("pardiso")
        <= pinned
    )


@pytest.mark.parametrize("module", ["palpate_server.__main__", "palpate_server.diagnostics.check_host"])
def test_the_server_loads_nothing_of_the_offline_side(module: str) -> None:
    loaded = loaded_after(module)
    assert {"numpy", "numba", "zenoh"} <= loaded
    assert not loaded & (_OFFLINE - {"scipy"})  # numba itself looks at scipy's version where it is installed
    assert run(f"import {module}", without=_OFFLINE).returncode == 0


def test_the_model_file_needs_numpy_alone() -> None:
    assert not loaded_after("palpate.model_file") & (_OFFLINE | {"numba", "zenoh", "msgpack"})


def test_the_command_line_starts_without_any_package() -> None:
    loaded = loaded_after("palpate.cli, palpate.commands, palpate.stages")
    assert not loaded & (_OFFLINE | {"numpy", "numba", "zenoh", "msgpack"})


def test_a_client_runs_without_numpy() -> None:
    for name in ("client", "health"):
        module = COMMANDS[name].module
        done = run(f"import {module}", without={"numpy", "numba", "mcap"} | _OFFLINE)
        assert done.returncode == 0, done.stderr


@pytest.mark.parametrize(
    ("arguments", "missing", "extra"),
    [
        (["build", "scene.toml"], "pydantic", "build"),
        (["fit", "record.csv"], "scipy", "build"),
        (["inspect", "model.npz"], "numpy", "server"),
        (["serve", "model.npz"], "numba", "server"),
        (["check-host"], "numba", "server"),
        (["record", "out.mcap"], "zenoh", ""),
        (["replay", "in.mcap", "model.npz"], "mcap", "recorder"),
        (["view"], "viser", "view"),
        (["demo"], "scipy", "all"),
        (["reproduce"], "scipy", "experiments"),
        (["health"], "zenoh", ""),
    ],
)
def test_a_command_whose_extra_is_missing_says_which_one_to_install(
    arguments: list[str], missing: str, extra: str
) -> None:
    code = f"sys.argv = ['palpate', *{arguments!r}]; from palpate.__main__ import main; main()"
    done = run(code, without={missing})
    wanted = f"palpate[{extra}]" if extra else "palpate"
    assert done.returncode == 2
    assert done.stderr == (
        f"error: {arguments[0]} needs the package {missing}, which is not installed: pip install '{wanted}'\n"
    )
