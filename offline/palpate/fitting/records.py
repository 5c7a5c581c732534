"""What was measured: a record over time under a ramp and a hold, or the complex modulus over frequency."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from palpate.files import printable
from palpate.fitting.csv_table import read_columns

Array = NDArray[np.float64]

POISSONS_RATIO = 0.45
"""Assumed: no record that is read here tells it. It enters E of an indentation as 1 - nu², 6 % more than with 0.5."""

_STRAIN = frozenset({"time_s", "strain", "stress_pa"})
_FORCE = frozenset({"time_s", "displacement_m", "force_n"})
_MODULUS = frozenset({"frequency_hz", "storage_pa", "loss_pa"})

_FEWEST_ROWS = 20
_FEWEST_FREQUENCIES = 5
_HELD_WITHIN = 0.05  # a hold may deviate by this fraction
_NOTABLE_DRIVE_NOISE = 0.003

_DEEPEST = 0.5  # depth of an indentation over the tip's radius
_TOUCH = 1e-12  # the same of a first touch
_NEWTON_STEPS = 8


@dataclass(frozen=True)
class Specimen:
    """How force and displacement become stress and strain: a bar pulled or pressed along its length, or a spherical tip.

    length_m, area_m2  of the bar at rest
    tip_radius_m       of the sphere that is pressed into a thick, flat body
    """

    length_m: float | None = None
    area_m2: float | None = None
    tip_radius_m: float | None = None


@dataclass(frozen=True)
class Signal:
    """A column over time: what it is, its unit ("" for none), and its values (n,)."""

    name: str
    unit: str
    values: Array

    @property
    def label(self) -> str:
        return f"{self.name}, {self.unit}" if self.unit else self.name


@dataclass(frozen=True)
class TimeRecord:
    """A ramp and a hold. `response / drive` is a modulus, Pa, in a relaxation and a compliance, 1/Pa, in a creep test.

    time_s    (n,), strictly increasing
    drive     what was held: strain or stress, Pa. In an indentation `indentation_area`, m², stands for the strain, and the
              force, N, for the stress
    response  what was measured meanwhile: the other one
    ramp_s    duration of the ramp; hold_s: of the hold
    """

    name: str
    test: Literal["relaxation", "creep"]
    time_s: Array
    drive: Signal
    response: Signal
    ramp_s: float
    hold_s: float
    notes: tuple[str, ...] = ()

    @property
    def description(self) -> str:
        """What was done, in words."""
        return (
            f"{self.test}, {self.drive.name} held for {self.hold_s:.3g} s at {_held_value(self.time_s, self.drive.values):.3g} "
            f"{self.drive.unit}".rstrip()
            + f", ramp of {self.ramp_s:.3g} s"
        )

    @property
    def window_s(self) -> tuple[float, float]:
        """The time constants that the record can tell: from the ramp time to half the hold."""
        return self.ramp_s, 0.5 * self.hold_s


@dataclass(frozen=True)
class ModulusRecord:
    """The complex modulus: storage + i loss, (n,), Pa, at frequency_hz (n,), strictly increasing."""

    name: str
    frequency_hz: Array
    modulus_pa: NDArray[np.complex128]
    notes: tuple[str, ...] = ()

    @property
    def description(self) -> str:
        """What was done, in words."""
        low, high = self.frequency_hz[[0, -1]]
        return f"complex modulus, {len(self.frequency_hz)} frequencies from {low:.3g} to {high:.3g} Hz"

    @property
    def window_s(self) -> tuple[float, float]:
        """The time constants that the record can tell: 1 / (2 pi f) of its frequencies."""
        return 1 / (2 * math.pi * self.frequency_hz[-1]), 1 / (2 * math.pi * self.frequency_hz[0])


Record = TimeRecord | ModulusRecord


def read_record(path: Path, specimen: Specimen = Specimen()) -> Record:
    """Read a record; its columns tell which kind it is.

    Raises FileNotFoundError, or ValueError in one line that names the column or option and what was expected.
    """
    shown = printable(path.name)
    columns = read_columns(path, (_STRAIN, _FORCE, _MODULUS))
    given = {name: value for name, value in vars(specimen).items() if value is not None}
    if "displacement_m" not in columns and given:
        raise ValueError(f"{shown} holds no force and displacement: it needs no {_options(given)}")
    if "frequency_hz" in columns:
        return _modulus_record(shown, columns["frequency_hz"], columns["storage_pa"], columns["loss_pa"])
    if "strain" in columns:
        strain, stress = Signal("strain", "", columns["strain"]), Signal("stress", "Pa", columns["stress_pa"])
        return time_record(shown, columns["time_s"], strain, stress)
    return _force_record(shown, columns, given)


def _force_record(shown: str, columns: dict[str, Array], given: dict[str, float]) -> TimeRecord:
    time_s, depth, force = columns["time_s"], columns["displacement_m"], columns["force_n"]
    if set(given) == {"length_m", "area_m2"}:
        strain, stress = (
            Signal("strain", "", depth / given["length_m"]),
            Signal("stress", "Pa", force / given["area_m2"]),
        )
        return time_record(shown, time_s, strain, stress)
    if set(given) == {"tip_radius_m"}:
        return _indentation(shown, time_s, depth, force, given["tip_radius_m"])
    raise ValueError(
        f"{shown} holds force and displacement: expected either --length-m and --area-m2 of the specimen, or "
        f"--tip-radius-m of a sphere; got {_options(given) or 'none of them'}"
    )


def _options(names: dict[str, float]) -> str:
    return ", ".join("--" + name.replace("_", "-") for name in names)


def _indentation(shown: str, time_s: Array, depth: Array, force: Array, radius_m: float) -> TimeRecord:
    """A rigid sphere on a half-space. While the contact grows, F(t) is the relaxation of `indentation_area` (E. H. Lee and
    J. R. M. Radok, J. Appl. Mech. 27, 1960; for any tip, G. A. C. Graham, Int. J. Eng. Sci. 3, 1965)."""
    sign = 1.0 if np.median(force) >= 0 else -1.0  # both may be counted against the surface's normal
    depth = depth if np.median(depth) >= 0 else -depth
    deepest = float(depth.max())
    if float(np.max(np.maximum.accumulate(depth) - depth)) > _HELD_WITHIN * deepest:
        raise ValueError(
            f"{shown}: displacement_m falls: expected a contact that only grows and holds (the model has no unloading)"
        )
    if deepest > _DEEPEST * radius_m:
        raise ValueError(
            f"{shown}: displacement_m reaches {deepest:.3g}: expected at most half of --tip-radius-m, "
            f"{_DEEPEST * radius_m:.3g}: deeper, strains are too large for a linear tissue"
        )
    note = (
        f"{shown}: an indentation to {deepest:.3g} m, with Poisson's ratio {POISSONS_RATIO} assumed. It holds for a flat body at least "
        f"{10 * math.sqrt(radius_m * deepest):.2g} m thick (10 contact radii), without adhesion, "
        "with displacement 0 at the first contact"
    )
    return time_record(
        shown,
        time_s,
        Signal("contact", "m²", indentation_area(depth, radius_m)),
        Signal("force", "N", sign * force),
        (note,),
    )


def indentation_area(depth_m: Array, radius_m: float) -> Array:
    """(n,), m²: the force of a rigid sphere on an elastic half-space over its Young's modulus, at depths (n,) below R.

    With the radius a of the contact, depth = a artanh(a / R) and F (1 - nu²) / E = (a² + R²) artanh(a / R) - a R (I. N. Sneddon,
    Int. J. Eng. Sci. 3, 1965). It is 4/3 sqrt(R) depth^1.5 for small depths (Hertz), and 5 % less at half the radius.
    """
    relative = np.maximum(depth_m / radius_m, _TOUCH)
    # Newton's method for x = a / R; the function is convex, and begins between tanh and the root of Hertz.
    x = np.tanh(np.sqrt(relative))
    for _ in range(_NEWTON_STEPS):
        x -= (x * np.arctanh(x) - relative) / (np.arctanh(x) + x / (1 - x**2))
    area: Array = radius_m**2 * ((1 + x**2) * np.arctanh(x) - x) / (1 - POISSONS_RATIO**2)
    return np.where(depth_m > 0, area, 0.0)


def time_record(
    name: str, time_s: Array, strain: Signal, stress: Signal, notes: tuple[str, ...] = ()
) -> TimeRecord:
    """A record of strain and stress: a creep test if the stress settles clearly before the strain, else a relaxation.

    Raises ValueError in one line.
    """
    _check_axis(name, "time_s", time_s, _FEWEST_ROWS)
    for signal in (strain, stress):
        if not np.any(signal.values):
            raise ValueError(f"{name}: {signal.name} is zero throughout")
    is_relaxation = _settled(time_s, strain.values) <= 1.5 * _settled(time_s, stress.values)
    drive, response = (strain, stress) if is_relaxation else (stress, strain)
    ramp_s, end = _ramp(name, drive.name, time_s, drive.values)
    hold_s = float(time_s[-1]) - end
    if hold_s < 2 * ramp_s:
        raise ValueError(
            f"{name}: {drive.name} is held for {hold_s:.3g} s after a ramp of {ramp_s:.3g} s: expected a hold of at least "
            "twice the ramp"
        )
    if _held_value(time_s, drive.values) * _held_value(time_s, response.values) < 0:
        raise ValueError(
            f"{name}: {strain.name} and {stress.name} have opposite signs: expected the same sign for both"
        )
    after = drive.values[time_s >= end]
    noise = _white_noise(after) / abs(float(np.median(after)))
    if noise > _NOTABLE_DRIVE_NOISE:
        notes += (
            f"{name}: {drive.name} itself has a noise of {100 * noise:.1g} %, which biases the fastest branches; "
            "the commanded values are better",
        )
    test: Literal["relaxation", "creep"] = "relaxation" if is_relaxation else "creep"
    return TimeRecord(name, test, time_s, drive, response, ramp_s, hold_s, notes)


def _modulus_record(name: str, frequency_hz: Array, storage_pa: Array, loss_pa: Array) -> ModulusRecord:
    order = np.argsort(frequency_hz)
    frequency_hz = frequency_hz[order]
    _check_axis(name, "frequency_hz", frequency_hz, _FEWEST_FREQUENCIES)
    for column, values in (("frequency_hz", frequency_hz), ("storage_pa", storage_pa)):
        if values.min() <= 0:
            raise ValueError(f"{name}: {column} holds {values.min():g}: expected above 0")
    if np.median(loss_pa) < 0:  # a single negative one is noise
        raise ValueError(f"{name}: loss_pa is negative: expected positive values, those of a passive tissue")
    return ModulusRecord(name, frequency_hz, storage_pa[order] + 1j * loss_pa[order])


def _check_axis(name: str, column: str, values: Array, fewest: int) -> None:
    if len(values) < fewest:
        raise ValueError(f"{name}: {len(values)} rows: expected at least {fewest}")
    steps = np.diff(values)
    if steps.min() <= 0:
        row = int(np.argmin(steps > 0))
        raise ValueError(
            f"{name}: {column} goes from {values[row]:g} to {values[row + 1]:g}: expected rising values"
        )


def _held_value(time_s: Array, values: Array) -> float:
    """The median of the last quarter of the time."""
    return float(np.median(values[time_s >= 0.25 * time_s[0] + 0.75 * time_s[-1]]))


def _settled(time_s: Array, values: Array) -> float:
    """Time from the start until the values stay as near to their final one as in a hold, s."""
    final = _held_value(time_s, values)
    outside = np.flatnonzero(np.abs(values - final) > _HELD_WITHIN * abs(final))
    return float(time_s[outside[-1]] - time_s[0]) if len(outside) else 0.0


def _ramp(name: str, held: str, time_s: Array, drive: Array) -> tuple[float, float]:
    """Duration and end of the ramp, s, from where it crosses 2 and 98 % of the held value.

    Raises ValueError unless the record begins at zero, before the ramp, and holds after it.
    """
    fraction = drive / (_held_value(time_s, drive) or math.nan)
    if not abs(fraction[0]) <= 0.02:
        raise ValueError(
            f"{name}: {held} begins at {100 * fraction[0]:.3g} % of its held value: expected a record that begins at zero, "
            "before the ramp. Subtract a preload from both columns; a step without its ramp is not assumed"
        )
    full = int(np.argmax(fraction >= 0.98))
    low = full - 1 - int(np.argmax(fraction[full - 1 :: -1] <= 0.02))
    begin, end = np.interp((0.02, 0.98), fraction[low : full + 1], time_s[low : full + 1])
    ramp_s = float(end - begin) / 0.96
    after = fraction[time_s > end]
    if np.max(np.abs(after - 1)) > 2 * _HELD_WITHIN:
        raise ValueError(
            f"{name}: after its ramp {held} goes from {100 * after.min():.3g} to {100 * after.max():.3g} % of its final value: "
            "expected a ramp and a hold"
        )
    return ramp_s, float(begin) - 0.02 * ramp_s + ramp_s


def _white_noise(values: Array) -> float:
    """Standard deviation of what has no connection with its neighbors, from second differences."""
    return float(np.sqrt(np.mean(np.diff(values, 2) ** 2) / 6)) if len(values) > 2 else 0.0
