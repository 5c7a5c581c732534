"""Scene files: what a TOML scene may say, checked before anything is computed."""

from __future__ import annotations

import hashlib
import math
import re
import tomllib
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, ValidationError, ValidationInfo, field_validator, model_validator

from palpate.files import missing
from palpate.model_file import LONGEST_PERIOD_S, SHORTEST_PERIOD_S
from palpate.model_file.surface_model import LEAST_RADIUS_M, MOST_FRICTION, MOST_RADIUS_M
from palpate.scene.inclusions import Inclusion, SurfaceInclusion
from palpate.scene.material import Material, PronySeries, check_constant
from palpate.scene.quantities import (
    SHORTEST_M,
    Count,
    Length,
    LengthUnit,
    Number,
    Point,
    ReductionMethod,
    Table,
)
from palpate.scene.regions import AreaRegion, Region
from palpate.scene.tissues import PRESETS

_SHORTEST_TAU_IN_PERIODS = 0.01
"""A faster branch acts as a damper, and its terms are lost in round-off."""


class ConfigError(ValueError):
    """A configuration says something that can't be built; the message names the key, the value and what is allowed."""


class BoxGeometry(Table):
    """A box of lattice nodes, faces included."""

    shape: Literal["box"]
    lower_m: Point = (0.0, 0.0, 0.0)
    upper_m: Point
    counts: tuple[Count, Count, Count] = Field(description="nodes along x, y, z, each at least 3")
    jitter: Number = Field(default=0.0, ge=0, le=0.4, description="random shift as a fraction of the spacing")
    seed: Count = Field(default=0, ge=0)

    @model_validator(mode="after")
    def _is_a_box(self) -> BoxGeometry:
        if any(u < low + SHORTEST_M for low, u in zip(self.lower_m, self.upper_m, strict=True)):
            raise ValueError(
                f"upper_m = {list(self.upper_m)}: expected above lower_m = {list(self.lower_m)} by {SHORTEST_M:g} m or more"
            )
        if min(self.counts) < 3:
            raise ValueError(f"counts = {list(self.counts)}: expected at least 3 along each axis")
        return self


class BallGeometry(Table):
    """A ball about the origin."""

    shape: Literal["ball"]
    radius_m: Length
    spacing_m: Length = Field(description="between nodes")

    @model_validator(mode="after")
    def _is_of_a_size(self) -> BallGeometry:
        if self.spacing_m > self.radius_m / 2:
            raise ValueError(
                f"spacing_m = {self.spacing_m:g} in a ball of radius_m = {self.radius_m:g}: expected at most half the radius"
            )
        return self


class SurfaceGeometry(Table):
    """The inside of a closed triangle surface."""

    shape: Literal["surface"]
    file: str = Field(description="STL, OBJ, PLY, OFF, VTK or VTP, relative to the configuration")
    file_unit: LengthUnit = Field(default="m", description="unit of the file's coordinates")
    spacing_m: Length = Field(description="between nodes, where nothing refines them")
    growth: Number = Field(
        default=0.3,
        gt=0,
        le=0.5,
        description="growth of the spacing per meter away from a refined contact or working area",
    )


class ContactTable(Table):
    """A patch of the surface that a tool tip holds and moves as one rigid piece."""

    name: str = Field(pattern=r"^[A-Za-z][A-Za-z0-9_-]{0,31}$")
    point_m: Point = Field(description="the patch is centered at the surface point nearest to this")
    radius_m: Length
    spacing_m: Length | None = Field(default=None, description="node spacing on the patch; unset: unrefined")


class ToolTable(Table):
    """A rigid sphere that touches the body anywhere on its surface."""

    name: str = Field(pattern=r"^[A-Za-z][A-Za-z0-9_-]{0,31}$")
    radius_m: Number = Field(ge=LEAST_RADIUS_M, le=MOST_RADIUS_M)
    friction: Number = Field(ge=0, le=MOST_FRICTION, description="Coulomb's coefficient against the tissue")
    home_m: Point | None = Field(
        default=None, description="where its center starts, clear of the surface; unset: above a working area"
    )


class SurfaceTable(Table):
    """Where tools touch, and what the model of the surface must reach."""

    spacing_m: Length | None = Field(
        default=None, description="of the points that are touched in the working areas; unset: the cloud's"
    )
    working_area: tuple[Annotated[AreaRegion, Field(discriminator="region")], ...] = Field(
        default=(), description="parts of the surface with this spacing; unset: all of it"
    )
    tolerance: Number = Field(
        default=0.05,
        ge=1e-4,
        le=1,
        description="largest relative force error of the smallest tool in the band: it decides how many modes are kept",
    )
    modes: Count | None = Field(default=None, ge=1, description="number of modes; displaces tolerance")
    band_hz: tuple[Number, Number] = Field(default=(0.0, 30.0), description="the haptic band, Hz")
    period_s: Number = Field(
        default=1e-3, ge=SHORTEST_PERIOD_S, le=LONGEST_PERIOD_S, description="between two ticks, s"
    )

    @model_validator(mode="after")
    def _makes_sense(self) -> SurfaceTable:
        if self.working_area and self.spacing_m is None:
            raise ValueError("spacing_m = None: expected the spacing of the points in working_area")
        _check_band(self.band_hz, self.period_s)
        return self


class MaterialTable(Table):
    """A preset by name, with any of its constants replaced; or all constants."""

    preset: str | None = Field(default=None, description="a tissue by name; `palpate tissues` lists them")
    youngs_modulus_pa: Number | None = Field(default=None, description="at rest (fully relaxed), Pa")
    poissons_ratio: Number | None = None
    density_kg_per_m3: Number | None = None
    gamma: tuple[Number, ...] | None = Field(
        default=None,
        description="stiffness of each relaxing branch over the stiffness at rest. Where a publication divides by the "
        "instant stiffness, gamma_j = g_j / (1 - sum of all g)",
    )
    tau_s: tuple[Number, ...] | None = Field(default=None, description="time constant of each branch, s")

    @field_validator("youngs_modulus_pa", "poissons_ratio", "density_kg_per_m3", "gamma", "tau_s")
    @classmethod
    def _is_within_its_range(
        cls, value: float | tuple[float, ...] | None, info: ValidationInfo
    ) -> float | tuple[float, ...] | None:
        values = value if isinstance(value, tuple) else () if value is None else (value,)
        for number in values:
            check_constant(str(info.field_name), number)
        return value

    @model_validator(mode="after")
    def _can_be_made(self) -> MaterialTable:
        self.material()
        return self

    def material(self) -> Material:
        """The material itself. Raises ValueError naming what is missing or unknown."""
        if self.preset is not None and self.preset not in PRESETS:
            raise ValueError(f"preset = {self.preset!r}: expected one of {', '.join(sorted(PRESETS))}")
        base = None if self.preset is None else PRESETS[self.preset]
        names = ("youngs_modulus_pa", "poissons_ratio", "density_kg_per_m3")
        constants = {n: getattr(base, n) for n in names} if base is not None else {}
        constants |= self.model_dump(include=set(names), exclude_none=True)
        if missing := [n for n in names if n not in constants]:
            raise ValueError(f"{', '.join(missing)} missing: give all constants, or a preset")
        if (self.gamma is None) != (self.tau_s is None):
            raise ValueError("gamma and tau_s belong together: give both or neither")
        if self.gamma is not None and self.tau_s is not None:
            prony = PronySeries(self.gamma, self.tau_s)
        else:
            prony = base.prony if base is not None else PronySeries()
        return Material(**constants, prony=prony)


class DiscretizationTable(Table):
    """`conservative` (symmetric, passive; the default) or the paper's `collocation`."""

    method: Literal["conservative", "collocation"] = "conservative"
    support_radius: Number = Field(
        default=2.2, ge=1.2, le=4.0, description="support radius over node spacing"
    )


class ReductionTable(Table):
    """How the full model is reduced and sampled. One of order and tolerance; without the table, tolerance is 0.01."""

    method: ReductionMethod = "passive"
    order: Count | None = Field(default=None, ge=2, description="number of states")
    tolerance: Number | None = Field(
        default=None, ge=1e-12, lt=1, description="largest relative in-band force error"
    )
    tolerance_surface: Number = Field(
        default=0.03,
        ge=1e-6,
        lt=1,
        description="largest relative in-band error of the surface; with tolerance",
    )
    band_hz: tuple[Number, Number] = Field(default=(0.0, 30.0), description="the haptic band, Hz")
    period_s: Number = Field(
        default=1e-3, ge=SHORTEST_PERIOD_S, le=LONGEST_PERIOD_S, description="between two ticks, s"
    )
    sampling: Literal["bilinear", "first-order-hold"] = "bilinear"

    @model_validator(mode="after")
    def _one_stop(self) -> ReductionTable:
        if (self.order is None) == (self.tolerance is None):
            raise ValueError(
                f"order = {self.order} and tolerance = {self.tolerance}: expected exactly one of them"
            )
        _check_band(self.band_hz, self.period_s)
        return self


def _check_band(band_hz: tuple[float, float], period_s: float) -> None:
    low, high = band_hz
    if not 0 <= low < high < 0.5 / period_s:
        raise ValueError(
            f"band_hz = {list(band_hz)}: expected 0 <= low < high < {0.5 / period_s:g} Hz, half the sampling rate"
        )


class Config(Table):
    """A whole scene: with contacts for a patch model, or with tools for a surface model."""

    name: str = Field(pattern=r"^[A-Za-z][A-Za-z0-9_-]{0,63}$")
    geometry: Annotated[BoxGeometry | BallGeometry | SurfaceGeometry, Field(discriminator="shape")]
    material: MaterialTable
    fixed: tuple[Annotated[Region, Field(discriminator="region")], ...] = Field(min_length=1)
    inclusion: tuple[Annotated[Inclusion, Field(discriminator="shape")], ...] = ()
    contact: tuple[ContactTable, ...] = ()
    tool: tuple[ToolTable, ...] = ()
    surface: SurfaceTable = SurfaceTable()
    discretization: DiscretizationTable = DiscretizationTable()
    reduction: ReductionTable = ReductionTable(tolerance=0.01)

    @model_validator(mode="after")
    def _is_of_one_kind(self) -> Config:
        if bool(self.contact) == bool(self.tool):
            given = "both" if self.tool else "neither"
            raise ValueError(
                f"{given} of [[contact]] and [[tool]]: expected one kind, contacts for tips bound to patches, tools for "
                "touching anywhere"
            )
        kind, tables = ("contact", self.contact) if self.contact else ("tool", self.tool)
        names = [table.name for table in tables]
        if len(set(names)) < len(names):
            raise ValueError(f"{kind} names {names}: expected each name once")
        other = "surface" if self.contact else "reduction"
        if other in self.model_fields_set:
            raise ValueError(f"{other}: unknown in a scene with [[{kind}]] tables; remove it")
        return self

    @model_validator(mode="after")
    def _cloud_can_be_refined(self) -> Config:
        if isinstance(self.geometry, SurfaceGeometry):
            if self.surface.spacing_m is not None and self.surface.spacing_m > self.geometry.spacing_m:
                raise ValueError(
                    f"surface.spacing_m = {self.surface.spacing_m:g}: expected at most geometry.spacing_m, "
                    f"{self.geometry.spacing_m:g}"
                )
            return self
        refined = [f"contact {c.name!r}" for c in self.contact if c.spacing_m is not None]
        refined += ["surface"] if self.surface.spacing_m is not None else []
        refined += [f"inclusion[{i}]" for i, part in enumerate(self.inclusion) if part.spacing_m is not None]
        if refined:
            raise ValueError(
                f"{refined[0]} has spacing_m, but a {self.geometry.shape} is a uniform cloud: only a surface's cloud can be refined"
            )
        return self

    @model_validator(mode="after")
    def _method_suits(self) -> Config:
        needs = "[[tool]] needs" if self.tool else "reduction.method 'passive' needs"
        if self.tool or self.reduction.method == "passive":
            for key, value, needed in (
                ("discretization.method", self.discretization.method, "conservative"),
                ("reduction.sampling", self.reduction.sampling, "bilinear"),
            ):
                if value != needed:
                    other = "" if self.tool else "; or choose another, such as 'tbr-band'"
                    raise ValueError(f"{key} = {value!r}: {needs} {needed!r}{other}")
        return self

    @model_validator(mode="after")
    def _inclusions_suit(self) -> Config:
        if self.inclusion and self.discretization.method != "conservative":
            raise ValueError(
                f"discretization.method = {self.discretization.method!r}: [[inclusion]] needs 'conservative'"
            )
        for index, part in enumerate(self.inclusion):
            coarsest = getattr(self.geometry, "spacing_m", math.inf)
            if part.spacing_m is not None and part.spacing_m > coarsest:
                raise ValueError(
                    f"inclusion[{index}].spacing_m = {part.spacing_m:g}: expected at most geometry.spacing_m, {coarsest:g}"
                )
        return self

    @model_validator(mode="after")
    def _can_be_sampled(self) -> Config:
        table = "surface" if self.tool else "reduction"
        shortest = _SHORTEST_TAU_IN_PERIODS * getattr(self, table).period_s
        too_short = [tau for tau in self.material.material().prony.tau_s if tau < shortest]
        if too_short:
            raise ValueError(
                f"material.tau_s holds {too_short[0]:g}: expected at least {shortest:g} s, "
                f"{_SHORTEST_TAU_IN_PERIODS:g} of {table}.period_s"
            )
        return self


def load_config(path: Path) -> Config:
    """Read a scene.

    Raises FileNotFoundError, or ConfigError with one line per mistake.
    """
    if not path.is_file():
        raise missing(path, "configuration")
    try:
        tables = tomllib.loads(path.read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        hint = "; a model is run with `palpate serve`" if path.suffix == ".npz" else ""
        raise ConfigError(f"{path}: not valid TOML: {error}{hint}") from error
    return check_config(tables, str(path))


def check_config(tables: dict[str, Any], origin: str) -> Config:
    """The configuration that parsed TOML tables describe. Raises ConfigError; `origin` opens its message."""
    try:
        return Config.model_validate(tables)
    except ValidationError as error:
        mistakes = error.errors()
        # pydantic also calls a list with a wrong entry too short.
        entries = {e["loc"][0] for e in mistakes if len(e["loc"]) > 1}
        told = [e for e in mistakes if not (e["type"] == "too_short" and e["loc"][0] in entries)]
        raise ConfigError("\n".join(f"{origin}: {_line(e)}" for e in told)) from error


def override_reduction(
    config: Config, method: str | None, order: int | None, tolerance: float | None
) -> Config:
    """The configuration with parts of its reduction replaced by the command line's; order and tolerance displace each other.

    Raises ConfigError.
    """
    if method is None and order is None and tolerance is None:
        return config
    if config.tool:
        raise ConfigError(
            "command line: method, order and tolerance are of the reduction, and a scene with [[tool]] tables has none: "
            "expected surface.tolerance or surface.modes in the scene"
        )
    tables = config.model_dump(mode="json", exclude_none=True, exclude=_of_the_other_kind(config))
    reduction = tables["reduction"]
    if method is not None:
        reduction["method"] = method
    if order is not None or tolerance is not None:
        reduction.pop("order", None)
        reduction.pop("tolerance", None)
        reduction |= {k: v for k, v in (("order", order), ("tolerance", tolerance)) if v is not None}
    return check_config(tables, "command line")


def canonical_text(config: Config) -> str:
    """The configuration as JSON with all defaults filled in: what a model file records."""
    return config.model_dump_json(exclude_none=True, exclude=_of_the_other_kind(config))


def _of_the_other_kind(config: Config) -> set[str]:
    """The tables that have no meaning in a scene of this kind, and inclusions where there are none."""
    return ({"contact", "reduction"} if config.tool else {"tool", "surface"}) | (
        set() if config.inclusion else {"inclusion"}
    )


def fingerprint(config: Config, folder: Path) -> str:
    """SHA-256 of `canonical_text` followed by the bytes of the scene's surface files, hexadecimal.

    Raises FileNotFoundError when one of them, relative to `folder`, is not there.
    """
    digest = hashlib.sha256(canonical_text(config).encode())
    for key, file in surface_files(config):
        surface = folder / file
        if not surface.is_file():
            raise FileNotFoundError(f"{key} = {file!r}: no such file as {surface}")
        digest.update(surface.read_bytes())
    return digest.hexdigest()


def surface_files(config: Config) -> list[tuple[str, str]]:
    """The key and the name of each surface file that the scene names."""
    files = [("geometry.file", config.geometry.file)] if isinstance(config.geometry, SurfaceGeometry) else []
    return files + [
        (f"inclusion[{i}].file", part.file)
        for i, part in enumerate(config.inclusion)
        if isinstance(part, SurfaceInclusion)
    ]


_TAGS = {
    "geometry": ("box", "ball", "surface"),
    "inclusion": ("sphere", "surface"),
    "fixed": ("box", "plane", "sphere", "nearest"),
    "surface": ("box", "plane", "sphere"),
}
"""What the tables of a scene may be of: their shapes or regions."""
_BOUNDS = {
    "greater_than": "above",
    "greater_than_equal": "at least",
    "less_than": "below",
    "less_than_equal": "at most",
}
_UNIT_HINTS = {"period_s": " (in s: 1 ms is 0.001)", "tolerance": " (a fraction: 2 % is 0.02)"}


def _line(error: Any) -> str:
    """One of pydantic's errors as a line: the key, the value and what was expected."""
    tags = {tag for table in _TAGS.values() for tag in table}
    parts = [part for i, part in enumerate(error["loc"]) if i == 0 or part not in tags]
    key = ""
    for part in parts:
        key += f"[{part}]" if isinstance(part, int) else f".{part}" if key else str(part)
    key, last = key or "scene", str(parts[-1]) if parts else ""
    value, message = error["input"], error["msg"].removeprefix("Value error, ")
    match error["type"]:
        case "tuple_type" if parts in (
            ["fixed"],
            ["contact"],
            ["tool"],
            ["inclusion"],
            ["surface", "working_area"],
        ):
            return f"{key}: expected a list of tables, [[{key}]]"
        case "missing":
            return f"{key}: missing, it is required"
        case "extra_forbidden":
            return f"{key}: unknown key; remove it or check its spelling"
        case "union_tag_invalid" | "union_tag_not_found":
            tag = error["ctx"]["discriminator"].strip("'")
            got = f" = {error['ctx']['tag']!r}:" if "tag" in error["ctx"] else ": missing,"
            return f"{key}.{tag}{got} expected one of {error['ctx'].get('expected_tags', ', '.join(map(repr, _TAGS[parts[0]])))}"
        case "value_error":
            if last and message.startswith(f"{last} = "):  # a field's own words
                return key.removesuffix(last) + message
            named = re.match(r"\w+ = ", message) and parts  # a table's words about one of its fields
            return f"{key}.{message}" if named else f"{key}: {message}" if parts else message
        case bound if bound in _BOUNDS:
            hint = _UNIT_HINTS.get(last, " (in m: 5 mm is 0.005)" if last.endswith("_m") else "")
            (limit,) = error["ctx"].values()
            return f"{key} = {value!r}: expected {_BOUNDS[bound]} {limit:g}{hint}"
    expected = message.removeprefix("Input should be ")
    if expected == message:
        return f"{key} = {value!r}: {message[0].lower() + message[1:]}"
    return f"{key} = {value!r}: expected {expected}"
