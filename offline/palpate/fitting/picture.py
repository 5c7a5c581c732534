"""The picture of a fit: each record with the fit and its residuals, and the loss tangent. Needs the extra `plots`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.fitting.records import ModulusRecord, TimeRecord
from palpate.fitting.tissue import HAPTIC_BAND_HZ, Tissue, complex_modulus
from palpate.plots import write_picture

Array = NDArray[np.float64]

_MEASURED: dict[str, Any] = {"linestyle": "", "marker": ".", "markersize": 3, "color": "0.6"}


def draw_tissue(tissue: Tissue, path: Path) -> None:
    """Write a PNG; the folder must exist. Raises OSError."""
    from matplotlib.figure import Figure

    n = len(tissue.records)
    figure = Figure(figsize=(4.6 * (n + 1), 5.6), layout="constrained")
    grid: Any = figure.add_gridspec(2, n + 1, height_ratios=[2, 1])
    for i, (record, residuals) in enumerate(zip(tissue.records, tissue.residuals, strict=True)):
        above = figure.add_subplot(grid[0, i])
        below = figure.add_subplot(grid[1, i], sharex=above)
        if isinstance(record, TimeRecord):
            _draw_time(above, below, record, residuals)
        else:
            _draw_modulus(above, below, record, residuals)
        above.set_title(record.name)
        below.set_ylabel("fit minus record, %")
    _draw_loss(figure.add_subplot(grid[:, n]), tissue)
    for axis in figure.axes:
        axis.grid(alpha=0.25)
        axis.spines[["top", "right"]].set_visible(False)
    write_picture(figure, path)


def _draw_time(above: Any, below: Any, record: TimeRecord, residuals: Array) -> None:
    size = float(np.max(np.abs(record.response.values)))
    # The axis is logarithmic, so that ramp and hold both show: without the first row, at its zero.
    time_s, values, residuals = (
        (record.time_s - record.time_s[0])[1:],
        record.response.values[1:],
        residuals[1:],
    )
    above.semilogx(time_s, values, label="record", **_MEASURED)
    above.semilogx(time_s, values + size * residuals, color="tab:red", label="fit")
    above.set_ylabel(record.response.label)
    above.legend(frameon=False)
    below.semilogx(time_s, 100 * residuals, **_MEASURED)
    below.set_xlabel("time, s")


def _draw_modulus(above: Any, below: Any, record: ModulusRecord, residuals: Array) -> None:
    f, modulus = record.frequency_hz, record.modulus_pa
    storage, loss = np.split(residuals, 2)
    fitted = modulus + np.abs(modulus) * (storage + 1j * loss)
    above.loglog(f, modulus.real, label="record", **_MEASURED)
    above.loglog(f, modulus.imag, **_MEASURED)
    above.loglog(f, fitted.real, color="tab:red", label="fit, storage")
    above.loglog(f, fitted.imag, color="tab:blue", label="fit, loss")
    above.set_ylabel("modulus, Pa")
    above.legend(frameon=False)
    below.semilogx(f, 100 * storage, linestyle="", marker=".", color="tab:red")
    below.semilogx(f, 100 * loss, linestyle="", marker=".", color="tab:blue")
    below.set_xlabel("frequency, Hz")


def _draw_loss(axis: Any, tissue: Tissue) -> None:
    """A line where a record reaches, dots with their intervals in the haptic band."""
    for record in tissue.records:
        low, high = record.window_s
        f = np.geomspace(1 / (2 * np.pi * high), 1 / (2 * np.pi * low), 200)
        modulus = complex_modulus(tissue.relaxation, f)
        axis.semilogx(f, modulus.imag / modulus.real, color="tab:red")
    for loss in tissue.loss_tangent:
        if loss.value:
            ends = [[loss.value.value - loss.value.low], [loss.value.high - loss.value.value]]
            axis.errorbar(loss.frequency_hz, loss.value.value, ends, color="k", marker="o", capsize=3)
    axis.axvspan(HAPTIC_BAND_HZ[0], HAPTIC_BAND_HZ[-1], color="tab:orange", alpha=0.12, label="haptic band")
    axis.set_ylim(bottom=0)
    axis.set_xlabel("frequency, Hz")
    axis.set_ylabel("loss tangent, where a record tells it")
    axis.legend(frameon=False)
