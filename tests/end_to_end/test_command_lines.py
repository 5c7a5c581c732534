"""What is asked for on a command line and can't be had: one line that says so, and code 2."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from palpate.model_file import ReducedModel, save_model
from palpate_client import poke
from palpate_server.__main__ import main as serve_main
from palpate_server.diagnostics import check_host
from palpate_server.recording import record


def assert_is_refused(program: Any, words: str) -> None:
    code, _, err = program.finish()
    assert code == 2, err
    assert len(err.splitlines()) == 1
    assert words in err


def test_a_recording_that_exists_is_not_written_over(
    serve: Callable[..., Any], start: Callable[..., Any], tmp_path: Path
) -> None:
    out = tmp_path / "earlier.mcap"
    out.write_bytes(b"an hour of work")
    served = serve("--recordings", str(tmp_path))
    options = ("--session", "test", "--duration-s", "0.1", "--connect", served.endpoint)
    for name, words in (
        ("earlier.mcap", "earlier.mcap exists"),
        ("a\n.mcap", "expected the name of a new file"),
    ):
        assert_is_refused(start("-m", "palpate_server.recording.record", name, *options), words)
    assert out.read_bytes() == b"an hour of work"


def test_without_a_server_nothing_is_recorded(start: Callable[..., Any]) -> None:
    recorder = start("-m", "palpate_server.recording.record", "new.mcap", "--connect", "tcp/127.0.0.1:1")
    assert_is_refused(recorder, "tcp/127.0.0.1:1")


def refusal(call: Callable[[list[str]], object], *options: str, capsys: pytest.CaptureFixture[str]) -> str:
    """The last line that argparse prints."""
    with pytest.raises(SystemExit) as caught:
        call(list(options))
    assert caught.value.code == 2
    return capsys.readouterr().err.splitlines()[-1]


@pytest.mark.parametrize("value", ["nan", "inf", "-5", "0", "abc", "1e308", "1e-308"])
def test_a_quantity_is_a_number_above_zero_of_which_no_product_overflows(
    value: str, capsys: pytest.CaptureFixture[str]
) -> None:
    expected = f"{value!r} is not a number from 1e-09 to 1e+09"
    assert expected in refusal(check_host.main, f"--seconds={value}", capsys=capsys)
    assert expected in refusal(serve_main, "m.npz", f"--max-force-n={value}", capsys=capsys)
    assert expected in refusal(serve_main, "m.npz", f"--max-recordings-gb={value}", capsys=capsys)
    assert expected in refusal(serve_main, "m.npz", f"--surface-hz={value}", capsys=capsys)
    assert expected in refusal(record.main, "a.mcap", f"--duration-s={value}", capsys=capsys)
    assert expected in refusal(poke.main, f"--rate-hz={value}", capsys=capsys)


@pytest.mark.parametrize("value", ["abc", "-1", "1.5"])
def test_a_processor_is_an_integer(value: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert f"{value!r} is not an integer, 0 or more" in refusal(
        serve_main, "m.npz", f"--cpu={value}", capsys=capsys
    )


def test_a_check_of_the_host_takes_an_hour_at_most(capsys: pytest.CaptureFixture[str]) -> None:
    assert "'1e6' is above 3600" in refusal(check_host.main, "--seconds=1e6", capsys=capsys)


def test_a_folder_that_cannot_be_used_is_found_at_the_start(
    start: Callable[..., Any], tmp_path: Path, make_spring_mass_model: Callable[..., ReducedModel]
) -> None:
    model, file = tmp_path / "model.npz", tmp_path / "file"
    save_model(make_spring_mass_model(1, 2), model)
    file.touch()
    wrong = [
        (option, folder)
        for option in ("--models", "--black-box", "--recordings")
        for folder in (Path("/proc/nothing"), file)
    ]
    place = ("--listen", "tcp/127.0.0.1:0")
    programs = [start("-m", "palpate_server", model, *place, *option) for option in wrong]
    for (option, folder), program in zip(wrong, programs, strict=True):
        assert_is_refused(program, f"{option} {folder}")
