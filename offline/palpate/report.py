"""The accuracy report of a model as a table for a person."""

from __future__ import annotations

import numpy as np
from rich import box
from rich.table import Table

from palpate.model_file import ReducedModel

_NOTABLE = 0.1  # a relative error above this is not what a model is built for


def percent(fraction: float) -> str:
    """A relative error in percent with two significant digits, three from 100 % up."""
    return f"{100 * fraction:.2g} %" if fraction < 0.995 else f"{100 * fraction:.0f} %"


def marked(fraction: float) -> str:
    """The same, in yellow where nobody should overlook it."""
    return f"[yellow]{percent(fraction)}[/]" if fraction > _NOTABLE else percent(fraction)


def accuracy_table(model: ReducedModel) -> Table:
    """What the model is and how good it is, a line each."""
    accuracy = model.accuracy
    table = Table(
        title=f"{model.name}: {model.method}, order {model.order}",
        title_justify="left",
        box=box.SIMPLE_HEAD,
        pad_edge=False,
    )
    table.add_column("accuracy", no_wrap=True)
    table.add_column("value", justify="right", no_wrap=True)
    table.add_column("meaning", style="dim")

    low, high = accuracy.band_hz
    bound = "none" if accuracy.error_bound is None else percent(accuracy.error_bound)
    table.add_row(
        "states",
        f"{model.n_states_full:,} → {model.order}",
        f"{model.n_nodes:,} nodes",
    )
    table.add_row("error in band", marked(accuracy.error_in_band), f"force, largest in {low:g}-{high:g} Hz")
    table.add_row("before sampling", marked(accuracy.error_in_band_continuous), "the reduction's share of it")
    table.add_row("error at 0 Hz", marked(accuracy.error_static), "static force")
    table.add_row("error, H-infinity", percent(accuracy.error_hinf), "of the largest response")
    table.add_row("bound, H-infinity", bound, "a priori")
    table.add_row("error in time", marked(accuracy.error_time_domain), "force during a poke")
    table.add_row("error after a jump", marked(accuracy.error_step), "of the static force, 0.2 s later")
    table.add_row("error of the surface", marked(accuracy.error_surface_in_band), "displacement in the band")
    table.add_row(
        "spectral abscissa",
        f"{accuracy.spectral_abscissa:.3g}",
        "1/s; below 0: stable",
    )
    table.add_row(
        "passivity margin",
        f"{accuracy.passivity_margin:.2g}",
        "below 0: can give out energy",
    )
    table.add_row(
        "passive up to", f"{accuracy.passive_up_to_hz:.3g} Hz", "only faster pokes can get energy out"
    )
    table.add_row(
        "energy given out",
        f"{accuracy.largest_energy_out_j:.2g} J",
        "at most, by a closed poke of 1 mm",
    )
    resolved = accuracy.resolved_frequency_hz
    meaning = "shear waves, 6 nodes each"
    if resolved < high:
        meaning += f"; [yellow]band: {high:g} Hz[/]"
    table.add_row("cloud resolves", f"{resolved:.3g} Hz", meaning)
    for index, contact in enumerate(model.contacts):
        along = slice(3 * index, 3 * index + 3)
        normal = np.asarray(contact.normal)
        rest = normal @ model.static_stiffness[along, along] @ normal
        instant = normal @ model.continuous.d[along, along] @ normal
        table.add_row(
            f"stiffness at '{contact.name}'",
            f"{rest:.3g} N/m",
            f"at rest; instantly {instant:.3g}",
        )
    return table
