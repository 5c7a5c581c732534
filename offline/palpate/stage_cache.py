"""Finished stages of builds, kept in a folder under the hash of what they depend on.

One file a stage: a pickle of its dataclasses, then the SHA-256 of that. A file appears by a rename when it is complete, so
a build that is cut off leaves no damaged one. Beside it lies a lock, by which of several builds that want the same stage
one computes it and the others wait. The folder belongs to one user alone, because a pickle runs code when it is read.
"""

from __future__ import annotations

import fcntl
import hashlib
import json
import os
import pickle
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, fields, is_dataclass
from pathlib import Path
from typing import IO, Any, TypeVar

from palpate.files import make_folder, printable

Value = TypeVar("Value")

MOST_BYTES = 8 * 2**30
"""Size of the folder. Beyond it the stages that were not used for longest are removed."""

_SUFFIX, _PART = ".stage", ".part"
_CHUNK = 1 << 24


def default_folder() -> Path:
    """`palpate` in $XDG_CACHE_HOME, else in ~/.cache."""
    root = os.environ.get("XDG_CACHE_HOME")
    return (Path(root) if root else Path.home() / ".cache") / "palpate"


def key_of(*parts: object) -> str:
    """A hash of numbers, strings, lists and tables of them."""
    return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()[:32]


@dataclass(frozen=True)
class StageCache:
    """The stages kept in a folder; with None nothing is kept.

    `open` makes the folder.
    """

    folder: Path | None = None
    most_bytes: int = MOST_BYTES

    @classmethod
    def open(cls, folder: Path, most_bytes: int = MOST_BYTES) -> StageCache:
        """Raises OSError where the folder can't be made or others can write to it."""
        make_folder(folder)
        folder.chmod(folder.stat().st_mode & ~0o077)  # raises where it belongs to someone else
        return cls(folder, most_bytes)

    def kept(self, stage: str, key: str, compute: Callable[[], Value]) -> Value:
        """The stage of this key: read, or computed and kept. Raises what `compute` raises, OSError where the disk is full."""
        with self.alone(stage, key):
            value: Value | None = self.load(stage, key)
            if value is None:
                value = compute()
                self.store(stage, key, value)
        return value

    @contextmanager
    def alone(self, stage: str, key: str) -> Iterator[None]:
        """Nobody else is in here with the same stage and key. Ends with the process, however that ends."""
        if self.folder is None:
            yield
            return
        with (self.folder / f"{stage}-{key}.lock").open("w") as file:
            fcntl.flock(file, fcntl.LOCK_EX)
            yield

    def load(self, stage: str, key: str) -> Any | None:
        """What was stored, or None; a damaged file counts as none."""
        if self.folder is None:
            return None
        try:
            with self._path(stage, key).open("rb") as file:
                if not _is_whole(file):
                    return None
                os.utime(file.fileno())
                return pickle.load(file)
        except FileNotFoundError:
            return None

    def store(self, stage: str, key: str, value: object) -> None:
        """Replaces what was stored. Raises OSError where nothing can be written."""
        if self.folder is None:
            return
        descriptor, name = tempfile.mkstemp(dir=self.folder, prefix=f"{stage}-", suffix=_PART)
        temporary = Path(name)
        try:
            with os.fdopen(descriptor, "wb") as file:
                fcntl.flock(file, fcntl.LOCK_EX)  # tells it from what a killed build has left behind
                hashing = _HashingWriter(file)
                _FieldsPickler(hashing, protocol=5).dump(value)
                file.write(hashing.digest.digest())
                file.flush()
                os.fsync(file.fileno())
                temporary.replace(self._path(stage, key))
        except OSError as error:
            raise OSError(
                f"{printable(self.folder)}: a stage could not be kept ({error.strerror}): free some room, name another "
                "folder by --cache, or use --no-cache"
            ) from error
        finally:
            temporary.unlink(missing_ok=True)
        self._prune()

    def _path(self, stage: str, key: str) -> Path:
        assert self.folder is not None
        return self.folder / f"{stage}-{key}{_SUFFIX}"

    def _prune(self) -> None:
        """Remove stages beyond the bound, those not used for longest first, and unfinished ones that nobody writes."""
        assert self.folder is not None
        for part in self.folder.glob(f"*{_PART}"):
            if not _is_locked(part):
                part.unlink(missing_ok=True)
        stages = []
        for path in self.folder.glob(f"*{_SUFFIX}"):
            try:
                found = path.stat()
            except FileNotFoundError:
                continue
            stages.append((found.st_mtime_ns, found.st_size, path))
        total = sum(size for _, size, _ in stages)
        for _, size, path in sorted(stages):
            if total <= self.most_bytes:
                break
            path.unlink(missing_ok=True)
            path.with_suffix(".lock").unlink(missing_ok=True)
            total -= size


NO_CACHE = StageCache()
"""Keeps nothing."""


class _FieldsPickler(pickle.Pickler):
    """Of a dataclass only the fields are written, not what it has computed from them and remembers."""

    def reducer_override(self, obj: Any) -> Any:
        if is_dataclass(obj) and not isinstance(obj, type):
            return _rebuilt, (type(obj), tuple(getattr(obj, field.name) for field in fields(obj)))
        return NotImplemented


def _rebuilt(kind: Callable[..., Any], values: tuple[Any, ...]) -> Any:
    return kind(*values)


class _HashingWriter:
    def __init__(self, file: IO[bytes]) -> None:
        self._file = file
        self.digest = hashlib.sha256()

    def write(self, data: Any) -> int:
        self.digest.update(data)
        return self._file.write(data)


def _is_whole(file: IO[bytes]) -> bool:
    """Whether the file ends with the hash of what is before; leaves it at its beginning."""
    digest = hashlib.sha256()
    left = os.fstat(file.fileno()).st_size - digest.digest_size
    while left > 0:
        chunk = file.read(min(left, _CHUNK))
        if not chunk:
            return False
        digest.update(chunk)
        left -= len(chunk)
    same = left == 0 and file.read() == digest.digest()
    file.seek(0)
    return same


def _is_locked(path: Path) -> bool:
    try:
        with path.open("rb") as file:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except FileNotFoundError:
        return False
    except BlockingIOError:
        return True
    return False
