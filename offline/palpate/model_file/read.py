"""Reading a model file from an untrusted source: what it declares is checked before any of its data is unpacked."""

from __future__ import annotations

import hashlib
import json
import re
import zipfile
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path
from typing import IO, Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from palpate.files import missing, printable
from palpate.lti.pole_residue import PoleResidueSystem
from palpate.model_file.check import check_model, refuse
from palpate.model_file.members import (
    CHECKSUM,
    LAYOUTS,
    MAX_METADATA_BYTES,
    MAX_TOTAL_BYTES,
    METADATA,
    Header,
    check_shapes,
    unpacked,
)
from palpate.model_file.surface_model import SURFACE_SCALARS, SurfaceAccuracy, SurfaceModel, ToolShape
from palpate.model_file.types import (
    FORMAT,
    SCALARS,
    SCHEMA_VERSION,
    UNITS,
    AccuracyReport,
    Contact,
    ModelFileError,
    ReducedModel,
    StateSpace,
    Surface,
)

_END = b"PK\5\6"  # opens the zip's last record, of 22 bytes
_END_OF_ZIP64 = b"PK\6\7"
_MAX_DIRECTORY_BYTES = 2**16
_MAX_HEADER_BYTES = 1024
_CHUNK_BYTES = 2**20

# The header as numpy writes it. Nothing in a file is evaluated or unpickled.
_NPY_HEADER = re.compile(
    rb"\{'descr': '([<|][a-z]\d{1,2})', 'fortran_order': False, 'shape': \(((?:\d{1,10}, ?)*(?:\d{1,10})?)\), \} *\n"
)

Part = TypeVar("Part")


def load_model(path: str | Path) -> ReducedModel | SurfaceModel:
    """Read and check a model file. Memory stays within twice `MAX_TOTAL_BYTES`, whatever the file holds.

    Raises FileNotFoundError if there is none, OSError if it can't be opened, and ModelFileError, in one line that names
    the field, if it is damaged, cut short, foreign, of another schema, or inconsistent in itself.
    """
    path = Path(path)
    shown = printable(path)
    if not path.is_file():
        raise missing(path, "model file")
    with path.open("rb") as file:
        try:
            model = _read(file)
            check_model(model)
        except ModelFileError as error:
            hint = "; a scene becomes a model with `palpate build`" if path.suffix == ".toml" else ""
            raise ModelFileError(f"{shown}: {error}{hint}") from error
        except MemoryError:
            raise
        except Exception as error:  # zipfile and zlib raise a dozen kinds on damaged bytes
            cause = printable(error) or type(error).__name__
            raise ModelFileError(f"{shown}: damaged or not an .npz archive ({cause})") from error
    return model


def load_patch_model(path: str | Path) -> ReducedModel:
    """Read a model whose tools are bound to patches. Raises as `load_model`, and ModelFileError for another kind."""
    model = load_model(path)
    if isinstance(model, SurfaceModel):
        raise ModelFileError(
            f"{printable(path)}: field 'kind' is {model.kind!r}: expected {ReducedModel.kind!r}, which this command can use"
        )
    return model


def _read(file: IO[bytes]) -> ReducedModel | SurfaceModel:
    _check_directory(file)
    with zipfile.ZipFile(file) as archive:
        _check_sizes(archive)
        metadata = _metadata(archive)
        kind = metadata["kind"]
        known = {f"{name}.npy" for name in (METADATA, CHECKSUM, *LAYOUTS[kind])}
        for member in archive.namelist():
            if member not in known:
                shown = printable(member.removesuffix(".npy"), 80)
                raise ModelFileError(f"field '{shown}' is unknown: expected none beside a model's")
        check_shapes({name: _open(archive, name)[1] for name in LAYOUTS[kind]}, kind)
        arrays = _arrays(archive, list(LAYOUTS[kind]))
    return _surface_model(metadata, arrays) if kind == SurfaceModel.kind else _patch_model(metadata, arrays)


def _check_directory(file: IO[bytes]) -> None:
    """Check the zip's last record before zipfile reads the list of members, however long it says that is."""
    size = file.seek(0, 2)
    file.seek(max(0, size - 42))
    tail = file.read(42)
    record = tail[-22:]
    if record[:4] != _END or record[20:] != b"\0\0" or tail[:4] == _END_OF_ZIP64:
        raise ModelFileError("damaged or not an .npz archive (no zip directory at its end; is it cut short?)")
    if int.from_bytes(record[12:16], "little") > _MAX_DIRECTORY_BYTES:
        raise ModelFileError(f"damaged: its zip directory is longer than {_MAX_DIRECTORY_BYTES} bytes")


def _check_sizes(archive: zipfile.ZipFile) -> None:
    """Check that each member is there once, in plain form, and that the declared sizes are within bounds."""
    entries = archive.infolist()
    for entry in entries:
        shown = printable(entry.filename.removesuffix(".npy"), 80)
        if archive.getinfo(entry.filename) is not entry:
            raise ModelFileError(f"field '{shown}' is there twice: expected it once")
        if entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED) or entry.flag_bits & ~0x800:
            raise ModelFileError(f"field '{shown}' is packed otherwise: expected stored or deflated")
    total = sum(entry.file_size for entry in entries)
    if total > MAX_TOTAL_BYTES:
        raise ModelFileError(f"its members unpack to {total:,} bytes: expected at most {MAX_TOTAL_BYTES:,}")


def _open(archive: zipfile.ZipFile, name: str) -> tuple[IO[bytes], Header, bytes]:
    """(stream at the first byte of the data, header, header's bytes) of a member whose size is what it declares."""
    try:
        entry = archive.getinfo(f"{name}.npy")
    except KeyError:
        hint = ": not a palpate model" if name == METADATA else ""
        raise ModelFileError(f"field '{name}' is missing{hint}") from None
    stream = archive.open(entry)
    opening = stream.read(10)
    length = int.from_bytes(opening[8:], "little")
    text = stream.read(length) if length <= _MAX_HEADER_BYTES else b""
    match = _NPY_HEADER.fullmatch(text)
    if opening[:8] != b"\x93NUMPY\1\0" or match is None:
        raise refuse(
            name, "in another form", "an array in .npy format 1.0, in C order, without Python objects"
        )
    shape = tuple(int(n) for n in match[2].replace(b" ", b"").split(b",") if n)
    header = Header(match[1].decode(), shape)
    if len(opening) + length + header.n_bytes != entry.file_size:
        raise refuse(name, header, f"an array of the {entry.file_size:,} bytes that the archive declares")
    return stream, header, opening + text


def _take(archive: zipfile.ZipFile, name: str, digest: Any) -> NDArray[Any]:
    """The array of a member; `digest` takes in its name and bytes."""
    stream, header, opening = _open(archive, name)
    digest.update(name.encode() + b"\0" + opening)
    array = np.empty(header.shape, dtype=header.dtype)
    data = array.reshape(-1).view(np.uint8).data
    with stream:
        for start in range(0, len(data), _CHUNK_BYTES):
            chunk = data[start : start + _CHUNK_BYTES]
            piece = stream.read(len(chunk))
            if len(piece) < len(chunk):
                raise refuse(name, "cut short", f"{header.n_bytes:,} bytes of data")
            chunk[:] = piece
            digest.update(piece)
    return array


def _bytes(archive: zipfile.ZipFile, name: str) -> bytes:
    """The data of a member that is text or a checksum."""
    _, header, _ = _open(archive, name)
    if header.dtype != "|u1" or len(header.shape) != 1 or header.n_bytes > MAX_METADATA_BYTES:
        raise refuse(name, header, f"|u1 in one dimension, of at most {MAX_METADATA_BYTES:,} bytes")
    return _take(archive, name, hashlib.sha256()).tobytes()


def _arrays(archive: zipfile.ZipFile, names: list[str]) -> dict[str, NDArray[Any]]:
    """The arrays. Raises ModelFileError where the checksum of all members is wrong."""
    digest = hashlib.sha256()
    arrays = {name: _take(archive, name, digest) for name in sorted([*names, METADATA])}
    if _bytes(archive, CHECKSUM) != digest.digest():
        raise ModelFileError(
            "field 'sha256' is not the checksum of the content: the file is damaged, build it again"
        )
    return arrays


def _metadata(archive: zipfile.ZipFile) -> dict[str, Any]:
    """The metadata, of this format, schema and kind; its values have not been checked yet."""
    text = _bytes(archive, METADATA)
    try:
        scalars = json.loads(text.decode())
    except (ValueError, RecursionError) as error:
        cause = "nested too deeply" if isinstance(error, RecursionError) else printable(error)
        raise ModelFileError(f"field 'metadata' is not JSON: {cause}") from error
    if not isinstance(scalars, dict) or scalars.get("format") != FORMAT:
        shown = scalars.get("format") if isinstance(scalars, dict) else scalars
        raise refuse("format", repr(shown), f"{FORMAT!r}; not a palpate model")
    version = scalars.get("schema_version")
    if version != SCHEMA_VERSION:
        newer = type(version) is int and version > SCHEMA_VERSION
        hint = (
            "it was written by a newer palpate, upgrade this one"
            if newer
            else "it was written by an older palpate, build it again with `palpate build`"
        )
        raise refuse("schema_version", repr(version), f"{SCHEMA_VERSION}; {hint}")
    if not (isinstance(scalars.get("kind"), str) and scalars["kind"] in LAYOUTS):
        raise refuse("kind", repr(scalars.get("kind")), " or ".join(map(repr, LAYOUTS)))
    return scalars


def _units(scalars: dict[str, Any]) -> None:
    _exactly(scalars["units"], "units.", list(UNITS))
    for quantity, unit in UNITS.items():
        if scalars["units"][quantity] != unit:
            raise refuse(f"units.{quantity}", repr(scalars["units"][quantity]), repr(unit))


def _surface_model(scalars: dict[str, Any], arrays: dict[str, NDArray[Any]]) -> SurfaceModel:
    """A surface model, of parts whose values have not been checked yet."""
    stated = ["format", "schema_version", "kind", "units", *SURFACE_SCALARS, "band_hz", "tools", "accuracy"]
    _exactly(scalars, "", stated)
    _units(scalars)
    if not isinstance(scalars["tools"], list):
        raise refuse("tools", repr(scalars["tools"]), "a list")
    _exactly(
        scalars["accuracy"], "accuracy.", [f.name for f in fields(SurfaceAccuracy) if f.name != "error_map"]
    )
    if not np.all(arrays["held"] <= 1):
        raise refuse("held", int(arrays["held"].max()), "0 or 1 for each point")
    plain = ("points", "normals", "triangles", "squared_frequencies", "shapes", "gamma", "tau_s")
    stored: dict[str, Any] = {name: arrays[name] for name in plain}
    return SurfaceModel(
        **{name: scalars[name] for name in SURFACE_SCALARS},
        band_hz=_numbers(scalars["band_hz"], "band_hz"),
        tools=tuple(_tool(table, f"tools[{i}].") for i, table in enumerate(scalars["tools"])),
        held=arrays["held"].astype(bool),
        residual=unpacked(arrays["residual"]),
        accuracy=SurfaceAccuracy(**scalars["accuracy"], error_map=arrays["error_map"]),
        **stored,
    )


def _tool(table: Any, where: str) -> ToolShape:
    _exactly(table, where, [field.name for field in fields(ToolShape)])
    return ToolShape(**table | {"home_m": _numbers(table["home_m"], where + "home_m")})


def _patch_model(scalars: dict[str, Any], arrays: dict[str, NDArray[Any]]) -> ReducedModel:
    """A patch model, of parts whose values have not been checked yet."""
    _exactly(scalars, "", ["format", "schema_version", "kind", "units", *SCALARS, "contacts", "accuracy"])
    _units(scalars)
    if not isinstance(scalars["contacts"], list):
        raise refuse("contacts", repr(scalars["contacts"]), "a list")
    of_file = [field.name for field in fields(AccuracyReport) if field.name != "hankel_singular_values"]
    _exactly(scalars["accuracy"], "accuracy.", of_file)
    band = _numbers(scalars["accuracy"]["band_hz"], "accuracy.band_hz")
    return ReducedModel(
        **{name: scalars[name] for name in SCALARS},
        contacts=tuple(_contact(table, f"contacts[{i}].") for i, table in enumerate(scalars["contacts"])),
        continuous=_part(StateSpace, arrays, "continuous"),
        discrete=_part(StateSpace, arrays, "discrete"),
        full=_part(PoleResidueSystem, arrays, "full"),
        static_stiffness=arrays["static_stiffness"],
        surface=_part(Surface, arrays, "surface"),
        accuracy=AccuracyReport(
            **scalars["accuracy"] | {"band_hz": band}, hankel_singular_values=arrays["hankel_singular_values"]
        ),
    )


def _contact(table: Any, where: str) -> Contact:
    _exactly(table, where, [field.name for field in fields(Contact)])
    vectors = {name: _numbers(table[name], where + name) for name in ("center_m", "normal")}
    return Contact(**table | vectors)


def _part(kind: Callable[..., Part], arrays: dict[str, NDArray[Any]], group: str) -> Part:
    """A group of arrays, such as `discrete_...`, as one data class."""
    prefix = f"{group}_"
    return kind(**{n.removeprefix(prefix): array for n, array in arrays.items() if n.startswith(prefix)})


def _numbers(value: Any, field: str) -> tuple[Any, ...]:
    if not isinstance(value, list):
        raise refuse(field, repr(value), "a list of numbers")
    return tuple(value)


def _exactly(table: Any, where: str, names: list[str]) -> None:
    """Check that a table of the metadata has these keys and no other."""
    if not isinstance(table, dict):
        raise refuse(where.rstrip(".") or METADATA, repr(table), "a table")
    for name in names:
        if name not in table:
            raise ModelFileError(f"field '{where}{name}' is missing")
    for name in table:
        if name not in names:
            raise ModelFileError(
                f"field '{where}{printable(name, 80)}' is unknown: expected {', '.join(names)}"
            )
