"""Where a simulated device pressed into a model stays stable, with passivity control off and on.

    nice python benchmarks/server_stability.py [MODEL.npz] [--device generic] [--out stability.png]

First a server with the model and a Python client drive each other at 1 kHz, and it is kept which force the client had at
each of its ticks, and which command each tick of the server used: jitter, late and lost messages and all. Then a handle
of 0.05 to 0.2 kg with 0.1 to 2 N s/m, held by a hand (200 N/m, 0.3 N s/m), is pressed 5 mm into the model, with that order of
events: in pieces of 8 s that begin at random places of what was measured. Beside it, forces that are exactly one, two and
three ticks old. The model is made softer and stiffer; so are a sample, and a spring without any losses of its own.
`simulated_device.py` says how time is modeled and what counts as stable.

Colgate & Schenkel (1997): a sampled spring K can't make any passive hand vibrate when b > K (T/2 + D), b being the damping
of handle and hand, D the time from a position to its force: here the 99th percentile of the age of the forces rendered.

Prints the region and how it compares with that bound, and draws it, in a quarter of an hour. The first minute of it wants a quiet
machine: a client that is away for more than 20 ms loses its force for a moment, which knocks the handle, and one that is
knocked again and again never comes to rest.
"""

from __future__ import annotations

import argparse
import itertools
import os
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from device_trace import Trace, steady_trace, trace_through_a_model
from palpate.model_file import ReducedModel, StateSpace, load_model, save_model
from palpate_server.diagnostics.round_trips import RATE_HZ
from palpate_server.diagnostics.sample_model import spring_mass_model
from palpate_server.session.devices import PROFILES
from simulated_device import Handle, comes_to_rest, press

MASSES_KG = (0.05, 0.1, 0.2)
DAMPINGS_N_S_PER_M = (0.1, 0.5, 1.0, 1.5, 2.0)
STIFFNESSES_N_PER_M = 100.0 * 2 ** (np.arange(16) / 2)
LATE_TICKS = (1, 2, 3)
MEASURED_S, TICKS, PIECES = 30.0, 8 * RATE_HZ, 4
REACH_M = 0.005 * np.minimum(1.0, np.arange(TICKS) / (0.4 * RATE_HZ))
HAND_N_S_PER_M = Handle(1.0, 0.0).hand_n_s_per_m

Cells = NDArray[np.bool_]


class Column(NamedTuple):
    """Ways in which forces come, and how late they are, s."""

    title: str
    traces: list[Trace]
    delay_s: float


class Row(NamedTuple):
    """A body, the instant stiffness, N/m, that it has as it is, and which cases are stable without and with passivity control.

    off, on (columns, masses, stiffnesses, dampings)
    """

    body: str
    own_n_per_m: float | None
    off: Cells
    on: Cells


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("model", nargs="?", type=Path, help="(default: the sample alone)")
    parser.add_argument("--device", choices=PROFILES, default="generic", help="its largest damping is used")
    parser.add_argument("--out", type=Path, help="picture to write")
    options = parser.parse_args()
    damping = PROFILES[options.device].max_damping_n_s_per_m
    sample = spring_mass_model(n_modes=10)
    with tempfile.TemporaryDirectory() as folder:
        path = options.model or Path(folder) / "sample.npz"
        if options.model is None:
            save_model(sample, path)
        model = load_model(path)
        measured = measure(path, model.contacts[0].name)
    columns = [Column("as measured", pieces(measured), float(np.percentile(measured.ages_ns(), 99)) * 1e-9)]
    columns += [Column(f"{late} ms late", [steady_trace(TICKS, late)], late / RATE_HZ) for late in LATE_TICKS]
    rows = []
    for body in {each.name: each for each in (model, sample, spring_like(sample))}.values():
        off, on = (np.array([sweep(body, c.traces, d) for c in columns]) for d in (0.0, damping))
        print(f"{body.name}: stable cases, and the stiffness up to which all are")
        for column, *cells in zip(columns, off, on, strict=True):
            without, controlled = (f"{np.mean(each):.0%}, {safe_up_to(each):.0f} N/m" for each in cells)
            print(f"  {column.title}: without control {without}; with up to {damping:g} N s/m {controlled}")
        tell_of_bound(columns, off)
        print(f"  stable only without control: {np.sum(off & ~on)} of {off.size} cases", flush=True)
        rows.append(Row(body.name, own_stiffness(body) if body.discrete.order else None, off, on))
    if options.out:
        draw(rows, columns, options.out)


def measure(path: Path, contact: str) -> Trace:
    """Of a real server and a real client."""
    before = os.getloadavg()[0]
    trips, trace = trace_through_a_model(path, contact, MEASURED_S)
    p50, p99, worst = np.percentile(trace.ages_ns(), (50, 99, 100)) * 1e-6
    ticks, commands = trace.answered()
    late = ticks - commands
    shares = ", ".join(f"{n} {np.mean(late == n):.1%}" for n in LATE_TICKS)
    print(
        f"measured for {MEASURED_S:.0f} s, load of the machine {before:.1f} before, {os.getloadavg()[0]:.1f} after"
    )
    print(
        f"round trip p50 {trips.p50_s * 1e6:.0f} us, p99 {trips.p99_s * 1e6:.0f} us; {trips.unanswered:.1%} unanswered"
    )
    print(f"age of the force when rendered p50 {p50:.2f} ms, p99 {p99:.2f} ms, largest {worst:.0f} ms")
    print(f"in ticks {shares}, more {np.mean(late > LATE_TICKS[-1]):.1%}")
    return trace


def pieces(trace: Trace) -> list[Trace]:
    starts = np.random.default_rng(0).integers(len(trace.device_ns) - TICKS, size=PIECES)
    return [trace.piece(int(start), TICKS) for start in starts]


def own_stiffness(model: ReducedModel) -> float:
    """The model's instant stiffness at its first contact, N/m."""
    return float(np.linalg.norm(model.continuous.d[:3, :3], 2))


def stiffened(model: ReducedModel, stiffness: float) -> ReducedModel:
    """All of the model's forces in proportion, so that its instant stiffness is another, N/m."""
    factor, discrete = stiffness / own_stiffness(model), model.discrete
    return replace(model, discrete=replace(discrete, c=factor * discrete.c, d=factor * discrete.d))


def spring_like(model: ReducedModel) -> ReducedModel:
    """A body with the contacts and the instant stiffness of `model`, but without masses and losses."""
    n = len(model.discrete.d)
    spring = own_stiffness(model) * np.eye(n)
    discrete = StateSpace(np.zeros(0), np.zeros(0), np.zeros((0, n)), np.zeros((n, 0)), spring)
    return replace(model, name="bare spring", discrete=discrete)


def sweep(model: ReducedModel, traces: list[Trace], controller: float) -> Cells:
    """Whether each case is stable with all of the traces; (masses, stiffnesses, dampings)."""
    cases = itertools.product(MASSES_KG, STIFFNESSES_N_PER_M, DAMPINGS_N_S_PER_M)
    stable = [
        all(
            comes_to_rest(press(stiffened(model, k), Handle(m, b), REACH_M, trace, controller)[:, 0])
            for trace in traces
        )
        for m, k, b in cases
    ]
    return np.array(stable).reshape(len(MASSES_KG), len(STIFFNESSES_N_PER_M), len(DAMPINGS_N_S_PER_M))


def safe_up_to(stable: Cells) -> float:
    """The stiffness, N/m, up to which all is stable; (masses, stiffnesses, dampings)."""
    safe = np.cumprod(stable.all(axis=(0, 2))).astype(bool)
    return float(STIFFNESSES_N_PER_M[safe][-1]) if safe.any() else 0.0


def tell_of_bound(columns: list[Column], stable: Cells) -> None:
    """How many of the cases with b > K (T/2 + D) are stable, and which are not; (columns, masses, stiffnesses, dampings)."""
    delays_s = np.array([column.delay_s for column in columns])[:, None, None, None]
    stiffnesses = STIFFNESSES_N_PER_M[:, None]
    left = np.array(DAMPINGS_N_S_PER_M) + HAND_N_S_PER_M - stiffnesses * (0.5 / RATE_HZ + delays_s)
    within = np.broadcast_to(left > 0, stable.shape)
    print(f"  within the bound {np.sum(within)} cases, of them stable {np.sum(stable & within)}")
    for i, j, k, n in np.argwhere(within & ~stable):
        print(
            f"    not {columns[i].title}, {MASSES_KG[j]} kg, {DAMPINGS_N_S_PER_M[n]} N s/m, "
            f"{STIFFNESSES_N_PER_M[k]:.0f} N/m: {left[i, 0, k, n]:.3f} N s/m left"
        )


def draw(rows: list[Row], columns: list[Column], path: Path) -> None:
    """A row for each body and a column for each way in which forces come; stable is what is so with every mass."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot
    from matplotlib.colors import ListedColormap
    from matplotlib.patches import Patch

    kinds = {
        "vibrates with and without passivity control": "#d9695f",
        "stable with passivity control only": "#7fb2e5",
        "stable without it only": "#f0c04c",
        "stable with and without it": "#86c98a",
    }
    figure, axes = pyplot.subplots(
        len(rows),
        len(columns),
        figsize=(12, 1.6 + 2.7 * len(rows)),
        sharex=True,
        sharey=True,
        layout="constrained",
    )
    b = np.linspace(0.0, DAMPINGS_N_S_PER_M[-1] + 0.25, 100)
    for row, line in zip(rows, axes, strict=True):
        kind = 2 * row.off.all(axis=1).astype(int) + row.on.all(axis=1)
        for axis, column, cells in zip(line, columns, kind, strict=True):
            axis.pcolormesh(
                DAMPINGS_N_S_PER_M,
                STIFFNESSES_N_PER_M,
                cells,
                cmap=ListedColormap(list(kinds.values())),
                vmin=0,
                vmax=3,
                edgecolors="white",
                linewidth=0.5,
            )
            (bound,) = axis.plot(b, (b + HAND_N_S_PER_M) / (0.5 / RATE_HZ + column.delay_s), "k--")
            if row.own_n_per_m is not None:
                own = axis.axhline(row.own_n_per_m, color="k", linewidth=1.0, linestyle=":")
        line[0].set_ylabel(f"{row.body}\ninstant stiffness (N/m)")
    axes[0, 0].set_yscale("log")
    axes[0, 0].set_xlim(-0.15, b[-1])
    for axis, column in zip(axes[0], columns, strict=True):
        axis.set_title(f"{column.title}, D = {column.delay_s * 1e3:.1f} ms", fontsize=11)
    for axis in axes[-1]:
        axis.set_xlabel("damping of the device (N s/m)")
        axis.set_xticks(DAMPINGS_N_S_PER_M)
    present = {
        int(k) for row in rows for k in np.unique(2 * row.off.all(axis=1).astype(int) + row.on.all(axis=1))
    }
    patches = [Patch(color=c, label=k) for i, (k, c) in enumerate(kinds.items()) if i in present]
    bound.set_label("b = K (T/2 + D), b with the hand's: passive below")
    own.set_label("the body as it is")
    figure.legend(handles=[*reversed(patches), bound, own], loc="outside lower center", ncols=3)
    figure.suptitle(
        f"A handle of {MASSES_KG[0]} to {MASSES_KG[-1]} kg pressed into a body: where it is stable with every mass"
    )
    figure.savefig(path, dpi=110)


if __name__ == "__main__":
    main()
