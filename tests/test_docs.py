"""The documentation: links that resolve, a reference that is current, and a site that builds."""

from __future__ import annotations

import importlib.util
import os
import re
import shlex
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import scene_reference

from palpate.completion import whole_parser
from palpate.model_file import SurfaceModel, save_model

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
PAGES = sorted(DOCS.rglob("*.md"))
FENCE = re.compile(r"^( *)(`{3,}|~{3,}).*?^\1\2 *$", re.MULTILINE | re.DOTALL)
LINK = re.compile(r"\[(?:[^\[\]]|\[[^\]]*\])*\]\(([^)\s]+)\)")
HEADING = re.compile(r"^#{1,6} (.+)$", re.MULTILINE)


def prose(page: Path) -> str:
    """The page without its code blocks and code in backticks."""
    return re.sub(r"`[^`\n]*`", "", FENCE.sub("", page.read_text()))


def anchors(page: Path) -> set[str]:
    """Of the page's headings, as GitHub and Python-Markdown make them, which agree where no two dashes meet."""
    found = set()
    for heading in HEADING.findall(FENCE.sub("", page.read_text())):
        text = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", heading).replace("`", "").lower()
        found.add(re.sub(r"[^\w\- ]", "", text).strip().replace(" ", "-"))
    return found


def links(page: Path) -> Iterator[str]:
    return (target for target in LINK.findall(prose(page)) if not re.match(r"[a-z]+:", target))


@pytest.mark.parametrize("page", [ROOT / "README.md", *PAGES], ids=lambda p: str(p.relative_to(ROOT)))
def test_every_relative_link_leads_somewhere(page: Path) -> None:
    for target in links(page):
        path, _, anchor = target.partition("#")
        file = (page.parent / path).resolve() if path else page
        assert file.exists(), f"{target}: no such file"
        if anchor:
            assert anchor in anchors(file), (
                f"{target}: no such heading, expected one of {sorted(anchors(file))}"
            )


def test_a_link_to_a_heading_that_is_not_there_is_found(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text(
        "# Title\n\n[a](#title) [b](#other) [c](none.md) `[d](e)`\n\n```\n[f](g)\n# No title\n```\n"
    )
    assert list(links(page)) == ["#title", "#other", "none.md"]
    assert anchors(page) == {"title"}


def test_every_page_is_in_the_navigation() -> None:
    def files(entry: object) -> Iterator[str]:
        if isinstance(entry, str):
            yield entry
        elif isinstance(entry, dict | list):
            for inner in entry.values() if isinstance(entry, dict) else entry:
                yield from files(inner)

    navigation = list(files(tomllib.loads((ROOT / "zensical.toml").read_text())["project"]["nav"]))
    assert sorted(navigation) == sorted(str(page.relative_to(DOCS)) for page in PAGES)


def test_the_reference_of_scene_files_is_current() -> None:
    assert (DOCS / "scene.md").read_text() == scene_reference.page(), "run python scripts/scene_reference.py"


COMMAND = re.compile(r"^(?:until )?palpate ([a-z][a-z-]* .*)$", re.MULTILINE)
SHELL = re.compile(r"^ *```sh\n(.*?)^ *```$", re.MULTILINE | re.DOTALL)


def commands(page: Path) -> Iterator[list[str]]:
    """The arguments of each `palpate` in the page's shell blocks, without what the shell takes for itself."""
    for text in COMMAND.findall("\n".join(SHELL.findall(page.read_text()))):
        words = shlex.split(text, comments=True)
        end = next(
            (i for i, word in enumerate(words) if re.match(r"\d?[>&|]", word) or word.endswith(";")), None
        )
        yield [
            word.rstrip(";") for word in (words if end is None else words[: end + words[end].endswith(";")])
        ]


def test_every_command_that_a_page_shows_is_understood() -> None:
    parser = whole_parser()
    shown = [line for page in (ROOT / "README.md", *PAGES) for line in commands(page)]
    assert len(shown) > 20
    for line in shown:
        try:
            parser.parse_args(line)
        except SystemExit:
            pytest.fail(f"palpate {' '.join(line)}")
    with pytest.raises(SystemExit):
        parser.parse_args(["build", "--no-such-option"])


def test_the_loop_of_the_how_to_runs(
    make_surface_model: Callable[..., SurfaceModel],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    save_model(make_surface_model(), tmp_path / "liver-surface.npz")
    monkeypatch.chdir(tmp_path)
    (code,) = re.findall(r"^```python\n(.*?)^```$", (DOCS / "howto.md").read_text(), re.MULTILINE | re.DOTALL)
    exec(compile(code, "howto.md", "exec"), {})
    first, second = capsys.readouterr().out.splitlines()
    assert first == second


def _site(folder: Path) -> subprocess.CompletedProcess[str]:
    """Builds the site of a copy of all that it is made of."""
    for name in ("docs", "scripts", "offline", "server", "client"):
        shutil.copytree(ROOT / name, folder / name, dirs_exist_ok=True)
    shutil.copy(ROOT / "zensical.toml", folder)
    return subprocess.run(
        [sys.executable, "-m", "zensical", "build", "--strict"],
        cwd=folder,
        env=os.environ | {"PYTHONPATH": "scripts"},
        capture_output=True,
        text=True,
        timeout=240,
        check=False,
    )


needs_docs = pytest.mark.skipif(
    importlib.util.find_spec("zensical") is None, reason="needs palpate[docs], which `make docs` installs"
)


@needs_docs
def test_the_site_builds_and_shows_equations_and_docstrings(tmp_path: Path) -> None:
    done = _site(tmp_path)
    assert done.returncode == 0, done.stdout + done.stderr
    site = tmp_path / "build" / "site"
    assert "<math" in (site / "method.html").read_text()
    assert "$" not in re.sub(
        r"<(script|code).*?</\1>", "", (site / "method.html").read_text(), flags=re.DOTALL
    )
    assert "position" in (site / "api" / "simulation.html").read_text()


@needs_docs
@pytest.mark.slow
def test_a_broken_anchor_ends_the_build(tmp_path: Path) -> None:
    assert _site(tmp_path).returncode == 0
    page = tmp_path / "docs" / "howto.md"
    page.write_text(page.read_text().replace("(tour.md#a-scene)", "(tour.md#no-such-scene)"))
    again = subprocess.run(
        [sys.executable, "-m", "zensical", "build", "--strict"],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": "scripts"},
        capture_output=True,
        text=True,
        timeout=240,
        check=False,
    )
    assert again.returncode != 0
    plain = re.sub(r"\x1b\[[\d;]*m", "", again.stdout + again.stderr)  # each letter has a color of its own
    assert "no-such-scene" in plain
