"""Writing a model file."""

from __future__ import annotations

import hashlib
import io
import json
import zipfile
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.files import write_atomically
from palpate.model_file.check import check_model
from palpate.model_file.members import CHECKSUM, LAYOUTS, METADATA, arrays_of
from palpate.model_file.surface_model import SurfaceModel
from palpate.model_file.types import ReducedModel


def save_model(model: ReducedModel | SurfaceModel, path: Path, inputs: Iterable[Path] = ()) -> None:
    """Write a model file; readers see the old file or the complete new one.

    inputs  files that may not be overwritten: what the model was built from

    Raises ModelFileError for a model that `load_model` would refuse, OSError where nothing can be written.
    """
    check_model(model)
    layout = LAYOUTS[model.kind]
    members = {name: _npy(array, layout[name][0]) for name, array in arrays_of(model).items()}
    metadata = json.dumps(model.metadata(), allow_nan=False).encode()
    members[METADATA] = _npy(np.frombuffer(metadata, np.uint8), "|u1")

    digest = hashlib.sha256()
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        for name in sorted(members):
            digest.update(name.encode() + b"\0" + members[name])
            archive.writestr(_entry(name), members[name], compresslevel=1)  # mantissas hardly compress
        archive.writestr(_entry(CHECKSUM), _npy(np.frombuffer(digest.digest(), np.uint8), "|u1"))
    write_atomically(path, buffer.getvalue(), inputs)


def _npy(array: NDArray[Any], dtype: str) -> bytes:
    stream = io.BytesIO()
    np.lib.format.write_array(
        stream, np.ascontiguousarray(array, dtype=dtype), version=(1, 0), allow_pickle=False
    )
    return stream.getvalue()


def _entry(name: str) -> zipfile.ZipInfo:
    """A fixed date, so that the same model gives the same bytes."""
    entry = zipfile.ZipInfo(f"{name}.npy")
    entry.compress_type = zipfile.ZIP_DEFLATED
    return entry
