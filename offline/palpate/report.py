"""The accuracy report of a model in words that need no knowledge of the method; every figure on request."""

from __future__ import annotations

import numpy as np

from palpate.model_file import Contact, ReducedModel, SurfaceModel
from palpate.model_file.advice import NOTABLE_ERROR, force_advice, percent
from palpate.model_file.contact_size import blunted_radius_m, carried_share
from palpate.model_file.surface_model import SAMPLE_SIZE

GOOD_ERROR = 0.05  # below what a hand tells apart: from about 7 % of a force (Pang, Tan & Durlach 1991)

Rows = list[tuple[str, str, str]]


def accuracy_text(model: ReducedModel | SurfaceModel, verbose: bool = False) -> str:
    """The most important errors of a model, a verdict and advice; `verbose` adds every figure."""
    if isinstance(model, SurfaceModel):
        return _surface_text(model, verbose)
    lines = [f"\n{model.name}: {model.order} states instead of {model.n_states_full:,} ({model.method})"]
    lines += _columns(_first_screen(model))
    lines.append(f"  verdict: {_verdict(model)}")
    lines += [f"  - {text}" for text in advice(model)]
    return "\n".join(lines + _details(_figures(model), verbose))


def advice(model: ReducedModel) -> list[str]:
    """What to change where an error is notable, a sentence each; empty for a good model."""
    accuracy, found = model.accuracy, force_advice(model)
    if model.continuous.n_padding:
        found.append(
            f"Order {model.order - 1} is stored as {model.order}: states come in pairs, one is padding."
        )
    if accuracy.resolved_frequency_hz < accuracy.band_hz[1]:
        factor = accuracy.resolved_frequency_hz / accuracy.band_hz[1]
        found.append(
            f"Mesh: to carry the whole band, make the node spacing {factor:.2g} times what it is, or end the band at "
            f"{accuracy.resolved_frequency_hz:.3g} Hz."
        )
    return found


def _first_screen(model: ReducedModel) -> Rows:
    accuracy = model.accuracy
    low, high = accuracy.band_hz
    carried = accuracy.resolved_frequency_hz
    rows = [
        ("force while moving", f"wrong by at most {percent(accuracy.error_in_band)}", f"motions of {low:g} to {high:g} Hz, the haptic band"),
        ("force at rest", f"wrong by {percent(accuracy.error_static)}", "tip held still"),
        ("force after a jump", f"wrong by {percent(accuracy.error_step)}", "of the force at rest, from 0.2 s on"),
        ("mesh", f"carries waves up to {carried:.3g} Hz", "the whole band" if carried >= high else "not the whole band: above it, the force is the mesh's more than the tissue's"),
    ]  # fmt: skip
    if accuracy.passive_up_to_hz >= 0.499 / model.period_s:
        rows.append(("energy", "never given out", "passive at every frequency"))
    else:
        most = 1e3 * accuracy.largest_energy_out_j
        rows.append(
            ("energy", f"passive up to {accuracy.passive_up_to_hz:.3g} Hz", f"faster motions of 1 mm can get {most:.2g} mJ out, each")
        )  # fmt: skip
    for index, contact in enumerate(model.contacts):
        rest, instant = _stiffness(model, index, contact)
        rows.append(
            (
                f"stiffness at '{contact.name}'",
                f"{rest:.3g} N/m at rest",
                f"{instant:.3g} N/m at the first instant",
            )
        )
    return rows


def _verdict(model: ReducedModel) -> str:
    accuracy = model.accuracy
    worst = max(accuracy.error_in_band, accuracy.error_static, accuracy.error_step)
    if worst > NOTABLE_ERROR:
        return f"poor: the force is wrong by up to {percent(worst)} of itself"
    resolved = accuracy.resolved_frequency_hz >= accuracy.band_hz[1]
    mesh = "" if resolved else f"; the mesh limits it above {accuracy.resolved_frequency_hz:.3g} Hz"
    if worst > GOOD_ERROR:
        return f"fair: a trained hand may feel the error{mesh}"
    return f"good: the error of the reduction is below what a hand tells apart{mesh}"


def _stiffness(model: ReducedModel, index: int, contact: Contact) -> tuple[float, float]:
    """N/m along the contact's normal, at rest and at the first instant."""
    along, normal = slice(3 * index, 3 * index + 3), np.asarray(contact.normal)
    rest, instant = (
        float(normal @ matrix[along, along] @ normal)
        for matrix in (model.static_stiffness, model.continuous.d)
    )
    return rest, instant


def _figures(model: ReducedModel) -> Rows:
    accuracy = model.accuracy
    bound = "none" if accuracy.error_bound is None else percent(accuracy.error_bound)
    return [
        ("nodes", f"{model.n_nodes:,}", ""),
        ("error in band", percent(accuracy.error_in_band), "force, the discrete model against the full one"),
        ("before sampling", percent(accuracy.error_in_band_continuous), "the reduction's share of it"),
        ("error at 0 Hz", percent(accuracy.error_static), "static force"),
        ("error in time", percent(accuracy.error_time_domain), "force during a poke, of the largest force"),
        ("error of the surface", percent(accuracy.error_surface_in_band), f"displacement, largest in the band, against the full model's {model.n_states_full:,} states"),
        ("gain above the band", f"{accuracy.gain_above_band:.3g}", "largest force over the full model's smoothed one, up to half the sampling rate"),
        ("full model converged", "all modes" if accuracy.change_over_last_vectors == 0 else percent(accuracy.change_over_last_vectors), "change of its force in the band by its last vectors"),
        ("error, H-infinity", percent(accuracy.error_hinf), "largest over all frequencies, of the largest response; far above the band it may be 100 %"),
        ("bound, H-infinity", bound, "what the method guarantees beforehand"),
        ("spectral abscissa", f"{accuracy.spectral_abscissa:.3g} 1/s", f"of the slowest state, the full model's is {accuracy.spectral_abscissa_full:.3g} 1/s; below 0 is stable"),
        ("passivity margin", f"{accuracy.passivity_margin:.2g}", "dissipation over static stiffness, smallest; below 0 can give out energy"),
        ("passive up to", f"{accuracy.passive_up_to_hz:.3g} Hz", "no slower sinusoidal motion gets energy out"),
        ("energy given out", f"{accuracy.largest_energy_out_j:.2g} J", "at most, in one closed motion of 1 mm"),
        ("mesh resolves", f"{accuracy.resolved_frequency_hz:.3g} Hz", "shear waves with 6 nodes each"),
    ]  # fmt: skip


def _surface_text(model: SurfaceModel, verbose: bool) -> str:
    accuracy, (low, high) = model.accuracy, model.band_hz
    n_free = int(np.count_nonzero(~model.held))
    radius = min(tool.radius_m for tool in model.tools)
    carried = carried_share(model.points, model.triangles, radius)
    rows = [
        ("force while moving", f"wrong by at most {percent(accuracy.error_in_working_area)}", f"motions of {low:g} to {high:g} Hz, at the worst sampled point of the working areas"),
        ("", f"wrong by at most {percent(accuracy.error_in_band)}", f"at the worst sampled point of all; median {percent(accuracy.error_in_band_median)}"),
        ("force at rest", f"wrong by {percent(accuracy.error_static)}", f"at the worst sampled point of all; median {percent(accuracy.error_static_median)}"),
        ("points", f"near enough on {percent(carried)}", _elsewhere(model, carried, radius)),
        ("mesh", f"carries waves up to {accuracy.resolved_frequency_hz:.3g} Hz", "where it is coarsest"),
        ("energy", "never given out" if accuracy.is_passive else "can be given out", f"passivity margin {accuracy.passivity_margin:.1g}, sampled {accuracy.passivity_margin_sampled:.1g}"),
        ("largest stiffness", f"{accuracy.largest_stiffness_n_per_m:.3g} N/m", "in one tick, what a device can meet without a virtual coupling"),
    ]  # fmt: skip
    tools = ", ".join(f"{tool.name} ({1e3 * tool.radius_m:g} mm)" for tool in model.tools)
    lines = [
        f"\n{model.name}: {model.n_points:,} points to touch, {model.n_modes:,} modes, tools {tools}",
        f"  errors are those of a tip of {1e3 * radius:g} mm radius, pressed in by half of it, at a sample of up to {SAMPLE_SIZE} points",
        *_columns(rows),
        f"  verdict: {_surface_verdict(model, carried == 1)}",
    ]
    figures = [
        ("nodes", f"{model.n_nodes:,}", ""),
        ("points", f"{model.n_points:,}", f"{model.n_points - n_free:,} of them held"),
        ("triangles", f"{len(model.triangles):,}", ""),
        ("highest mode", f"{np.sqrt(model.squared_frequencies[-1]) / (2 * np.pi):.3g} Hz", ""),
        ("contact radius", f"{1e3 * accuracy.contact_radius_m:.3g} mm", "of the smallest tool, where errors are stated"),
        ("shift of the residual", f"{accuracy.residual_shift_m_per_n:.2g} m/N", "makes it definite in spite of rounding"),
    ]  # fmt: skip
    return "\n".join(lines + _details(figures, verbose))


def _elsewhere(model: SurfaceModel, carried: float, radius_m: float) -> str:
    """What is to be said of the rest of the surface."""
    if carried == 1:
        return f"for a tip of {1e3 * radius_m:g} mm"
    largest = float(blunted_radius_m(model.points, model.triangles, radius_m).max())
    return f"for a tip of {1e3 * radius_m:g} mm; elsewhere it acts as a blunter one, of up to {1e3 * largest:.2g} mm"


def _surface_verdict(model: SurfaceModel, everywhere: bool) -> str:
    accuracy, where = model.accuracy, "" if everywhere else " in the working areas"
    worst = max(accuracy.error_in_working_area, accuracy.error_static)
    if worst > NOTABLE_ERROR:
        return f"poor: the force is wrong by up to {percent(worst)} of itself{where}; lower surface.tolerance"
    carried = accuracy.resolved_frequency_hz
    mesh = "" if carried >= model.band_hz[1] else f"; the mesh limits it above {carried:.3g} Hz"
    if worst > GOOD_ERROR:
        return f"fair{where}: a trained hand may feel the error{mesh}"
    return f"good{where}: the error is below what a hand tells apart{mesh}"


def _details(figures: Rows, verbose: bool) -> list[str]:
    if verbose:
        return ["", "every figure (docs/model-file.md defines them):", *_columns(figures)]
    return ["  (--verbose shows every figure)"]


def _columns(rows: Rows) -> list[str]:
    first, second = (max(len(row[column]) for row in rows) for column in (0, 1))
    return [f"  {a:<{first}}  {b:<{second}}  {c}".rstrip() for a, b, c in rows]
