"""Files that are there whole or not at all, and names that stay in their folder."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path
from typing import TypeGuard

LONGEST_NAME_BYTES = 255  # on the usual file systems


def is_plain_name(name: object) -> TypeGuard[str]:
    """True for what can be a file's name, and leads into no other folder than the one it is looked for in."""
    return (
        isinstance(name, str)
        and name not in ("", ".", "..")
        and Path(name).name == name
        and "\0" not in name
        and len(os.fsencode(name)) <= LONGEST_NAME_BYTES
    )


def write_whole(path: Path, data: bytes) -> None:
    """Write to a temporary file beside `path`, then rename: readers see the old file or the whole new one.

    Makes the folders that are missing. Raises OSError; then nothing is left behind.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    descriptor, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.", suffix=".part")
    try:
        with os.fdopen(descriptor, "wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        Path(temporary).chmod(0o644)
        Path(temporary).replace(path)
    except BaseException:
        Path(temporary).unlink(missing_ok=True)
        raise
