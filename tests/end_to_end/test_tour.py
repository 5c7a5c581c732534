"""Every command of docs/tour.md, as a reader types it."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

import pytest

from palpate_client.local_server import free_endpoint

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "tour.md").read_text()
BLOCKS = re.findall(r"^```sh\n(.*?)^```$", PAGE, re.MULTILINE | re.DOTALL)
PATIENCE_S = 840.0


def block(words: str) -> str:
    (found,) = [text for text in BLOCKS if words in text]
    return found


def run(folder: Path, *blocks: str) -> str:
    """The output of the blocks in one shell, in a folder that looks like a clone, at a port of its own."""
    endpoint = free_endpoint()
    (folder / "configs").symlink_to(ROOT / "configs")
    (folder / "client_examples").mkdir()
    program = (ROOT / "client_examples" / "first_program.py").read_text()
    (folder / "client_examples" / "first_program.py").write_text(
        program.replace("tcp/127.0.0.1:7447", endpoint)
    )
    text = "\n".join(blocks)
    text = text.replace("palpate serve ", f"palpate serve --listen {endpoint} ")
    text = re.sub(r"palpate (health|client)", rf"palpate \1 --connect {endpoint}", text)
    shell = subprocess.Popen(
        ["bash", "-c", f"set -e; trap 'kill $(jobs -p) 2>/dev/null || true; wait' EXIT\n{text}"],
        cwd=folder,
        env=os.environ | {"PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}"},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    try:
        out, err = shell.communicate(timeout=PATIENCE_S)
    finally:
        with suppress(ProcessLookupError):  # nothing is left of the shell and what it started
            os.killpg(shell.pid, signal.SIGKILL)
    assert shell.returncode == 0, out + err
    return out


def test_the_program_on_the_page_is_the_one_in_the_examples() -> None:
    (shown,) = re.findall(r"^```python\n(.*?)^```$", PAGE, re.MULTILINE | re.DOTALL)
    assert shown in (ROOT / "client_examples" / "first_program.py").read_text()


def test_the_quick_commands(tmp_path: Path) -> None:
    told = run(tmp_path, block("palpate inspect"), block("--dry-run"))
    assert "544 states instead of 978" in told
    assert "my-organ" in told


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_all_commands_but_the_installation(tmp_path: Path) -> None:
    install, *others = BLOCKS
    assert "make .venv" in install
    told = run(tmp_path, *others)
    assert "3.0 mm deep" in told
    assert "verdict: fair" in told
    assert "verdict: good in the working areas" in told
    for made in ("poke.csv", "my-organ.npz", "press.png", "touchable.npz", "touch.png"):
        assert (tmp_path / made).stat().st_size > 1000
