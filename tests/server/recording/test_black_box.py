"""The black box: when it writes, what is in the file, and that it does not write too often."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from palpate.model_file import ReducedModel
from palpate_server.coupling.models import make_running
from palpate_server.realtime import scheduler, shared_memory
from palpate_server.realtime.native_image import make_image
from palpate_server.realtime.safety import HOLD_NS, Limits
from palpate_server.realtime.shared_memory import Memory
from palpate_server.recording import black_box
from palpate_server.recording.black_box import BlackBox

PERIOD_NS = 1_000_000


def run(memory: Memory, ticks: int, depth_m: float, first: int = 0) -> None:
    image = make_image(memory)
    lease = int(memory.commands.lease[0])
    for i in range(first, first + ticks):
        now = time.monotonic_ns()
        memory.shared[shared_memory.DEADLINE_NS] = now + PERIOD_NS // 4
        position, still = (0.0, 0.0, depth_m), (0.0, 0.0, 0.0)
        memory.commands.incoming[0] = (0, lease, i, 7, now, -1, position, still, 0)
        assert scheduler.arrive(image, 1) == 1


def silence(memory: Memory, ticks: int, *, released: bool = False) -> None:
    """Ticks after the client has fallen silent, or has released its tool."""
    image = make_image(memory)
    if released:
        scheduler.forget_command(memory.commands, 0)
    silent_ns = time.monotonic_ns() + (0 if released else HOLD_NS)
    for i in range(1, ticks + 1):
        now = silent_ns + i * PERIOD_NS
        scheduler.repeat_tick(image, now, now, False)


@pytest.fixture
def memory(make_spring_mass_model: Callable[..., ReducedModel]) -> Memory:
    model = make_spring_mass_model()
    return shared_memory.make_memory(
        make_running(model), model.period_s, [Limits(0.01, 1e9, 1e6, 1.0, 0.0)], 1 / 30
    )


def test_nothing_is_written_while_all_is_well(memory: Memory, tmp_path: Path) -> None:
    box = BlackBox(tmp_path, "s", ["tip"], memory)
    silence(memory, 10)  # nobody has come yet: stale, but no event
    assert box.examine() is None
    run(memory, 1500, 1e-9)
    assert box.examine() is None
    silence(memory, 100, released=True)  # stale too, as it should be
    assert box.examine() is None
    assert list(tmp_path.iterdir()) == []


def test_a_stale_input_is_written_once_with_the_ticks_before_it(memory: Memory, tmp_path: Path) -> None:
    box = BlackBox(tmp_path / "new", "s", ["tip"], memory)
    run(memory, 2500, 1e-9)
    assert box.examine() is None
    silence(memory, 100)
    writing = box.examine()
    assert writing is not None
    writing.join()
    (path,) = (tmp_path / "new").glob("palpate-s-*-stale.npz")
    with np.load(path, allow_pickle=False) as file:
        assert file["tools"].tolist() == ["tip"]
        np.testing.assert_array_equal(file["ticks"]["tick"], np.arange(600, 2600))
        np.testing.assert_array_equal(file["ports"]["sequence"][:1900, 0], np.arange(600, 2500))
        assert file["ports"]["force_n"].shape == (2000, 1, 3)
    run(memory, 100, 1e-9, first=3000)
    silence(memory, 100)
    assert box.examine() is None  # too soon after the last one


def test_a_lost_client_is_written_once_and_files_come_to_an_end(
    memory: Memory, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(black_box, "QUIET_S", 0.0)
    box = BlackBox(tmp_path, "s", ["tip"], memory)
    for lost in range(1, 111):
        run(memory, 1, 1e-9, first=lost)
        assert box.examine(lost) is None  # waits for the fading
        writing = box.examine(lost)
        assert (writing is None) == (lost > black_box.MOST_FILES)
        assert box.examine(lost) is None
        if writing is not None:
            writing.join()
    assert len(list(tmp_path.glob("*-lost.npz"))) == black_box.MOST_FILES


def test_a_fault_and_a_storm_of_limits_are_named(memory: Memory, tmp_path: Path) -> None:
    box = BlackBox(tmp_path, "s", ["tip"], memory)
    run(memory, 1500, 1e-2)  # beyond the force limit all the time
    writing = box.examine()
    assert writing is not None
    writing.join()
    assert len(list(tmp_path.glob("*-limits.npz"))) == 1

    memory.coupling.running.patch.body.state[0] = (
        np.nan
    )  # right after: a fault is not lost because of what came before it
    run(memory, 5, 0.0, first=2000)
    writing = box.examine()
    assert writing is not None
    writing.join()
    assert len(list(tmp_path.glob("*-fault.npz"))) == 1


def test_a_folder_that_cannot_be_written_is_only_a_warning(
    memory: Memory, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "file").write_text("")
    box = BlackBox(tmp_path / "file", "s", ["tip"], memory)
    run(memory, 1500, 1e-2)
    writing = box.examine()
    assert writing is not None
    writing.join()
    assert "could not be written" in caplog.text
