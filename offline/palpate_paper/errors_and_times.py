"""Figures 5, 8, 12 and 13: relative error, solution time and their product for the paper's three reductions."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from palpate_paper.examples import Example
from palpate_paper.figure import Cell, Figure, tidy
from palpate_paper.full_solution import FullSolution
from palpate_paper.methods import OF_THE_PAPER
from palpate_paper.study import TIME_SCATTER, Comparison, Study, per_cent, ranking, seconds


def error_and_time(study: Study, example: Example, number: int) -> Figure:
    """Bars of relative error, solution time and reduction time at the paper's order and at a tenth of it."""
    full = study.solution(example)
    compared = study.at_order_of_the_paper(example) + study.at_a_tenth(example)
    rows: list[list[Cell]] = [
        [
            c.method.name,
            c.reduced.order,
            c.error_time,
            c.stepping_s,
            c.reduced.seconds,
            c.product,
            c.error_hinf,
            c.error_static,
        ]
        for c in compared
    ]
    rows += [
        ["full, sparse Newmark", 2 * example.n_unknowns, 0.0, full.newmark_s, 0.0, 0.0, 0.0, 0.0],
        ["full, modal blocks", example.system.n_states, 0.0, full.blocks_s, 0.0, 0.0, 0.0, 0.0],
    ]

    def draw(canvas: Any) -> None:
        left, middle, right = canvas.subplots(1, 3)
        labels = [f"{c.method.name} {c.reduced.order}" for c in compared]
        colors = [c.method.color for c in compared]
        _bars(left, labels, [100 * c.error_time for c in compared], colors, lambda v: per_cent(v / 100))
        left.set(xlabel="relative error of the force, %", title="error")
        with_full = [*labels, "full, blocks", "full, Newmark"]
        times = [*(c.stepping_s for c in compared), full.blocks_s, full.newmark_s]
        _bars(middle, with_full, times, [*colors, "0.6", "0.35"], seconds)
        middle.set(
            xlabel="seconds",
            title=f"solution time, {example.times_s[-1]:g} s in {len(example.inputs) - 1:,} steps",
        )
        _bars(right, labels, [c.reduced.seconds for c in compared], colors, seconds)
        right.set(xlabel="seconds", title="time of the reduction itself")

    return Figure(
        number,
        f"{example.name.capitalize()}: relative error and solution time",
        (
            "method",
            "states",
            "relative_error_of_force",
            "stepping_s",
            "reduction_s",
            "error_percent_times_stepping_s",
            "error_hinf",
            "error_static",
        ),
        rows,
        draw,
        _rankings(example, compared, full),
        (12.0, 3.6),
        _headline(example, compared, full),
    )


def products(study: Study) -> Figure:
    """Figure 13: per cent of error times seconds, for the three problems."""
    examples = (study.disc, study.square, study.cube)
    compared = [(e, study.at_order_of_the_paper(e)) for e in examples]
    rows: list[list[Cell]] = []
    for example, comparisons in compared:
        for c in comparisons:
            whole = 100 * c.error_time * (c.stepping_s + c.reduced.seconds)
            rows.append([example.name, example.n_unknowns, c.method.name, c.reduced.order, c.product, whole])

    def draw(canvas: Any) -> None:
        axes = canvas.subplots(1, 2, sharey=True)
        for axis, column, title in zip(
            axes, (4, 5), ("time of stepping", "time of stepping and of the reduction"), strict=True
        ):
            for i, method in enumerate(OF_THE_PAPER):
                of_method = [r for r in rows if r[2] == method.name]
                x = np.arange(len(of_method)) + 0.27 * (i - 1)
                axis.bar(
                    x,
                    [max(float(r[column]), 1e-16) for r in of_method],
                    0.25,
                    color=method.color,
                    label=method.label,
                )
            axis.set_yscale("log")
            axis.set_xticks(range(len(examples)), [f"{e.name}\n{e.n_unknowns:,} unknowns" for e in examples])
            axis.set_title(title, fontsize="medium")
            tidy(axis)
        axes[0].set_ylabel("relative error, % × time, s")
        handles, labels = axes[0].get_legend_handles_labels()
        canvas.legend(handles, labels, loc="outside lower center", ncols=3, frameon=False)

    lines = []
    for example, comparisons in compared:
        stepping = ranking(
            {c.method.name: c.product for c in comparisons}, lambda v: f"{v:.1e}", TIME_SCATTER
        )
        lowest = min(comparisons, key=lambda c: c.product).method.name
        highest = max(comparisons, key=lambda c: c.product).method.name
        in_all = {c.method.name: 100 * c.error_time * (c.stepping_s + c.reduced.seconds) for c in comparisons}
        with_reduction = ranking(in_all, lambda v: f"{v:.1e}", TIME_SCATTER)
        lines.append(
            f"- {example.name}: {stepping} %·s; lowest {lowest}, highest {highest} (the paper: lowest TBR, highest HOM). "
            f"With the time of the reduction: {with_reduction} %·s."
        )
    return Figure(
        13,
        "Relative error times solution time",
        ("example", "unknowns", "method", "states", "percent_times_stepping_s", "percent_times_all_s"),
        rows,
        draw,
        "\n".join(lines)
        + "\n\nA state costs the same whatever the method, so that the product of error and solution time ranks the methods by "
        "their error and their order. Products within the scatter of the times, a factor of "
        f"{TIME_SCATTER:g}, count as equal (≈). The right panel counts the reduction, too, once for a single simulation, which weighs on HOM.",
        (9.5, 4.0),
    )


def _headline(example: Example, compared: Sequence[Comparison], full: FullSolution) -> str:
    best = min(compared[: len(OF_THE_PAPER)], key=lambda c: c.error_time)
    return (
        f"{example.name.capitalize()}: lowest error {best.method.name}, {per_cent(best.error_time)} with {best.reduced.order} of "
        f"{example.system.n_states:,} states, {seconds(best.stepping_s)} where Newmark in full takes {seconds(full.newmark_s)}."
    )


def _rankings(example: Example, compared: Sequence[Comparison], full: FullSolution) -> str:
    at_paper = compared[: len(OF_THE_PAPER)]
    errors = {c.method.name: c.error_time for c in at_paper}
    times = {c.method.name: c.stepping_s for c in at_paper}
    making = {c.method.name: c.reduced.seconds for c in at_paper}
    best = min(errors, key=errors.__getitem__)
    agrees = "as in the paper" if best == "TBR" else "unlike the paper, where it is TBR"
    cheapest = (
        "This is where modal truncation is the cheapest, as the paper says."
        if min(making, key=making.__getitem__) == "MT"
        else "Unlike in the paper modal truncation is not the cheapest."
    )
    tenth = {f"{c.method.name} {c.reduced.order}": c.error_time for c in compared[len(OF_THE_PAPER) :]}
    return "\n".join(
        [
            f"- Lowest error: {best}, {agrees}. {ranking(errors, per_cent)}.",
            f"- Solution time: {ranking(times, seconds, TIME_SCATTER)}, times within a factor of {TIME_SCATTER:g} counted as equal. "
            + _at_equal_order(at_paper, len(example.inputs) - 1),
            f"- Time of the reduction: {ranking(making, seconds, TIME_SCATTER)}. {cheapest}",
            f"- The full model takes {seconds(full.newmark_s)} by sparse Newmark and {seconds(full.blocks_s)} in modal blocks, "
            f"where nothing is reduced at all: {full.newmark_s / full.blocks_s:.0f} times faster by that alone.",
            f"- Errors at a tenth of the order: {ranking(tenth, per_cent)}.",
        ]
    )


def _at_equal_order(compared: Sequence[Comparison], n_steps: int) -> str:
    """Whether modal truncation takes the least time per state and step, a time that does not depend on the order."""
    each = {c.method.name: c.stepping_s / (c.reduced.order * n_steps) for c in compared}
    orders = {c.method.name: c.reduced.order for c in compared}
    low, high = min(each.values()), max(each.values())
    cost = f"A step costs {1e9 * low:.1f} to {1e9 * high:.1f} ns a state"
    if high > TIME_SCATTER * low:
        return f"{cost}, which is more than the scatter: least by {min(each, key=each.__getitem__)}."
    text = (
        f"{cost}, the same for all methods within the scatter: at equal order none steps faster, unlike in the paper, where "
        "modal truncation does; what differs is making the reduction."
    )
    if max(orders.values()) > TIME_SCATTER * min(orders.values()):
        fewest = min(orders.values())
        stopped = [m for m, order in orders.items() if order <= TIME_SCATTER * fewest]
        text += f" {' and '.join(stopped)} stop at a lower order here, because the rest is round-off, and take less time for it."
    return text


def _bars(
    axis: Any, labels: Sequence[str], values: Sequence[float], colors: Sequence[str], text: Any
) -> None:
    shown = [max(v, 1e-13) for v in values]
    places = np.arange(len(labels))
    axis.barh(places, shown, color=colors)
    axis.set_yticks(places, labels, fontsize="small")
    axis.invert_yaxis()
    axis.set_xscale("log")
    axis.set_xlim(min(shown) / 3, max(shown) * 30)
    for place, value in zip(places, values, strict=True):
        axis.annotate(
            text(value),
            (max(value, 1e-13), place),
            xytext=(3, 0),
            textcoords="offset points",
            va="center",
            fontsize="x-small",
        )
    tidy(axis)
