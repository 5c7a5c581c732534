"""Figures 4, 5, 7, 8, 10, 12 and 13: frequency responses, errors and times of the paper's three reductions."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from palpate.experiments.examples import Example
from palpate.experiments.figure import Cell, Figure, tidy
from palpate.experiments.full_solution import FullSolution
from palpate.experiments.methods import OF_THE_PAPER, TBR
from palpate.experiments.study import Comparison, Study, per_cent, ranking, seconds

_FREQUENCIES = 400


def frequency_response(study: Study, example: Example, number: int) -> Figure:
    """Full against reduced at the paper's order, and TBR at a tenth of it; the tip's driven channel."""
    full = example.system
    hz = frequencies_hz(example)
    s = 2j * np.pi * hz
    k = example.channel
    exact = full.transfer(s)[:, k, k]
    chosen = [study.reduced(example, m, example.order) for m in OF_THE_PAPER]
    small = study.reduced(example, TBR, example.small_order)
    models = [r for r in (*chosen, small) if r is not None]
    responses = [m.system.transfer(s)[:, k, k] for m in models]
    columns = ["frequency_hz", "full"]
    for m in models:
        columns += [f"{m.method.name}_{m.order}", f"{m.method.name}_{m.order}_relative_error"]
    values = [hz, np.abs(exact)]
    for response in responses:
        values += [np.abs(response), np.abs(response - exact) / np.abs(exact)]

    floor = max(1e-16, min(float(np.median(v)) for v in values[3::2]) / 100)

    def draw(canvas: Any) -> None:
        axes = canvas.subplots(2, len(models), sharex=True, sharey="row", height_ratios=(1.5, 1))
        for i, (model, response) in enumerate(zip(models, responses, strict=True)):
            top, bottom = axes[:, i]
            top.loglog(hz, np.abs(exact), color="0.6", linewidth=2.2, label=f"full, {full.n_states:,}")
            colour = model.method.colour
            top.loglog(hz, np.abs(response), color=colour, linewidth=0.9, label=f"reduced, {model.order}")
            top.set_title(f"({'abcd'[i]}) {model.method.name}, {model.order} states", fontsize="medium")
            top.legend(frameon=False, fontsize="small", loc="best")
            error = np.abs(response - exact) / np.abs(exact)
            bottom.loglog(hz, np.maximum(error, 1e-16), color=colour, linewidth=0.9)
            bottom.set(xlabel="frequency, Hz", ylim=(floor, 30))
            tidy(top)
            tidy(bottom)
        axes[0, 0].set_ylabel("|force / displacement|, N/m")
        axes[1, 0].set_ylabel("relative error")

    compared = study.at_order_of_the_paper(example) + [
        c for c in study.at_a_tenth(example) if c.method is TBR
    ]
    return Figure(
        number,
        f"{example.name.capitalize()}: frequency response of the full and the reduced models",
        tuple(columns),
        np.column_stack(values).tolist(),
        draw,
        _table(compared) + "\n\n" + _what_the_responses_say(example, compared),
        (3.2 * len(models), 4.8),
    )


def frequencies_hz(example: Example) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    """Even ones in the logarithm from a tenth of the first resonance to three times the last, and the resonances that
    the tip sees most."""
    system = example.system
    pair = np.flatnonzero(system.is_pair)
    resonance = system.poles.imag[pair] / (2 * np.pi)
    weight = np.linalg.norm(system.b[pair], axis=1) * np.linalg.norm(system.c[:, pair], axis=0)
    weight /= -system.poles.real[pair]
    seen = pair[np.argsort(weight)[::-1][:200]]
    grid = np.geomspace(resonance.min() / 10, 3 * resonance.max(), _FREQUENCIES)
    return np.unique(np.concatenate([grid, system.poles.imag[seen] / (2 * np.pi)]))


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
        colours = [c.method.colour for c in compared]
        _bars(left, labels, [100 * c.error_time for c in compared], colours, lambda v: per_cent(v / 100))
        left.set(xlabel="relative error of the force, %", title="error")
        with_full = [*labels, "full, blocks", "full, Newmark"]
        times = [*(c.stepping_s for c in compared), full.blocks_s, full.newmark_s]
        _bars(middle, with_full, times, [*colours, "0.6", "0.35"], seconds)
        middle.set(
            xlabel="seconds",
            title=f"solution time, {example.times_s[-1]:g} s in {len(example.inputs) - 1:,} steps",
        )
        _bars(right, labels, [c.reduced.seconds for c in compared], colours, seconds)
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
                    color=method.colour,
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
        stepping = ranking({c.method.name: c.product for c in comparisons}, lambda v: f"{v:.1e}")
        lowest = min(comparisons, key=lambda c: c.product).method.name
        highest = max(comparisons, key=lambda c: c.product).method.name
        in_all = {c.method.name: 100 * c.error_time * (c.stepping_s + c.reduced.seconds) for c in comparisons}
        with_reduction = ranking(in_all, lambda v: f"{v:.1e}")
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
        + "\n\nAll three reduced models take the same step here, so that the product of error and solution time ranks them by "
        "their error. The right panel counts the reduction, too, once for a single simulation, which weighs on HOM.",
        (9.5, 4.0),
    )


def _table(compared: Sequence[Comparison]) -> str:
    lines = [
        "| method | states | largest error over largest response | its bound | at 0 Hz | in the band | at infinite frequency |",
        "|---|---|---|---|---|---|---|",
    ]
    for c in compared:
        bound = "none" if c.bound is None else per_cent(c.bound)
        lines.append(
            f"| {c.method.name} | {c.reduced.order} | {per_cent(c.error_hinf)} | {bound} | {per_cent(c.error_static)} | "
            f"{per_cent(c.error_band)} | {per_cent(c.error_infinite)} |"
        )
    return "\n".join(lines)


def _what_the_responses_say(example: Example, compared: Sequence[Comparison]) -> str:
    full = example.system
    k = example.channel
    sigma = next(c.reduced.hankel_singular_values for c in compared if c.method is TBR)
    seen = int(np.count_nonzero(sigma > 1e-10 * sigma[0]))
    static, instant = full.static_gain()[k, k], full.d[k, k]
    without_d = abs(static - instant) / abs(static)
    smallest = float(np.min(np.abs(full.transfer(2j * np.pi * frequencies_hz(example))[:, k, k])))
    sharp = (
        f" Relative errors in the band are those at the antiresonances, where the response falls to {smallest:.2g} N/m: with next to "
        "no damping they say little, and the error over the largest response counts."
        if smallest < 0.1 * abs(static)
        else ""
    )
    return (
        f"The full model has {example.n_unknowns:,} unknowns and {full.n_states:,} states; {seen} Hankel singular values "
        f"lie above 1e-10 of the largest, so no balanced model needs more. An order above that is cut back to it. "
        f"Instant stiffness D = {instant:.3g} N/m, static {static:.3g} N/m: with the paper's D = 0 the force at rest "
        f"would be off by {per_cent(without_d)} and have the opposite sign. HOM alone is wrong at infinite frequency, "
        "by the first Hankel singular value that is left out (Glover's D is D - sigma U): the steady error at high "
        f"frequencies that the paper reports, and it shrinks with the order.{sharp}"
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
    small = next(c for c in compared[len(OF_THE_PAPER) :] if c.method is TBR)
    return "\n".join(
        [
            f"- Lowest error: {best}, {agrees}. {ranking(errors, per_cent)}.",
            f"- Solution time: {ranking(times, seconds)}. The step costs what the number of states costs, so that at equal "
            "order no method is faster than another; those that stop at a lower order, because the rest is round-off, are.",
            f"- Time of the reduction: {ranking(making, seconds)}. {cheapest}",
            f"- The full model takes {seconds(full.newmark_s)} by sparse Newmark and {seconds(full.blocks_s)} in modal blocks, "
            f"where nothing is reduced at all: {full.newmark_s / full.blocks_s:.0f} times faster by that alone.",
            f"- TBR at {small.reduced.order} states, a tenth: error {per_cent(small.error_time)}, {seconds(small.stepping_s)}.",
        ]
    )


def _bars(
    axis: Any, labels: Sequence[str], values: Sequence[float], colours: Sequence[str], text: Any
) -> None:
    shown = [max(v, 1e-13) for v in values]
    places = np.arange(len(labels))
    axis.barh(places, shown, color=colours)
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
