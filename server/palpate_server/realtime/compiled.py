"""How functions of the real-time path are compiled: cached on disk where that is possible, with and without the GIL."""

# mypy: disable-error-code="no-untyped-call"
from __future__ import annotations

import hashlib
import warnings
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, TypeVar, cast

from numba import njit
from numba.core.caching import FunctionCache, IndexDataCacheFile

from palpate_client import wire

_COMPILED_ROOMS = ("bodies", "coupling", "realtime")

Function = TypeVar("Function", bound=Callable[..., Any])


def compiled(function: Function) -> Function:
    """Compile `function`, every operation as written; Python calls it with the GIL held, so use it for microseconds.

    Nothing is compiled with `fastmath`: how sums are then reordered differs between two compilations of the same code, and a
    replay would not be exact. And a test for NaN on such sums is optimized away.
    """
    return _compile(function, nogil=False)


def compiled_without_gil(function: Function) -> Function:
    """Compile `function`; it releases the GIL for as long as it runs."""
    return _compile(function, nogil=True)


class _Cache(FunctionCache):
    """numba's cache on disk, under names that change as soon as any file with compiled functions does.

    numba looks at the function's own file alone, although what it stores contains functions of other files. It also reads
    an entry before it finds that the entry is out of date, which fails where a type has moved. So the name changes.
    """

    def __init__(self, function: Callable[..., Any]) -> None:
        super().__init__(function)
        digest = _package_digest()
        name = f"{self._impl.filename_base}-{digest[:16]}"
        self._cache_file = IndexDataCacheFile(self.cache_path, name, digest)


@cache
def _package_digest() -> str:
    """The hash of all names and contents of the source files that compiled functions are made from."""
    digest = hashlib.sha256()
    folder = Path(__file__).parents[1]
    paths = [path for room in _COMPILED_ROOMS for path in folder.joinpath(room).glob("*.py")]
    for path in [*sorted(paths), folder / "codec.py", Path(wire.__file__)]:
        source = path.read_bytes()
        digest.update(f"{path.name} {len(source)}\n".encode() + source)
    return digest.hexdigest()


def _compile(function: Function, *, nogil: bool) -> Function:
    dispatcher: Any = njit(nogil=nogil)(function)
    try:
        dispatcher._cache = _Cache(function)
    except RuntimeError as error:  # no writable directory: a read-only container, another user's files
        warnings.warn(
            f"compiled functions are not cached, every start takes seconds longer ({error}); "
            "point NUMBA_CACHE_DIR to a writable directory",
            RuntimeWarning,
            stacklevel=3,
        )
    return cast(Function, dispatcher)
