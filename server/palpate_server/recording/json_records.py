"""Records as JSON objects, for recordings, and back."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

FULL = "the folder of recordings has reached its size limit"  # why a recording is refused or ends


def as_objects(records: NDArray[np.void]) -> list[dict[str, Any]]:
    """Records (n,) as n JSON objects; vectors (3,) as x, y, z, other arrays as one list."""
    columns: dict[str, list[Any]] = {}
    for name in records.dtype.names or ():
        values = records[name]
        if values.shape[1:] == (3,):
            columns[name] = [dict(zip("xyz", vector, strict=True)) for vector in values.tolist()]
        else:
            columns[name] = values.reshape(len(values), -1).tolist() if values.ndim > 1 else values.tolist()
    return [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]


def from_objects(objects: list[dict[str, Any]], record: np.dtype[np.void]) -> NDArray[np.void]:
    """The records (n,) that `as_objects` wrote. Raises KeyError, TypeError or ValueError for anything else."""
    records = np.zeros(len(objects), record)
    for name in record.names or ():
        values = [each[name] for each in objects]
        if record[name].shape == (3,):
            values = [[value[axis] for axis in "xyz"] for value in values]
        column = np.array(values, dtype=record[name].base)
        records[name] = column.reshape(records[name].shape)
    return records
