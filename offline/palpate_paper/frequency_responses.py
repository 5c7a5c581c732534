"""Figures 4, 7 and 10: frequency responses of the full models and of the paper's three reductions."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from palpate_paper.examples import Example
from palpate_paper.figure import Figure, tidy
from palpate_paper.methods import OF_THE_PAPER, TBR
from palpate_paper.study import Comparison, Study, per_cent

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
            color = model.method.color
            top.loglog(hz, np.abs(response), color=color, linewidth=0.9, label=f"reduced, {model.order}")
            top.set_title(f"({'abcd'[i]}) {model.method.name}, {model.order} states", fontsize="medium")
            top.legend(frameon=False, fontsize="small", loc="best")
            error = np.abs(response - exact) / np.abs(exact)
            bottom.loglog(hz, np.maximum(error, 1e-16), color=color, linewidth=0.9)
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
    """Points even in the logarithm from a tenth of the first resonance to three times the last, and the resonances with
    the largest response at the tip."""
    system = example.system
    pair = np.flatnonzero(system.is_pair)
    resonance = system.poles.imag[pair] / (2 * np.pi)
    weight = np.linalg.norm(system.b[pair], axis=1) * np.linalg.norm(system.c[:, pair], axis=0)
    weight /= -system.poles.real[pair]
    seen = pair[np.argsort(weight)[::-1][:200]]
    grid = np.geomspace(resonance.min() / 10, 3 * resonance.max(), _FREQUENCIES)
    return np.unique(np.concatenate([grid, system.poles.imag[seen] / (2 * np.pi)]))


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
