"""Names that are safe to show and to open, and atomic writing of files."""

from __future__ import annotations

import difflib
import os
import stat
import tempfile
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from typing import TypeGuard

LONGEST_NAME_BYTES = 255  # on the usual file systems


def printable(text: object, longest: int | None = None) -> str:
    """The text of an object on one line, for a terminal or a log, cut after `longest` characters.

    Control and bidirectional characters, line breaks and lone surrogates become escapes.
    """
    shown = str(text)
    if longest is not None and len(shown) > longest:
        shown = f"{shown[:longest]}... ({len(shown)} characters)"
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in shown)


def is_plain_name(name: object) -> TypeGuard[str]:
    """True for a name without a folder that is safe to show."""
    return (
        isinstance(name, str)
        and name not in ("", ".", "..")
        and "/" not in name
        and name.isprintable()
        and len(os.fsencode(name)) <= LONGEST_NAME_BYTES
    )


def missing(path: Path, what: str) -> FileNotFoundError:
    """The error for a file that is not there, with the name in its folder that is most like it."""
    try:
        names = [entry.name for entry in path.parent.iterdir()]
    except OSError:
        names = []
    near = difflib.get_close_matches(path.name, names, 1)
    hint = f"; did you mean {path.parent / near[0]}?" if near else ""
    return FileNotFoundError(printable(f"{path}: no such {what}{hint}"))


def check_output(path: Path, inputs: Iterable[Path] = ()) -> None:
    """Check that a file can be written at `path`. Called before long work, and again before the file is replaced.

    inputs  files that the same command reads; none of them may be overwritten

    Raises OSError, in one line that names the path, if it is a folder, link, device, pipe or socket, if it is one of
    the inputs, or if its folder can't be written to.
    """
    shown = printable(path)
    kind = _kind(path)
    if kind not in ("", "plain file"):
        raise OSError(f"{shown} is a {kind}: expected a plain file or a new name")
    for file in inputs:
        if kind and file.exists() and path.samefile(file):
            raise OSError(f"{shown} is an input of this command: expected another name for the output")
    folder = path.parent
    while not folder.exists() and folder != folder.parent:
        folder = folder.parent
    _try_to_write(path, folder)


def make_folder(path: Path) -> None:
    """Make a folder for output unless it is there. Raises OSError, in one line, when that can't be, or it can't be written to."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OSError(f"{printable(path)}: the folder can't be made ({error.strerror})") from error
    _try_to_write(path, path)


def _try_to_write(path: Path, folder: Path) -> None:
    try:
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise OSError(f"{printable(path)}: can't write to {printable(folder)} ({error.strerror})") from error


def write_atomically(path: Path, data: bytes, inputs: Iterable[Path] = ()) -> None:
    """Write a temporary file beside `path`, then rename it: readers see the old file or the complete new one.

    Makes the folders that are missing. Raises OSError as `check_output` does and when the disk is full; then nothing
    is left behind.
    """
    check_output(path, inputs)
    missing = [folder for folder in path.parents if not folder.exists()]
    temporary: Path | None = None
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        descriptor, name = tempfile.mkstemp(dir=path.parent, prefix=".palpate-", suffix=".part")
        temporary = Path(name)
        with os.fdopen(descriptor, "wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        temporary.chmod(0o644)
        temporary.replace(path)
    except OSError as error:
        raise OSError(f"{printable(path)}: could not be written: {error.strerror}") from error
    finally:
        if temporary is not None:
            temporary.unlink(missing_ok=True)
        with suppress(OSError):  # the first that is not empty: a file stands in it
            for folder in missing:
                folder.rmdir()


def _kind(path: Path) -> str:
    """The kind of file at `path`, links not followed; empty if there is none."""
    try:
        mode = path.lstat().st_mode
    except (FileNotFoundError, NotADirectoryError):
        return ""
    except OSError as error:
        raise OSError(f"{printable(path)}: {error.strerror}") from error
    tests = {
        "plain file": stat.S_ISREG,
        "folder": stat.S_ISDIR,
        "link": stat.S_ISLNK,
        "pipe": stat.S_ISFIFO,
        "socket": stat.S_ISSOCK,
    }
    return next((name for name, test in tests.items() if test(mode)), "device")
