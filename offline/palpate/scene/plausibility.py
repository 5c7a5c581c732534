"""Numbers of a scene that look as if they were given in another unit. They are warnings: unusual bodies exist."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

from palpate.scene.quantities import UNITS_M, Table
from palpate.scene.schema import Config, SurfaceGeometry

_SMALLEST_BODY_M, _LARGEST_BODY_M = 0.003, 1.0


@dataclass(frozen=True)
class _Usual:
    """What is usual for a kind of number.

    low, high    in `unit`
    what         whose range this is
    other_units  (name, length of it in `unit`), in which people give such numbers too
    """

    low: float
    high: float
    unit: str
    what: str
    other_units: tuple[tuple[str, float], ...] = ()


_USUAL = {
    "youngs_modulus_pa": _Usual(100, 1e9, "Pa", "tissue has", (("kPa", 1e3), ("MPa", 1e6))),
    "density_kg_per_m3": _Usual(200, 3000, "kg/m³", "tissue has", (("g/cm³", 1e3),)),
    "poissons_ratio": _Usual(0, 0.4999, "", "tissue has"),
    "gamma": _Usual(1e-3, 20, "", "a branch of tissue has", (("percent", 0.01),)),
    "tau_s": _Usual(1e-4, 100, "s", "what a touch can feel relaxes in", (("ms", 1e-3),)),
    "radius_m": _Usual(1e-4, 0.5, "m", "organs and tool tips have", (("mm", 1e-3), ("cm", 1e-2))),
    "spacing_m": _Usual(1e-4, 0.5, "m", "clouds of nodes have", (("mm", 1e-3), ("cm", 1e-2))),
    "band_hz": _Usual(0, 100, "Hz", "force feedback has", (("rad/s", 1 / (2 * math.pi)),)),
    "period_s": _Usual(2e-4, 5e-3, "s", "force feedback has", (("ms", 1e-3), ("µs", 1e-6))),
    "tolerance": _Usual(1e-6, 0.2, "", "a usable model has", (("percent", 0.01),)),
}


def plausibility(config: Config, size_m: float) -> tuple[str, ...]:
    """A sentence for each number that is unusual: its key, its value, what is usual, what was probably meant.

    size_m  largest extent of the body along an axis, m
    """
    return (*_size(config, size_m), *_numbers(config))


def _size(config: Config, size_m: float) -> Iterator[str]:
    if _SMALLEST_BODY_M <= size_m <= _LARGEST_BODY_M:
        return
    told = f"the body is {size_m:.3g} m across: usual are {_SMALLEST_BODY_M:g} to {_LARGEST_BODY_M:g} m"
    geometry = config.geometry
    if not isinstance(geometry, SurfaceGeometry):
        yield f"geometry: {told}; lengths are in m, 5 mm is 0.005"
        return
    likely = [
        f'"{unit}"'
        for unit, length in UNITS_M.items()
        if _SMALLEST_BODY_M <= size_m * length / UNITS_M[geometry.file_unit] <= _LARGEST_BODY_M
    ]
    advice = (
        f"; probably meant: file_unit = {' or '.join(likely)}" if likely else "; check the unit of the file"
    )
    yield f'geometry.file_unit = "{geometry.file_unit}": {told}{advice}'


def _numbers(config: Config) -> Iterator[str]:
    # The constants of a preset are not the user's, and not in the table.
    tables: dict[str, Table] = {
        "material": config.material,
        "geometry": config.geometry,
        **({"surface": config.surface} if config.tool else {"reduction": config.reduction}),
    }
    tables |= {f"tool '{tool.name}'": tool for tool in config.tool}
    tables |= {f"surface.working_area[{i}]": region for i, region in enumerate(config.surface.working_area)}
    tables |= {f"contact '{contact.name}'": contact for contact in config.contact}
    tables |= {f"fixed[{index}]": region for index, region in enumerate(config.fixed)}
    for where, table in tables.items():
        for key, usual in _USUAL.items():
            given = getattr(table, key, None)
            for value in given if isinstance(given, tuple) else (given,):
                if value is not None and not usual.low <= value <= usual.high:
                    yield _unusual(f"{where}.{key}", value, usual)


def _unusual(key: str, value: float, usual: _Usual) -> str:
    meant = [
        f"{value * length:.3g} if it was in {name}"
        for name, length in usual.other_units
        if usual.low <= value * length <= usual.high
    ]
    unit = f" {usual.unit}" if usual.unit else ""
    advice = f"; probably meant: {', '.join(meant)}" if meant else "; check its unit"
    return f"{key} = {value:g}{unit}: {usual.what} {usual.low:g} to {usual.high:g}{unit}{advice}"
