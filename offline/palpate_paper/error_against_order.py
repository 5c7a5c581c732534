"""Which reduction to use: in-band and static force error of all four methods against their order.

    python -m palpate_paper.error_against_order configs/liver-coarse.toml --out docs/images/liver_error_against_order

writes OUT.csv and OUT.png.
"""

from __future__ import annotations

import argparse
import csv
import io
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from palpate.build import FullModel, build_full_model
from palpate.files import write_atomically
from palpate.lti.frequencies import all_frequencies, band_frequencies, spectral_norms
from palpate.plots import require_matplotlib, write_picture
from palpate.reduction.methods import METHODS, reductions
from palpate.scene.schema import load_config

ORDERS = (20, 40, 60, 80, 100, 120, 160, 200)


@dataclass(frozen=True)
class Row:
    """One reduced model: relative errors are fractions; `order` is the order that the method reached."""

    method: str
    order: int
    error_in_band: float
    error_static: float
    error_hinf: float


def error_against_order(
    full: FullModel,
    band_hz: tuple[float, float],
    orders: Sequence[int] = ORDERS,
    note: Callable[[str], None] = lambda text: None,
) -> list[Row]:
    """A row for each method and order; orders that a method does not have are left out.

    All models are evaluated at the same frequencies, the full model once: its resonances, and points even in the logarithm.
    """
    system = full.system
    everywhere = all_frequencies((system,))
    in_band = band_frequencies((system,), band_hz)
    omega = np.concatenate([[0.0], in_band, everywhere])
    exact = system.transfer(1j * omega)
    gain = spectral_norms(exact)
    band = slice(1, 1 + len(in_band))
    rows = []
    for method in METHODS:
        note(method)
        family = reductions(system, method, band_hz)
        reachable = np.array([o for o in orders if o >= family.orders[0]])
        nearest = {int(family.orders[i - 1]) for i in np.searchsorted(family.orders, reachable, side="right")}
        for order in sorted(nearest):
            reduced = family.at(order)
            error = spectral_norms(reduced.transfer(1j * omega) - exact)
            relative = error / gain
            rows.append(
                Row(
                    method,
                    reduced.n_states,
                    float(np.max(relative[band])),
                    float(relative[0]),
                    float(np.max(error) / np.max(gain)),
                )
            )
    return rows


def write_table(rows: Sequence[Row], path: Path) -> None:
    """Comma-separated values with a header."""
    table = io.StringIO()
    writer = csv.writer(table)
    writer.writerow(["method", "order", "error_in_band", "error_static", "error_hinf"])
    writer.writerows(
        [r.method, r.order, f"{r.error_in_band:.4e}", f"{r.error_static:.4e}", f"{r.error_hinf:.4e}"]
        for r in rows
    )
    write_atomically(path, table.getvalue().encode())


def draw(rows: Sequence[Row], title: str, band_hz: tuple[float, float], path: Path) -> None:
    """Three panels: error in the haptic band, at 0 Hz, and over all frequencies."""
    require_matplotlib()
    from matplotlib.figure import Figure

    panels = (
        ("error_in_band", f"force error in {band_hz[0]:g}-{band_hz[1]:g} Hz"),
        ("error_static", "force error at 0 Hz"),
        ("error_hinf", "H-infinity error over the largest response"),
    )
    styles = {"tbr": "o-", "tbr-band": "s-", "hankel-optimal": "d-.", "modal": "^--", "modal-static": "v--"}
    figure = Figure(figsize=(14, 4.6), layout="constrained")
    axes = figure.subplots(1, 3)
    for axis, (field, label) in zip(axes, panels, strict=True):
        for method in METHODS:
            chosen = [r for r in rows if r.method == method]
            values = np.array([getattr(r, field) for r in chosen])
            if field == "error_static" and method == "modal-static":
                continue  # exact by construction: round-off says nothing
            axis.semilogy([r.order for r in chosen], values, styles[method], label=method, markersize=4)
        axis.axhline(0.02, color="0.5", linewidth=0.8, linestyle=":")
        axis.annotate(
            "2 %", (0.99, 0.02), xycoords=("axes fraction", "data"), ha="right", va="bottom", color="0.4"
        )
        axis.set(xlabel="order (states)", title=label)
        axis.grid(alpha=0.25, which="both")
    axes[0].set_ylabel("relative error")
    axes[0].legend(frameon=False)
    figure.suptitle(title)
    write_picture(figure, path)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("config", type=Path)
    parser.add_argument("--out", type=Path, required=True, help="path without its ending")
    arguments = parser.parse_args()
    config = load_config(arguments.config)
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    full = build_full_model(config, arguments.config.parent)
    rows = error_against_order(full, config.reduction.band_hz, note=print)
    write_table(rows, arguments.out.with_suffix(".csv"))
    title = f"{config.name}: {full.cloud.n_nodes:,} nodes, {full.system.n_states:,} states in full"
    draw(rows, title, config.reduction.band_hz, arguments.out.with_suffix(".png"))


if __name__ == "__main__":
    main()
