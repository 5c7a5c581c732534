"""What is compiled once is found again, and found out of date when any file with compiled functions has changed."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from palpate_server.realtime import compiled

CALLEE = "from gauge.realtime.compiled import compiled\n\n@compiled\ndef callee(x):\n    return {} * x\n"
CALLER = "from gauge.realtime import callee\nfrom gauge.realtime.compiled import compiled\n\n@compiled\ndef caller(x):\n    return callee.callee(x) + 1.0\n"
CALL = """
import json
import warnings
with warnings.catch_warnings(record=True) as seen:
    warnings.simplefilter("always")
    from gauge.realtime.caller import caller
result = caller(1.0)
hits = sum(caller.stats.cache_hits.values())
print(json.dumps({"result": result, "hits": hits, "path": caller.stats.cache_path, "warnings": [str(w.message) for w in seen]}))
"""


@pytest.fixture
def package(tmp_path: Path) -> Path:
    """The room `realtime` of a package `gauge`, with two modules that use the very file under test."""
    folder = tmp_path / "source" / "gauge" / "realtime"
    folder.mkdir(parents=True)
    shutil.copy(compiled.__file__, folder / "compiled.py")
    for path in (folder / "__init__.py", folder.parent / "__init__.py", folder.parent / "codec.py"):
        path.touch()
    (folder / "callee.py").write_text(CALLEE.format("2.0"))
    (folder / "caller.py").write_text(CALLER)
    return folder


def call(package: Path, **environment: str) -> dict[str, Any]:
    inherited = {name: value for name, value in os.environ.items() if not name.startswith("NUMBA_")}
    run = subprocess.run(
        [sys.executable, "-c", CALL],
        env=inherited | {"PYTHONPATH": str(package.parents[1]), "PYTHONDONTWRITEBYTECODE": "1"} | environment,
        capture_output=True,
        text=True,
        timeout=120,
        check=True,
    )
    answer: dict[str, Any] = json.loads(run.stdout)
    return answer


def test_an_edit_of_any_file_makes_all_compiled_code_out_of_date_and_nothing_else_does(
    package: Path, tmp_path: Path
) -> None:
    folder = tmp_path / "cache"
    first = call(package, NUMBA_CACHE_DIR=str(folder))
    assert (first["result"], first["hits"], first["warnings"]) == (3.0, 0, [])
    assert Path(first["path"]).parent == folder
    for path in package.iterdir():
        if path.suffix == ".py":
            os.utime(path, (0, 0))  # an image's layers and installers change times, not contents
    again = call(package, NUMBA_CACHE_DIR=str(folder))
    assert (again["result"], again["hits"]) == (3.0, 1)
    (package / "callee.py").write_text(CALLEE.format("5.0"))  # caller.py, which has its code inlined, stays
    edited = call(package, NUMBA_CACHE_DIR=str(folder))
    assert (edited["result"], edited["hits"]) == (6.0, 0)
    for index in folder.rglob("*.nbi"):
        index.write_bytes(index.read_bytes()[:-20])  # of the version before: must not even be read
    for another in (package / "another.py", package.parent / "codec.py"):
        another.write_text("NUMBER = 1\n")
        assert call(package, NUMBA_CACHE_DIR=str(folder))["hits"] == 0
    (package.parent / "session.py").write_text("NUMBER = 1\n")
    assert call(package, NUMBA_CACHE_DIR=str(folder))["hits"] == 1


def test_without_another_place_compiled_code_is_kept_beside_the_source(package: Path) -> None:
    first, again = call(package), call(package)
    assert Path(again["path"]) == package / "__pycache__"
    assert (first["hits"], again["hits"]) == (0, 1)


def test_where_nothing_can_be_written_functions_are_compiled_at_every_start_with_a_warning(
    package: Path, tmp_path: Path
) -> None:
    (package / "__pycache__").touch()  # a file where numba wants a folder: that stops root too
    in_the_way = tmp_path / "file"
    in_the_way.touch()
    for _ in range(2):
        answer = call(package, XDG_CACHE_HOME=str(in_the_way), HOME=str(in_the_way))
        assert (answer["result"], answer["hits"]) == (3.0, 0)
        assert "NUMBA_CACHE_DIR" in answer["warnings"][0]
