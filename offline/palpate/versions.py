"""The versions that matter: of palpate, of what it computes with, of the wire and of the model file."""

from __future__ import annotations

import json
import platform
from importlib.metadata import PackageNotFoundError, version

from palpate_client.wire import SCHEMA_VERSION as WIRE_VERSION

_PACKAGES = ("palpate", "numpy", "scipy", "numba", "eclipse-zenoh", "msgpack")


def versions_text(as_json: bool = False) -> str:
    """A line for each, or a JSON object; a package that is not installed is null there."""
    found: dict[str, str | int | None] = {name: _installed(name) for name in _PACKAGES}
    found |= {"python": platform.python_version(), "wire": WIRE_VERSION, "model_file": _model_file()}
    if as_json:
        return json.dumps(found, indent=2)
    return "\n".join(f"{name:<16}{value or 'not installed'}" for name, value in found.items())


def _model_file() -> int | None:
    try:
        from palpate.model_file.types import SCHEMA_VERSION
    except ModuleNotFoundError:  # without numpy no model is read
        return None
    return SCHEMA_VERSION


def _installed(name: str) -> str | None:
    try:
        return version(name)
    except PackageNotFoundError:
        return None
