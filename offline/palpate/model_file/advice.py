"""What to do about a model whose force is wrong: said alike by the build, by `palpate inspect` and by the server."""

from __future__ import annotations

from palpate.model_file.surface_model import SurfaceModel
from palpate.model_file.types import ReducedModel

NOTABLE_ERROR = 0.1
"""Above this a model is not what it was built for; people notice a difference of about 7 % of a force (Jones 1989)."""


def percent(fraction: float) -> str:
    """A relative error in percent: two significant digits, all before the point from 100 to 10,000 %."""
    return f"{100 * fraction:.0f} %" if 0.995 <= fraction < 100 else f"{100 * fraction:.2g} %"


def what_to_change(method: str) -> str:
    """What lowers the error of a reduction. Never advises the method in use."""
    return "raise the order" if method == "tbr-band" else "raise the order or use tbr-band"


def force_advice(model: ReducedModel | SurfaceModel) -> list[str]:
    """A sentence for each notable error of the force, with what to do; empty for a good model."""
    return _of_surface(model) if isinstance(model, SurfaceModel) else _of_patches(model)


def _of_surface(model: SurfaceModel) -> list[str]:
    accuracy, (low, high) = model.accuracy, model.band_hz
    found = [
        f"Force {where}: wrong by {percent(error)}; lower surface.tolerance."
        for error, where in (
            (accuracy.error_in_working_area, f"in {low:g}-{high:g} Hz in the working area"),
            (accuracy.error_static, "at rest"),
        )
        if not error <= NOTABLE_ERROR  # NaN is notable
    ]
    if not accuracy.is_passive:
        margin = min(accuracy.passivity_margin, accuracy.passivity_margin_sampled)
        found.append(f"Energy: it can be given out, passivity margin {margin:.2g}; build the model again.")
    return found


def _of_patches(model: ReducedModel) -> list[str]:
    accuracy, found = model.accuracy, []
    low, high = accuracy.band_hz
    for error, where in (
        (accuracy.error_in_band, f"in {low:g}-{high:g} Hz"),
        (accuracy.error_static, "at rest"),
    ):
        if not error <= NOTABLE_ERROR:  # NaN is notable
            zero = " A model that always answers zero is wrong by 100 %." if error > 1 else ""
            found.append(f"Force {where}: wrong by {percent(error)}; {what_to_change(model.method)}.{zero}")
    if accuracy.error_step > max(NOTABLE_ERROR, 2 * accuracy.error_static):
        cause = (
            "what lies above the band is fitted only; if jumps matter, use tbr-band"
            if model.method == "passive"
            else "the body rings near half the sampling rate; give the material a branch of short tau_s"
        )
        found.append(f"Force after a jump: wrong by {percent(accuracy.error_step)}; {cause}.")
    return found
