"""Figure 15: the paper's collocation beside the conservative discretization, full and reduced."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from palpate.lti.pole_residue import PoleResidueSystem
from palpate.reduction.accuracy import hinf_error
from palpate_paper.examples import Example, cube, disc, square
from palpate_paper.figure import Cell, Figure, tidy
from palpate_paper.frequency_responses import frequencies_hz
from palpate_paper.methods import HOM, MT, TBR, Method
from palpate_paper.orders import ORDERS
from palpate_paper.study import Study


def both_discretizations(study: Study) -> Figure:
    """Figure 15: the paper's collocation beside the conservative discretization, full and reduced, square and cube."""
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
            for example, response, color in zip(
                (ours, theirs), responses, ("tab:blue", "tab:red"), strict=True
            ):
                name = "conservative" if example is ours else "collocation"
                top.loglog(
                    hz,
                    response,
                    color=color,
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
                    color=method.color,
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
        "What is stable reduces as well as the conservative discretization does (solid and dashed curves)."
    )
    return Figure(
        15,
        "The paper's collocation beside the conservative discretization",
        ("example", "discretization", "method", "states", "error_hinf"),
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


def _state(system: PoleResidueSystem) -> str:
    growing = int(np.count_nonzero(system.poles.real >= 0))
    return (
        f"stable, spectral abscissa {system.spectral_abscissa:.2g} 1/s"
        if growing == 0
        else f"unstable, {growing} growing poles"
    )
