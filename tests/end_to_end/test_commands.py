"""The command line as docs/commands.md has it: each exit code and each JSON field in its tables, completion, versions, --debug."""

from __future__ import annotations

import contextlib
import json
import os
import re
import signal
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import yaml

from palpate import cli
from palpate_client import poke
from palpate_client.wire import SCHEMA_VERSION
from palpate_server.diagnostics import check_host
from palpate_server.diagnostics.sample_model import spring_mass_model
from palpate_server.recording import record, replay

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "commands.md").read_text(encoding="utf-8")
NOWHERE = "tcp/127.0.0.1:1"
REPORT = {"file": "a.mcap", "messages": 7, "missing_ticks": 0, "error": None}
SAME = replay.Comparison(9, 9, 1, 1, None, ())


def table(title: str) -> list[list[str]]:
    """The cells of the first table below a heading of the page, without its head."""
    below = PAGE.partition(f"\n## {title}\n")[2]
    lines = [line for line in below.partition("\n## ")[0].splitlines() if line.startswith("|")]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines[2:]]


@pytest.fixture(scope="module")
def shared(serve_for_module: Callable[..., Any]) -> Any:
    """A server that no test harms."""
    return serve_for_module()


@pytest.fixture
def run(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> Callable[..., tuple[int, str, str]]:
    """run("health", ...) -> code, output, errors: the command line in this process."""

    def run(*arguments: str) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["palpate", *arguments])
        capfd.readouterr()
        try:
            code = cli.main()
        except SystemExit as end:  # argparse
            code = int(end.code or 0)
        out, err = capfd.readouterr()
        return code, out, err

    before = (
        signal.getsignal(signal.SIGINT),
        signal.getsignal(signal.SIGTERM),
        signal.getsignal(signal.SIGHUP),
    )
    yield run
    for number, handler in zip((signal.SIGINT, signal.SIGTERM, signal.SIGHUP), before, strict=True):
        signal.signal(number, handler)


# Exit codes


def interrupted(_: Any) -> int:
    """A client whose server takes the connection and says nothing."""
    with socket.socket() as silent:
        silent.bind(("127.0.0.1", 0))
        silent.listen()
        silent.settimeout(60)
        place = f"tcp/127.0.0.1:{silent.getsockname()[1]}"
        client = subprocess.Popen([sys.executable, "-m", "palpate", "client", "--connect", place])
        connection = silent.accept()[0]
        client.send_signal(signal.SIGINT)
        code = client.wait(60)
        connection.close()
    return code


def unread(_: Any, *arguments: str) -> int:
    reading, writing = os.pipe()
    os.close(reading)
    command = [sys.executable, "-m", "palpate", *(arguments or ("tissues",))]
    try:
        ended = subprocess.run(command, stdout=writing, stderr=subprocess.PIPE, timeout=60)
        assert not ended.stderr
        return ended.returncode
    finally:
        os.close(writing)


def poor_host(case: Any) -> int:
    finding = check_host.Finding("timer lateness", "", {}, check_host.NOT_SUFFICIENT)
    case.patch.setattr(check_host, "transport_round_trip", lambda: [finding])
    case.patch.setattr(check_host, "tick_run", lambda path, seconds: [])
    case.patch.setattr(check_host, "under_load", lambda path: finding)
    return int(case.run("check-host")[0])


def tool_lost(case: Any) -> int:
    with case.connect(case.served.endpoint) as observer:
        place = (
            "--connect",
            case.served.endpoint,
            "--session",
            "test",
            "--name",
            "loser",
            "--silence-s",
            "30",
        )
        client = case.start("-m", "palpate", "client", *place, "--duration-s", "60")
        observer.status_when(lambda status: status["tools"]["tip"]["holder"] == "loser", "the holder")
        observer.force_when(lambda force: force["sequence"][0] > 10, "its commands")
        assert observer.query("control/loser/release", {"kind": "request", "schema_version": 2})[0]
        return int(client.finish()[0])


def unwritten(case: Any) -> int:
    case.patch.setattr(poke, "wrote", lambda *_: False)
    place = ("--connect", case.served.endpoint, "--session", "test", "--silence-s", "30")
    return int(case.run("client", *place, "--duration-s", "0.2", "--record", str(case.folder / "a.csv"))[0])


def recorded(case: Any, *more: str, **report: Any) -> tuple[int, str, str]:
    case.patch.setattr(record, "connection_for", lambda options: contextlib.nullcontext())
    case.patch.setattr(record, "record", lambda *_: REPORT | report)
    result: tuple[int, str, str] = case.run("record", "a.mcap", *more)
    return result


def replayed(case: Any, comparison: replay.Comparison, *more: str) -> tuple[int, str, str]:
    case.patch.setattr(replay, "read_recording", lambda path: None)
    case.patch.setattr(replay, "load_model", lambda path: None)
    case.patch.setattr(replay, "compare", lambda recorded, models: comparison)
    result: tuple[int, str, str] = case.run("replay", "a.mcap", "m.npz", *more)
    return result


CODES: dict[tuple[str, int], Callable[[Any], int]] = {
    ("every command", 0): lambda case: case.run("tissues")[0],
    ("every command", 2): lambda case: case.run("build", "none.toml")[0],
    ("every command", 130): interrupted,
    ("every command", 141): unread,
    ("check-host", 1): poor_host,
    ("health", 1): lambda case: case.run("health", "--connect", NOWHERE)[0],
    ("client", 1): tool_lost,
    ("client", 3): unwritten,
    ("record", 1): lambda case: recorded(case, error="the disk is full")[0],
    ("replay", 1): lambda case: replayed(case, replay.Comparison(3, 9, 1, 1, "tick 3 differs", ()))[0],
    ("replay", 3): lambda case: replayed(case, replay.Comparison(3, 9, 1, 1, None, ("other",)))[0],
}


@pytest.fixture
def case(
    shared: Any, run: Any, start: Any, connect: Any, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> Any:
    return SimpleNamespace(
        served=shared, run=run, start=start, connect=connect, patch=monkeypatch, folder=tmp_path
    )


def test_the_page_has_each_exit_code_that_is_tried_here() -> None:
    assert [(row[0].strip("`"), int(row[1])) for row in table("Exit codes")] == list(CODES)


@pytest.mark.parametrize(("command", "code"), CODES)
def test_each_exit_code_of_the_page_is_the_one_that_comes(case: Any, command: str, code: int) -> None:
    assert CODES[command, code](case) == code


# JSON


def fields(command: str) -> set[str]:
    """The names in the row of a command, without those in parentheses."""
    (row,) = [row for row in table("JSON") if row[0] == f"`{command}`"]
    return set(re.findall(r"`([\w-]+)`", re.sub(r"\([^()]*\)", "", row[1])))


def test_the_json_of_each_command_has_the_fields_of_the_page(
    case: Any, make_spring_mass_model: Callable[..., Any]
) -> None:
    place = ("--connect", case.served.endpoint, "--session", "test")
    assert set(json.loads(case.run("--version", "--json")[1])) == fields("--version")
    assert set(json.loads(case.run("tissues", "--json")[1])[0]) == fields("tissues")
    assert set(json.loads(case.run("health", "--json", *place)[1])) == fields("health")
    unhealthy = case.run("health", "--json", "--connect", NOWHERE)
    assert unhealthy[0] == 1
    told = json.loads(unhealthy[1])
    assert set(told) == fields("health")
    assert (told["healthy"], told["ticks"]) == (False, None)
    assert "palpate serve" in told["reason"]
    moved = case.run("client", *place, "--json", "--duration-s", "0.2", "--silence-s", "30")
    assert set(json.loads(moved[1])) == fields("client")
    assert set(json.loads(recorded(case, "--json")[1])) == fields("record")
    assert set(json.loads(replayed(case, SAME, "--json")[1])) == fields("replay")
    finding = check_host.Finding("ping", "", {}, check_host.GOOD)
    case.patch.setattr(check_host, "transport_round_trip", lambda: [finding])
    case.patch.setattr(check_host, "tick_run", lambda path, seconds: [])
    case.patch.setattr(check_host, "under_load", lambda path: finding)
    assert set(json.loads(case.run("check-host", "--json")[1])) == fields("check-host")


def test_the_json_of_what_builds_has_the_fields_of_the_page(
    case: Any, slab_scene: Callable[..., str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(case.folder)
    Path("slab.toml").write_text(slab_scene())
    expected = case.run("build", "slab.toml", "--dry-run", "--json")
    assert set(json.loads(expected[1])) == fields("build --dry-run")
    code, out, err = case.run("build", "slab.toml", "--json", "--no-cache")
    assert code == 0, err
    built = json.loads(out)
    assert "node cloud" in err
    read = json.loads(case.run("inspect", "slab.npz", "--json")[1])
    assert set(built) == set(read) | (fields("build") - {"inspect"})
    assert {name: built[name] for name in read} == read
    cube = ROOT / "tests" / "data" / "cases" / "good-ellipsoid.stl"
    mended = case.run("repair", str(cube), "-o", "mended.ply", "--json")
    assert mended[0] == 0, mended[2]
    assert set(json.loads(mended[1])) == {"file", "notes"}


# Errors, versions, completion


def test_debug_raises_what_is_told_in_a_line_otherwise(
    run: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PALPATE_DEBUG", "")  # and as it was afterwards
    for arguments in (("build", "none.toml"), ("client", "--connect", NOWHERE)):
        code, _, err = run(*arguments)
        assert code == 2
        assert len(err.splitlines()) == 1
    for arguments in (("--debug", "build", "none.toml"), ("client", "--connect", NOWHERE, "--debug")):
        with pytest.raises(Exception, match=r"none\.toml|nothing answers at tcp/127\.0\.0\.1:1"):
            run(*arguments)
        monkeypatch.setenv("PALPATE_DEBUG", "")


def test_a_mistyped_command_gets_the_nearest_one(run: Callable[..., Any]) -> None:
    code, _, err = run("chek-host")
    assert code == 2
    assert err.endswith("did you mean 'check-host'?\n")


@pytest.mark.parametrize("option", ["--version", "--help"])
def test_no_reader_of_the_output_is_no_error(option: str) -> None:
    assert unread(None, option) == 141


def test_the_order_of_version_and_json_does_not_matter(run: Callable[..., Any]) -> None:
    assert run("--json", "--version") == run("--version", "--json")


def test_the_version_has_a_line_for_all_that_matters(run: Callable[..., Any]) -> None:
    code, out, _ = run("--version")
    lines = dict(line.split() for line in out.splitlines())
    assert code == 0
    assert set(lines) == fields("--version")
    assert lines["wire"] == str(SCHEMA_VERSION)
    assert lines["python"] == ".".join(map(str, sys.version_info[:3]))


@pytest.fixture(scope="module")
def bash_completion(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    pytest.importorskip("shtab")
    script = tmp_path_factory.mktemp("completion") / "palpate.bash"
    with script.open("w") as out:
        subprocess.run(
            [sys.executable, "-m", "palpate", "completion", "bash"], stdout=out, check=True, timeout=120
        )
    yield script


def completed(script: Path, *words: str) -> set[str]:
    """What bash offers in place of the last word."""
    quoted = " ".join(f"'{word}'" for word in ("palpate", *words))
    ask = f"COMP_WORDS=({quoted}); COMP_CWORD={len(words)}; _shtab_palpate; printf '%s\\n' \"${{COMPREPLY[@]}}\""
    done = subprocess.run(
        ["bash", "--norc", "-c", f"source {script}; {ask}"], capture_output=True, text=True, timeout=60
    )
    return set(done.stdout.split())


def test_bash_completes_commands_options_and_choices(bash_completion: Path) -> None:
    assert completed(bash_completion, "") >= set(cli.COMMANDS)
    assert completed(bash_completion, "re") == {"repair", "record", "replay", "reproduce"}
    assert completed(bash_completion, "client", "--tr") == {"--trajectory"}
    assert "--max-force-n" in completed(bash_completion, "serve", "--max")
    assert completed(bash_completion, "client", "--motion", "") == {"poke", "sine"}


@pytest.mark.parametrize("shell", ["zsh", "fish"])
def test_other_shells_get_a_script_with_every_command(run: Callable[..., Any], shell: str) -> None:
    pytest.importorskip("shtab")
    code, out, _ = run("completion", shell)
    assert code == 0
    assert all(name in out for name in cli.COMMANDS)


# The container, which can't run here


def test_the_containers_commands_are_commands(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Targets of compose.yaml are stages of the Dockerfile, and what they run is understood by the command line."""
    services = yaml.safe_load((ROOT / "compose.yaml").read_text())["services"]
    dockerfile = (ROOT / "Dockerfile").read_text()
    stages = re.findall(r"^FROM \S+ AS (\w+)$", dockerfile, re.MULTILINE)
    assert stages[-1] == "serve"  # the default target
    build = services["build"]
    assert build["build"]["target"] in stages
    assert build["volumes"] == ["./models:/models"]
    assert "WORKDIR /models" in dockerfile.partition("AS build")[2].partition("FROM ")[0]
    from palpate.completion import whole_parser

    commands = [build["command"], services["client"]["command"]]
    commands += [json.loads(line) for line in re.findall(r"^CMD (\[.*\])$", dockerfile, re.MULTILINE)]
    commands += [
        line.split()[1:] for line in re.findall(r"palpate-build (build .*)$", PAGE, re.MULTILINE)
    ] and [line.split() for line in re.findall(r"palpate-build (build .*)$", PAGE, re.MULTILINE)]
    for command in commands:
        if "--help" not in command:
            whole_parser().parse_args(command)
    for source in re.findall(r"^COPY (?!--from)(.*) \S+$", dockerfile, re.MULTILINE):
        assert all((ROOT / name).exists() for name in source.split())


# A trajectory


def test_the_headless_client_moves_as_a_file_says(shared: Any, case: Any) -> None:
    start, file, out = (
        spring_mass_model(1, 20).contacts[0].center_m,
        case.folder / "a.csv",
        case.folder / "b.csv",
    )
    x, y, z = (float(c) for c in start)
    file.write_text(f"t_s,x_m,y_m,z_m\n0,{x},{y},{z}\n0.3,{x},{y},{z - 0.002}\n0.6,{x},{y},{z}\n")
    place = ("--connect", shared.endpoint, "--session", "test", "--silence-s", "30")
    code, printed, err = case.run("client", *place, "--trajectory", str(file), "--record", str(out), "--json")
    assert code == 0, err
    assert json.loads(printed)["commands_sent"] == 600
    rows = [line.split(",") for line in out.read_text().splitlines()]
    deepest = min(float(row[rows[0].index("tip.position_z_m")]) for row in rows[1:])
    assert deepest == pytest.approx(z - 0.002, abs=2e-4)


def test_a_trajectory_that_is_wrong_is_told_before_anything_moves(run: Any, tmp_path: Path) -> None:
    file = tmp_path / "a.csv"
    file.write_text("t_s,x_m,y_m,z_m\n0,0,0,0\n1,0,0,inf\n")
    code, _, err = run("client", "--connect", NOWHERE, "--trajectory", str(file))
    assert code == 2
    assert err == f"palpate client: {file}: line 3, z_m: 'inf', expected a finite number\n"


# Hints


def test_an_error_about_a_file_hints_at_the_right_one(
    run: Any, tmp_path: Path, slab_scene: Callable[..., str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("slab.toml").write_text(slab_scene())
    Path("slab.npz").write_bytes(b"PK\x03\x04\xff")
    for arguments, says in (
        (("build", "slap.toml"), "slap.toml: no such configuration; did you mean slab.toml?"),
        (("inspect", "slabs.npz"), "slabs.npz: no such model file; did you mean slab.npz?"),
        (("inspect", "slab.toml"), "; a scene becomes a model with `palpate build`"),
        (("build", "slab.npz"), "; a model is run with `palpate serve`"),
    ):
        code, _, err = run(*arguments)
        assert code == 2
        assert err.rstrip().endswith(says)
        assert len(err.splitlines()) == 1
