"""The tips of tools: for a surface model, the sphere that a client's tool touches the tissue with."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from palpate.model_file import ReducedModel, SurfaceModel
from palpate.model_file.contact_size import coarse_advice, point_spacing, small_tool_advice
from palpate_server.coupling import models
from palpate_server.coupling.models import Model
from palpate_server.coupling.running import Tip
from palpate_server.errors import Refused
from palpate_server.session.devices import Device, coupling_stiffness
from palpate_server.session.fields import LEAST_STIFFNESS_N_PER_M, TipWanted
from palpate_server.session.leases import ToolSettings


def tip_for(model: Model, tool: int, wanted: TipWanted, device: Device | None, scale: float) -> Tip | None:
    """The tip of a tool, by index, of a surface model; None for a tool of a patch model. Raises Refused.

    Values that were not requested are the file's; the spring is as stiff as the device allows. scale: of the client's frame
    """
    if isinstance(model, ReducedModel):
        if given := [field for field, value in wanted._asdict().items() if value is not None]:
            raise Refused(
                "out_of_range", f"{given[0]} is for the tools of a surface model: {model.name!r} has patches"
            )
        return None
    shape = model.tools[tool]
    radius_m = shape.radius_m if wanted.radius_m is None else wanted.radius_m
    if radius_m > (most := models.largest_radius(model)):
        raise Refused(
            "out_of_range", f"radius_m is {radius_m:g}: expected at most {most:g}, as the model allows"
        )
    friction = shape.friction if wanted.friction is None else wanted.friction
    stiffness = _stiffness(wanted.stiffness_n_per_m, device, model.period_s)
    return Tip(radius_m, friction, stiffness / scale**2, models.start_of(model, tool, radius_m))


def _stiffness(wanted: float | None, device: Device | None, period_s: float) -> float:
    """Of the spring, N/m, at the device. Raises Refused."""
    most = coupling_stiffness(device, period_s)
    if most < LEAST_STIFFNESS_N_PER_M:
        raise Refused(
            "out_of_range",
            f"device_damping_n_s_per_m allows a spring of {most:.2g} N/m with this round_trip_s: expected at least "
            f"{LEAST_STIFFNESS_N_PER_M:g} N/m; leave the damping out where it is not known",
        )
    if wanted is None:
        return most
    if wanted > most * (1 + 1e-9):
        raise Refused(
            "out_of_range",
            f"stiffness_n_per_m is {wanted:g}: expected at most {most:g}, what the device "
            "renders stably with this round trip and damping",
        )
    return wanted


def tips_for(model: Model, settings: Mapping[str, ToolSettings]) -> dict[str, Tip]:
    """The tips of all tools of a surface model, by their settings; none for a patch model. Raises Refused."""
    tips = {
        name: tip_for(model, i, of.wanted, of.device, of.frame.scale)
        for i, (name, of) in enumerate(settings.items())
    }
    return {name: tip for name, tip in tips.items() if tip is not None}


def tip_message(tip: Tip | None, scale: float) -> dict[str, Any]:
    """A tip as messages state it, its stiffness at the device; nil in all for None. scale: of the client's frame"""
    if tip is None:
        return dict.fromkeys(TipWanted._fields)
    return {
        "radius_m": tip.radius_m,
        "friction": tip.friction,
        "stiffness_n_per_m": tip.stiffness_n_per_m * scale**2,
    }


def tip_warnings(model: Model, tool: int, tip: Tip | None) -> list[str]:
    """Where the points of a surface model are too far apart for a tip, by the index of its tool: at its start, or elsewhere."""
    if not isinstance(model, SurfaceModel) or tip is None:
        return []
    nearest = int(np.argmin(np.linalg.norm(model.points - tip.start_m, axis=1)))
    spacing_m = float(point_spacing(model.points, model.triangles)[nearest])
    text = small_tool_advice(model.tools[tool].name, tip.radius_m, spacing_m) or coarse_advice(
        model.points, model.triangles, tip.radius_m
    )
    return [] if text is None else [text]
