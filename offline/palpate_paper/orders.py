"""Figures 14 and 16: every method at every order, its errors and its passivity once sampled."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

from palpate.lti.frequencies import band_frequencies
from palpate.lti.sampling import sample
from palpate.reduction.accuracy import hinf_error, in_band_error
from palpate.reduction.passivity import passivity_margin
from palpate_paper.examples import PERIOD_S, Example
from palpate_paper.figure import Cell, Figure, tidy
from palpate_paper.methods import ALL, Method
from palpate_paper.study import Study, per_cent, static_error

ORDERS = {
    "disc": (20, 40, 60, 100, 150, 200, 300, 400),
    "square": (6, 10, 14, 20, 26, 34, 44, 56),
    "cube": (20, 40, 60, 100, 150, 200, 300, 400),
}
_GOOD_ENOUGH = 0.02
_ROUND_OFF = 1e-9
"""Of a passivity margin, over the static stiffness; the text of figure 16 names it."""


@dataclass(frozen=True)
class Point:
    """Errors of one reduced model, fractions, and its passivity margin once sampled by the trapezoidal rule.

    requested  order that was asked for
    order      that the method reached, at most that
    """

    example: str
    method: Method
    requested: int
    order: int
    error_hinf: float
    error_band: float
    error_static: float
    margin: float


@cache
def points(study: Study) -> list[Point]:
    """Every method at every order of every example; orders that a method does not have are left out."""
    found: dict[tuple[str, str, int], Point] = {}
    for example in (study.disc, study.square, study.cube):
        orders = ORDERS[example.name][::3] if study.quick else ORDERS[example.name]
        for method in ALL:
            for order in orders:
                reduced = study.reduced(example, method, order)
                if reduced is None or (example.name, method.name, reduced.order) in found:
                    continue
                full, small = example.system, reduced.system
                band = band_frequencies((full, small), example.band_hz)
                found[example.name, method.name, reduced.order] = Point(
                    example.name,
                    method,
                    order,
                    reduced.order,
                    hinf_error(full, small),
                    in_band_error(full, small, band),
                    static_error(full, small),
                    passivity_margin(sample(small, PERIOD_S, "bilinear", example.band_hz[1])),
                )
    return list(found.values())


def error_against_order(study: Study) -> Figure:
    """Figure 14: three errors of six methods for three problems."""
    measured = points(study)
    fields = (
        ("error_hinf", "largest error\nover largest response"),
        ("error_band", "largest relative error\nin the band"),
        ("error_static", "relative error at 0 Hz"),
    )
    examples = (study.disc, study.square, study.cube)

    def draw(canvas: Any) -> None:
        axes = canvas.subplots(3, 3, sharex="col", sharey="row")
        for column, example in enumerate(examples):
            for row, (field, label) in enumerate(fields):
                axis = axes[row, column]
                for method in ALL:
                    of_method = [p for p in measured if p.example == example.name and p.method is method]
                    values = [max(getattr(p, field), 1e-10) for p in of_method]
                    axis.semilogy([p.order for p in of_method], values, **method.style)
                axis.axhline(_GOOD_ENOUGH, color="0.5", linewidth=0.8, linestyle=":")
                axis.set_ylim(1e-10, 10 * max(1.0, *(getattr(p, field) for p in measured)))
                tidy(axis)
                if column == 0:
                    axis.set_ylabel(label)
            axes[0, column].set_title(
                f"{example.name}, {example.system.n_states:,} states, band to {example.band_hz[1]:.2g} Hz",
                fontsize="medium",
            )
            axes[2, column].set_xlabel("order (states)")
        handles, labels = axes[0, 0].get_legend_handles_labels()
        canvas.legend(handles, labels, loc="outside lower center", ncols=3, frameon=False)

    rows: list[list[Cell]] = [
        [p.example, p.method.name, p.requested, p.order, p.error_hinf, p.error_band, p.error_static]
        for p in measured
    ]
    return Figure(
        14,
        "Error against order, every method",
        ("example", "method", "states_requested", "states", "error_hinf", "error_band", "error_static"),
        rows,
        draw,
        _smallest_orders(measured, examples),
        (11.0, 9.0),
        f"Fewest states for {per_cent(_GOOD_ENOUGH)}, by the order asked for: "
        + "; ".join(f"{e.name} {fewest_states(measured, e)}" for e in examples)
        + ".",
    )


def passivity(study: Study) -> Figure:
    """Figure 16: how far each reduced model is from passive once it is sampled."""
    measured = points(study)
    examples = (study.disc, study.square, study.cube)
    full = {e.name: passivity_margin(sample(e.system, PERIOD_S, "bilinear", e.band_hz[1])) for e in examples}

    highest = 10.0 * max(1.0, *(-p.margin for p in measured))

    def draw(canvas: Any) -> None:
        axes = canvas.subplots(1, 3, sharey=True)
        for axis, example in zip(axes, examples, strict=True):
            for method in ALL:
                of_method = [p for p in measured if p.example == example.name and p.method is method]
                axis.semilogy(
                    [p.order for p in of_method],
                    [max(-p.margin, _ROUND_OFF) for p in of_method],
                    clip_on=False,
                    **method.style,
                )
            axis.set(title=f"{example.name}", xlabel="order (states)", ylim=(_ROUND_OFF, highest))
            tidy(axis)
        axes[0].set_ylabel("minus the passivity margin,\nover the static stiffness")
        axes[0].annotate("passive", (0.02, 0.02), xycoords="axes fraction", va="bottom", color="0.4")
        handles, labels = axes[0].get_legend_handles_labels()
        canvas.legend(handles, labels, loc="outside lower center", ncols=3, frameon=False)

    rows: list[list[Cell]] = [[name, "full", 0, margin] for name, margin in full.items()]
    rows += [[p.example, p.method.name, p.order, p.margin] for p in measured]
    lines = [
        "The margin is the smallest eigenvalue of (G - G^H)/2j over all frequencies, over the static stiffness, of the model "
        "sampled by the trapezoidal rule at 1 kHz; at 0 or above no closed poke gets energy out. What is "
        "above -1e-9 is round-off, counts as passive and lies on the axis at the bottom.",
        "",
    ]
    always = {m.name for m in ALL}
    for example in examples:
        passive = [
            m.name
            for m in ALL
            if (own := [p for p in measured if p.example == example.name and p.method is m])
            and min(p.margin for p in own) > -_ROUND_OFF
        ]
        always &= set(passive)
        worst = min((p for p in measured if p.example == example.name), key=lambda p: p.margin)
        lines.append(
            f"- {example.name}: full model {full[example.name]:.1e}; passive at every order: {', '.join(passive) or 'none'}; "
            f"worst {worst.method.name} at order {worst.order}: {worst.margin:.2g}."
        )
    return Figure(
        16,
        "Passivity margin of the sampled models",
        ("example", "method", "states", "passivity_margin"),
        rows,
        draw,
        "\n".join(lines),
        (11.0, 4.2),
        f"Passive once sampled, at every order and in all three problems: {', '.join(m.name for m in ALL if m.name in always) or 'none'}.",
    )


def _smallest_orders(measured: Sequence[Point], examples: Sequence[Example]) -> str:
    """A table: the smallest measured order from which on each error is below 2 %."""
    lines = [
        f"Smallest order (of those computed) from which the error stays below {per_cent(_GOOD_ENOUGH)}, "
        "as *over all frequencies / in the band / at 0 Hz*:",
        "",
        "| method | " + " | ".join(e.name for e in examples) + " |",
        "|---|" + "---|" * len(examples),
    ]
    for method in ALL:
        cells = []
        for example in examples:
            own = sorted(
                (p for p in measured if p.example == example.name and p.method is method),
                key=lambda p: p.order,
            )
            found = [_from(own, f) for f in ("error_hinf", "error_band", "error_static")]
            cells.append(" / ".join("—" if p is None else str(p.order) for p in found))
        lines.append(f"| {method.label} | " + " | ".join(cells) + " |")
    lines.append("")
    lines += [f"- Fewest states asked for, {e.name}: {fewest_states(measured, e)}." for e in examples]
    lines.append(
        "\nThis plot decides: where the motion is known to stay in a band, as a hand's does, band-limited truncation; where a bound "
        "over all frequencies is wanted, TBR or HOM, and singular perturbation balancing if the statics must be exact, too."
    )
    return "\n".join(lines)


def fewest_states(measured: Sequence[Point], example: Example) -> str:
    """Which methods reach 2 % with the fewest states asked for, all of them, for each of the errors."""
    parts = []
    for field, where in (
        ("error_hinf", "over all frequencies"),
        ("error_band", "in the band"),
        ("error_static", "at 0 Hz"),
    ):
        orders = {}
        for method in ALL:
            own = [p for p in measured if p.example == example.name and p.method is method]
            found = _from(sorted(own, key=lambda p: p.order), field)
            if found is not None:
                orders[method.name] = found.requested
        if orders:
            fewest = min(orders.values())
            best = [name for name, order in orders.items() if order == fewest]
            parts.append(f"{where} {' = '.join(best)} ({fewest})")
        else:
            parts.append(f"{where} none")
    return ", ".join(parts)


def _from(own: Sequence[Point], field: str) -> Point | None:
    """The first point, by ascending order, from which on the error stays below 2 %."""
    smallest = None
    for point in reversed(own):
        if getattr(point, field) > _GOOD_ENOUGH:
            break
        smallest = point
    return smallest
