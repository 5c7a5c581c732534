"""A file is written as a whole or not at all, and nothing but a plain file or a new name is written to."""

from __future__ import annotations

import os
import socket
from collections.abc import Callable
from pathlib import Path

import pytest

from palpate.files import check_output, is_plain_name, make_folder, printable, write_atomically


def make_plain(path: Path) -> None:
    path.write_bytes(b"before")


def make_link_to(target: str) -> Callable[[Path], None]:
    return lambda path: path.symlink_to(target)


def make_socket(path: Path) -> None:
    with socket.socket(socket.AF_UNIX) as server:
        server.bind(str(path))


@pytest.mark.parametrize(
    ("make", "kind"),
    [
        (Path.mkdir, "folder"),
        (os.mkfifo, "pipe"),
        (make_link_to("elsewhere"), "link"),
        (make_link_to("/dev/null"), "link"),
        (make_socket, "socket"),
    ],
)
def test_what_is_not_a_plain_file_is_refused_and_stays(
    tmp_path: Path, make: Callable[[Path], None], kind: str
) -> None:
    path = tmp_path / "out"
    make(path)
    before = path.lstat()
    for write in (check_output, lambda p: write_atomically(p, b"new")):
        with pytest.raises(OSError, match=f"out is a {kind}: expected a plain file or a new name"):
            write(path)
    assert path.lstat().st_mode == before.st_mode
    assert [p.name for p in tmp_path.iterdir()] == ["out"]


@pytest.mark.parametrize("make", [make_plain, os.mkfifo, make_link_to("elsewhere")])
def test_a_folder_for_output_takes_no_other_files_place(tmp_path: Path, make: Callable[[Path], None]) -> None:
    path = tmp_path / "out"
    make(path)
    for folder in (path, path / "images"):
        with pytest.raises(OSError, match=f"{folder}: the folder can't be made"):
            make_folder(folder)
    assert [p.name for p in tmp_path.iterdir()] == ["out"]


def test_a_folder_that_is_there_has_to_be_writable() -> None:
    with pytest.raises(OSError, match="/proc: can't write to /proc"):
        make_folder(Path("/proc"))


def test_a_device_is_refused() -> None:
    device = Path("/dev/null")
    before = device.stat().st_rdev
    with pytest.raises(OSError, match="/dev/null is a device"):
        write_atomically(device, b"new")
    assert device.is_char_device()
    assert device.stat().st_rdev == before


def test_an_input_is_not_overwritten_under_any_name(tmp_path: Path) -> None:
    scene = tmp_path / "scene.toml"
    make_plain(scene)
    os.link(scene, tmp_path / "hard.toml")
    for name in ("scene.toml", "../" + tmp_path.name + "/scene.toml", "hard.toml"):
        with pytest.raises(OSError, match="is an input of this command"):
            write_atomically(tmp_path / name, b"new", [tmp_path / "absent", scene])
    assert scene.read_bytes() == b"before"


def test_a_plain_file_is_replaced_and_missing_folders_are_made(tmp_path: Path) -> None:
    path = tmp_path / "a" / "b" / "out"
    write_atomically(path, b"one")
    write_atomically(path, b"two")
    assert path.read_bytes() == b"two"
    assert [p.name for p in path.parent.iterdir()] == ["out"]


def test_a_name_of_the_longest_length_can_be_written(tmp_path: Path) -> None:
    path = tmp_path / ("x" * 255)
    write_atomically(path, b"one")
    assert path.read_bytes() == b"one"


@pytest.mark.parametrize("name", ["plain/x", "x" * 256])
def test_a_name_that_can_not_be_written_is_in_the_message(tmp_path: Path, name: str) -> None:
    make_plain(tmp_path / "plain")
    with pytest.raises(OSError, match=f"{name[:100]}.*"):
        write_atomically(tmp_path / name, b"new")
    assert [p.name for p in tmp_path.iterdir()] == ["plain"]


def test_a_full_disk_names_the_file_and_leaves_the_old_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "out"
    make_plain(path)

    def full(descriptor: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="out: could not be written: No space left on device"):
        write_atomically(path, b"new")
    assert path.read_bytes() == b"before"
    assert [p.name for p in tmp_path.iterdir()] == ["out"]


def test_a_full_disk_leaves_no_folder_that_was_made(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "there").mkdir()

    def full(descriptor: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space left on device"):
        write_atomically(tmp_path / "there" / "new" / "newer" / "out", b"new")
    assert list((tmp_path / "there").iterdir()) == []


@pytest.mark.parametrize(
    "name", ["", ".", "..", "a/b", "a\0", "a\nb", "a\x1b[2J", "\u202egpm", "\ud800", "x" * 256, 3, None]
)
def test_names_that_lead_elsewhere_or_can_not_be_shown(name: object) -> None:
    assert not is_plain_name(name)


def test_names_that_can_be_used() -> None:
    assert all(is_plain_name(name) for name in ("a", "a.npz", "Leber 2 (größer).npz", "x" * 255))


def test_what_is_shown_is_one_printable_line() -> None:
    assert printable("a\n\x1b[31m\u202e\ud800é") == r"a\n\x1b[31m\u202e\ud800é"
    assert printable("x" * 1000, 200) == "x" * 200 + "... (1000 characters)"
