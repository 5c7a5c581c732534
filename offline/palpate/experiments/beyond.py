"""Figures 14 to 16, beyond the paper: error against order, both discretisations, passivity once sampled."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np

from palpate.diagonal_system import DiagonalSystem
from palpate.experiments.examples import PERIOD_S, Example, cube, disc, square
from palpate.experiments.figure import Cell, Figure, tidy
from palpate.experiments.methods import ALL, BAND, HOM, MT, TBR, Method
from palpate.experiments.reductions import frequencies_hz
from palpate.experiments.study import Study, per_cent, static_error
from palpate.reduction.evidence import hinf_error, in_band_error
from palpate.reduction.frequencies import band_frequencies
from palpate.reduction.passivity import passivity_margin
from palpate.reduction.sampling import sample

ORDERS = {
    "disc": (20, 40, 60, 100, 150, 200, 300, 400),
    "square": (6, 10, 14, 20, 26, 34, 44, 56),
    "cube": (20, 40, 60, 100, 150, 200, 300, 400),
}
_GOOD_ENOUGH = 0.02


@dataclass(frozen=True)
class Point:
    """Errors of one reduced model, fractions, and its passivity margin once sampled by the trapezoidal rule."""

    example: str
    method: Method
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
                if reduced is None:
                    continue
                full, small = example.system, reduced.system
                band = band_frequencies((full, small), example.band_hz)
                found[example.name, method.name, reduced.order] = Point(
                    example.name,
                    method,
                    reduced.order,
                    hinf_error(full, small),
                    in_band_error(full, small, band),
                    static_error(full, small),
                    passivity_margin(sample(small, PERIOD_S, "bilinear", example.band_hz[1])),
                )
    return list(found.values())


def error_against_order(study: Study) -> Figure:
    """Figure 14, which decides what to use: three errors of six methods for three problems."""
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
                    axis.semilogy(
                        [p.order for p in of_method],
                        values,
                        color=method.colour,
                        marker=method.marker,
                        markersize=4,
                        linewidth=1,
                        label=method.label,
                    )
                axis.axhline(_GOOD_ENOUGH, color="0.5", linewidth=0.8, linestyle=":")
                axis.set_ylim(1e-10, 30)
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
        [p.example, p.method.name, p.order, p.error_hinf, p.error_band, p.error_static] for p in measured
    ]
    return Figure(
        14,
        "Error against order, every method",
        ("example", "method", "states", "error_hinf", "error_band", "error_static"),
        rows,
        draw,
        _smallest_orders(measured, examples),
        (11.0, 9.0),
    )


def passivity(study: Study) -> Figure:
    """Figure 16: how far each reduced model is from passive once it is sampled."""
    measured = points(study)
    examples = (study.disc, study.square, study.cube)
    full = {e.name: passivity_margin(sample(e.system, PERIOD_S, "bilinear", e.band_hz[1])) for e in examples}

    def draw(canvas: Any) -> None:
        axes = canvas.subplots(1, 3, sharey=True)
        for axis, example in zip(axes, examples, strict=True):
            for method in ALL:
                of_method = [p for p in measured if p.example == example.name and p.method is method]
                axis.semilogy(
                    [p.order for p in of_method],
                    [max(-p.margin, 1e-12) for p in of_method],
                    color=method.colour,
                    marker=method.marker,
                    markersize=4,
                    linewidth=1,
                    label=method.label,
                )
            axis.set(title=f"{example.name}", xlabel="order (states)", ylim=(1e-12, 1e2))
            tidy(axis)
        axes[0].set_ylabel("energy that can be got out:\nminus passivity margin")
        handles, labels = axes[0].get_legend_handles_labels()
        canvas.legend(handles, labels, loc="outside lower center", ncols=3, frameon=False)

    rows: list[list[Cell]] = [[name, "full", 0, margin] for name, margin in full.items()]
    rows += [[p.example, p.method.name, p.order, p.margin] for p in measured]
    lines = [
        "The margin is the smallest eigenvalue of (G - G^H)/2j over all frequencies, over the static stiffness, of the model "
        "sampled by the trapezoidal rule at 1 kHz; at 0 or above (1e-12 is round-off) no closed poke gets energy out.",
        "",
    ]
    for example in examples:
        passive = [
            m.name
            for m in ALL
            if (own := [p for p in measured if p.example == example.name and p.method is m])
            and min(p.margin for p in own) > -1e-9
        ]
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
    )


def both_discretisations(study: Study) -> Figure:
    """Figure 15: the paper's collocation beside the conservative discretisation, full and reduced, square and cube."""
    study.note("square and cube by collocation")
    pairs = [
        (study.square, square(9 if study.quick else 15, "collocation")),
        (study.cube, cube(6 if study.quick else 10, "collocation")),
    ]
    curves = [_curves(study, *pair) for pair in pairs]

    def draw(canvas: Any) -> None:
        axes = canvas.subplots(2, 2)
        for column, ((ours, theirs), (hz, responses, errors)) in enumerate(zip(pairs, curves, strict=True)):
            top, bottom = axes[:, column]
            for example, response, colour in zip(
                (ours, theirs), responses, ("tab:blue", "tab:red"), strict=True
            ):
                name = "conservative" if example is ours else "collocation"
                top.loglog(
                    hz,
                    response,
                    color=colour,
                    linewidth=1,
                    label=f"{name}, {example.system.n_states:,} states",
                )
            top.axvspan(hz[0], ours.band_hz[1], color="0.93")
            top.set(title=ours.name, xlabel="frequency, Hz", ylabel="|force / displacement|, N/m")
            top.legend(frameon=False, fontsize="small")
            for (name, method), series in errors.items():
                bottom.semilogy(
                    [o for o, _ in series],
                    [max(e, 1e-10) for _, e in series],
                    color=method.colour,
                    marker=method.marker,
                    markersize=4,
                    linewidth=1,
                    linestyle="-" if name == "conservative" else "--",
                    label=f"{method.name}, {name}",
                )
            bottom.set(xlabel="order (states)", ylabel="largest error over\nlargest response")
            bottom.legend(frameon=False, fontsize="small", ncols=2)
            tidy(top)
            tidy(bottom)

    rows: list[list[Cell]] = []
    lines = []
    for (ours, theirs), (_, _, errors) in zip(pairs, curves, strict=True):
        for (name, method), series in errors.items():
            rows += [[ours.name, name, method.name, order, error] for order, error in series]
        lines.append(_beside(ours, theirs))
    lines.append(f"- disc by collocation, with its drag: {_state(disc_by_collocation(study).system)}.")
    lines.append(
        "\nCollocation is not symmetric: its squared frequencies are complex, and only damping keeps its modes from growing. "
        "What is stable reduces as well as the conservative discretisation does (solid and dashed curves)."
    )
    return Figure(
        15,
        "The paper's collocation beside the conservative discretisation",
        ("example", "discretisation", "method", "states", "error_hinf"),
        rows,
        draw,
        "\n".join(lines),
        (11.0, 7.0),
    )


def disc_by_collocation(study: Study) -> Example:
    """The disc of figure 4 by collocation."""
    return disc(study.disc.n_nodes, "collocation")


Curves = tuple[Any, list[Any], dict[tuple[str, Method], list[tuple[int, float]]]]


def _curves(study: Study, ours: Example, theirs: Example) -> Curves:
    hz = frequencies_hz(ours)
    k = ours.channel
    responses = [np.abs(e.system.transfer(2j * np.pi * hz)[:, k, k]) for e in (ours, theirs)]
    errors: dict[tuple[str, Method], list[tuple[int, float]]] = {}
    for name, example in (("conservative", ours), ("collocation", theirs)):
        # A name of its own keeps its reductions apart from the conservative ones.
        named = example if example is ours else replace(example, name=f"{example.name}, collocation")
        if example.system.spectral_abscissa >= 0:
            continue
        for method in (HOM, MT, TBR):
            reduced = {
                r.order: r
                for order in ORDERS[ours.name][::3]
                if (r := study.reduced(named, method, order)) is not None
            }
            errors[name, method] = [(o, hinf_error(example.system, r.system)) for o, r in reduced.items()]
    return hz, responses, errors


def _beside(ours: Example, theirs: Example) -> str:
    return (
        f"- {ours.name}: {_state(ours.system)} ({ours.n_unknowns:,} unknowns) conservative; {_state(theirs.system)} "
        f"({theirs.n_unknowns:,} unknowns) collocation. Static stiffness {_gain(ours):.3g} and {_gain(theirs):.3g} N/m, "
        f"instant {ours.system.d[ours.channel, ours.channel]:.3g} and {theirs.system.d[theirs.channel, theirs.channel]:.3g} N/m: "
        "a tip of one or four nodes is nearly a point, so its stiffness is that of the node spacing."
    )


def _gain(example: Example) -> float:
    return float(example.system.static_gain()[example.channel, example.channel])


def _state(system: DiagonalSystem) -> str:
    growing = int(np.count_nonzero(system.poles.real >= 0))
    return (
        f"stable, spectral abscissa {system.spectral_abscissa:.2g} 1/s"
        if growing == 0
        else f"unstable, {growing} growing poles"
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
            cells.append(" / ".join(_from(own, f) for f in ("error_hinf", "error_band", "error_static")))
        lines.append(f"| {method.label} | " + " | ".join(cells) + " |")
    lines.append("")
    lines += [_fewest_states(measured, example) for example in examples]
    nearly_lossless = [p for p in measured if p.example == "disc" and p.method is BAND]
    if nearly_lossless and nearly_lossless[-1].error_band > _GOOD_ENOUGH:
        lines.append(
            "\nBand-limited truncation fails on the nearly lossless disc: the quadrature of its band Gramian takes 120 frequencies, "
            "which step over resonances that narrow. Tissue is damped, as the square and the cube are."
        )
    lines.append(
        "\nThis plot decides: where the motion is known to stay in a band, as a hand's does, band-limited truncation; where a bound "
        "over all frequencies is wanted, TBR or HOM, and singular perturbation balancing if the statics must be exact, too."
    )
    return "\n".join(lines)


def _fewest_states(measured: Sequence[Point], example: Example) -> str:
    """Which method reaches 2 % with the fewest states, for each of the errors."""
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
            if found != "—":
                orders[method.name] = int(found)
        if orders:
            best = min(orders, key=orders.__getitem__)
            parts.append(f"{where} {best} ({orders[best]})")
        else:
            parts.append(f"{where} none")
    return f"- Fewest states, {example.name}: {', '.join(parts)}."


def _from(own: Sequence[Point], field: str) -> str:
    smallest = "—"
    for point in reversed(own):
        if getattr(point, field) > _GOOD_ENOUGH:
            break
        smallest = str(point.order)
    return smallest
