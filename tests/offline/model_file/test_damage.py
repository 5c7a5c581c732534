"""A damaged or hostile file costs little memory and ends in one line, or it is still the same model to the bit."""

from __future__ import annotations

import struct
import tracemalloc
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from palpate.model_file import ModelFileError, ReducedModel, load_model, save_model

_BOUND_BYTES = 8 * 2**20
"""Peak memory allowed for a model of a few kilobytes: chunks of 1 MiB, and bounded tables."""


@pytest.fixture
def refused_or_same(
    model_path: Path, small_model: Callable[[], ReducedModel], assert_same: Callable[[Any, Any], None]
) -> Callable[[bytes], bool]:
    """Loads a file of these bytes; True if it was refused. Any other exception, or another model, fails the test."""
    expected = small_model()

    def check(data: bytes) -> bool:
        model_path.write_bytes(data)
        tracemalloc.start()
        try:
            assert_same(load_model(model_path), expected)
        except ModelFileError as error:
            assert str(error).isprintable()
            assert "()" not in str(error)
            return True
        finally:
            peak = tracemalloc.get_traced_memory()[1]
            tracemalloc.stop()
            assert peak < _BOUND_BYTES
        return False

    return check


def test_a_flipped_bit(model_path: Path, refused_or_same: Callable[[bytes], bool]) -> None:
    data = model_path.read_bytes()
    random = np.random.default_rng(12)
    positions = random.choice(8 * len(data), size=150, replace=False)
    refused = 0
    for position in positions.tolist():
        damaged = bytearray(data)
        damaged[position // 8] ^= 1 << position % 8
        refused += refused_or_same(bytes(damaged))
    # Dates, attributes and versions in the zip's headers are no content.
    assert refused > len(positions) // 2


def test_a_flipped_bit_in_the_headers_of_the_zip(
    model_path: Path, refused_or_same: Callable[[bytes], bool]
) -> None:
    data = model_path.read_bytes()
    start = data.index(b"PK\1\2")
    for offset in [*range(40), *range(start, start + 72), *range(len(data) - 22, len(data))]:
        damaged = bytearray(data)
        damaged[offset] ^= 1 << offset % 8
        refused_or_same(bytes(damaged))


def test_a_truncated_file(model_path: Path, refused_or_same: Callable[[bytes], bool]) -> None:
    data = model_path.read_bytes()
    for length in [*range(0, len(data), 397), *range(len(data) - 24, len(data))]:
        assert refused_or_same(data[:length])


def test_bytes_before_and_after(model_path: Path, refused_or_same: Callable[[bytes], bool]) -> None:
    data = model_path.read_bytes()
    assert refused_or_same(data + b"x")
    refused_or_same(b"x" + data)
    refused_or_same(data + data)


def test_members_that_are_swapped(model_path: Path, refused_or_same: Callable[[bytes], bool]) -> None:
    with zipfile.ZipFile(model_path) as archive:
        members = {entry.filename: archive.read(entry) for entry in archive.infolist()}
    random = np.random.default_rng(8)
    names = list(members)
    for _ in range(20):
        one, other = random.choice(len(names), size=2, replace=False)
        swapped = dict(members)
        swapped[names[one]], swapped[names[other]] = members[names[other]], members[names[one]]
        with zipfile.ZipFile(model_path, "w") as archive:
            for name, content in swapped.items():
                archive.writestr(name, content)
        same = members[names[one]] == members[names[other]]
        assert refused_or_same(model_path.read_bytes()) != same


def test_a_member_of_another_model(
    model_path: Path, small_model: Callable[[], ReducedModel], refused_or_same: Callable[[bytes], bool]
) -> None:
    stiffer = small_model()
    stiffer.static_stiffness[:] *= 2
    other = model_path.with_name("other.npz")
    save_model(stiffer, other)
    with zipfile.ZipFile(model_path) as archive, zipfile.ZipFile(other) as donor:
        members = {n: archive.read(n) for n in archive.namelist()}
        members["static_stiffness.npy"] = donor.read("static_stiffness.npy")
    with zipfile.ZipFile(model_path, "w") as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    assert refused_or_same(model_path.read_bytes())


def _with_sizes(data: bytes, name: bytes, size: int) -> bytes:
    """The file with another unpacked size in the directory's entry of a member."""
    damaged = bytearray(data)
    entry = data.index(name, data.index(b"PK\1\2")) - 46
    damaged[entry + 24 : entry + 28] = struct.pack("<I", size)
    return bytes(damaged)


def test_a_member_that_declares_a_gibibyte(
    model_path: Path, refused_or_same: Callable[[bytes], bool]
) -> None:
    data = model_path.read_bytes()
    model_path.write_bytes(_with_sizes(data, b"surface_output.npy", 2**30))
    with pytest.raises(
        ModelFileError, match=r"its members unpack to 1,073,.* bytes: expected at most 536,870,912"
    ):
        load_model(model_path)
    assert refused_or_same(model_path.read_bytes())


def test_a_member_that_unpacks_to_more_than_it_declares(
    model_path: Path, rewrite: Callable[..., None], refused_or_same: Callable[[bytes], bool]
) -> None:
    with zipfile.ZipFile(model_path) as archive:
        honest = archive.getinfo("surface_output.npy").file_size

    def enlarge(metadata: dict[str, Any], arrays: dict[str, Any]) -> None:
        arrays["surface_output"] = np.zeros((15, 2**20), np.float32)  # 60 MiB that pack to 60 kB

    rewrite(model_path, enlarge)
    data = model_path.read_bytes()
    assert refused_or_same(data)
    assert refused_or_same(_with_sizes(data, b"surface_output.npy", honest))


def test_a_directory_of_a_million_members(model_path: Path, refused_or_same: Callable[[bytes], bool]) -> None:
    with zipfile.ZipFile(model_path, "w") as archive:
        for number in range(3000):
            archive.writestr(f"member {number}", b"")
    assert refused_or_same(model_path.read_bytes())
