"""A record as equations: its values are linear in the amplitudes, for given time constants.

Relaxation:       stress(t) = E strain(t) + sum_j E_j (strain - strain low-passed by tau_j)
Creep:            strain(t) = J_0 stress(t) + sum_k J_k (stress low-passed by lambda_k)
Complex modulus:  E*(w) = E + sum_j E_j i w tau_j / (1 + i w tau_j)

The first two hold for any history of strain or stress, here the measured one, linear between its samples.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from palpate.fitting.records import Record, TimeRecord

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Equations:
    """weight * record = columns(times) @ amplitudes, the amplitude without a time constant first.

    columns     from (n_times,), s, to (n_rows, 1 + n_times)
    values      (n_rows,), weighted so that an error of 1 is one of the record's size
    extent_s    time constants that may be looked for, from shortest to longest
    """

    columns: Callable[[Array], Array]
    values: Array
    extent_s: tuple[float, float]


def equations_of(record: Record) -> Equations:
    """Equations of one record. Over time every value has the same weight, over frequency the same relative one."""
    if isinstance(record, TimeRecord):
        drive, response = record.drive.values, record.response.values
        weight = 1 / float(np.max(np.abs(response)))
        is_relaxation = record.test == "relaxation"

        def columns(times: Array) -> Array:
            slow = low_passed(record.time_s, drive, times)
            parts = drive[:, None] - slow if is_relaxation else slow
            return np.asarray(weight * np.column_stack([drive, parts]))

        shortest = max(record.ramp_s / 30, 0.5 * float(np.min(np.diff(record.time_s))))
        return Equations(columns, weight * response, (shortest, 30 * record.hold_s))

    weights = 1 / np.abs(record.modulus_pa)
    omega = 2 * np.pi * record.frequency_hz

    def factors(times: Array) -> Array:
        z = 1j * omega[:, None] * times
        complex_columns = weights[:, None] * np.column_stack([np.ones_like(omega), z / (1 + z)])
        return np.vstack([complex_columns.real, complex_columns.imag])

    values = weights * record.modulus_pa
    low, high = record.window_s
    return Equations(factors, np.concatenate([values.real, values.imag]), (low / 30, 30 * high))


def stacked(parts: Sequence[Equations], error: Sequence[float]) -> Equations:
    """The equations of several records of one tissue, each weighted by its error (rms, from a fit of its own)."""
    weights = min(error) / np.asarray(error)

    def columns(times: Array) -> Array:
        return np.vstack([w * p.columns(times) for w, p in zip(weights, parts, strict=True)])

    values = np.concatenate([w * p.values for w, p in zip(weights, parts, strict=True)])
    return Equations(columns, values, (min(p.extent_s[0] for p in parts), max(p.extent_s[1] for p in parts)))


@njit(cache=True)
def low_passed(time_s: Array, drive: Array, times: Array) -> Array:
    """(n, n_times): the solutions of tau x' = drive - x from rest, exact for a drive (n,) linear between its samples."""
    n, m = len(time_s), len(times)
    x = np.zeros((n, m))
    step = -1.0
    decay, hold, slope = np.zeros(m), np.zeros(m), np.zeros(m)
    for k in range(n - 1):
        if time_s[k + 1] - time_s[k] != step:
            step = time_s[k + 1] - time_s[k]
            for j in range(m):
                ratio = step / times[j]
                hold[j] = -np.expm1(-ratio)
                decay[j] = 1.0 - hold[j]
                slope[j] = 1.0 - hold[j] / ratio
        rise = drive[k + 1] - drive[k]
        for j in range(m):
            x[k + 1, j] = decay[j] * x[k, j] + hold[j] * drive[k] + slope[j] * rise
    return x
