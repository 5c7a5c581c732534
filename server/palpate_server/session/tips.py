"""The tips of tools: for a surface model, the sphere that a client's tool touches the tissue with."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from palpate.model_file import ReducedModel, SurfaceModel
from palpate.model_file.contact_size import small_tool_advice
from palpate_server.coupling import models
from palpate_server.coupling.models import Model
from palpate_server.coupling.running import Tip
from palpate_server.errors import Refused
from palpate_server.session.devices import Device, coupling_stiffness
from palpate_server.session.fields import TipWanted
from palpate_server.session.leases import ToolSettings

MOST_FRICTION = 2.0

_NEIGHBORS = 6


def tip_for(model: Model, name: str, wanted: TipWanted, device: Device | None, scale: float) -> Tip | None:
    """The tip of a tool of a surface model; None for a tool of a patch model. Raises Refused.

    Without a wish, radius and friction are the file's, and the spring is as stiff as the device allows. scale: of the frame
    """
    tools = {tool.name: (i, tool) for i, tool in enumerate(models.tools_of(model))}
    index, described = tools[name]
    if described.friction is None or isinstance(model, ReducedModel):
        if given := [field for field, value in wanted._asdict().items() if value is not None]:
            raise Refused(
                "out_of_range", f"{given[0]} is for the tools of a surface model: {model.name!r} has patches"
            )
        return None
    radius_m = described.radius_m if wanted.radius_m is None else wanted.radius_m
    if radius_m > (most := models.largest_radius(model)):
        raise Refused(
            "out_of_range", f"radius_m is {radius_m:g}: expected at most {most:g}, as the model allows"
        )
    friction = described.friction if wanted.friction is None else wanted.friction
    if friction > MOST_FRICTION:
        raise Refused("out_of_range", f"friction is {friction:g}: expected 0 to {MOST_FRICTION:g}")
    stiffness = coupling_stiffness(device, model.period_s)
    if stiffness == 0.0:
        raise Refused(
            "out_of_range",
            "device_damping_n_s_per_m is 0: expected above 0, or nothing where it is not known",
        )
    if wanted.stiffness_n_per_m is not None:
        if wanted.stiffness_n_per_m > stiffness * (1 + 1e-9):
            raise Refused(
                "out_of_range",
                f"stiffness_n_per_m is {wanted.stiffness_n_per_m:g}: expected at most {stiffness:g}, what the device "
                "renders stably with this round trip and damping",
            )
        stiffness = wanted.stiffness_n_per_m
    return Tip(radius_m, friction, stiffness / scale**2, models.start_of(model, index, radius_m))


def tips_for(model: Model, settings: Mapping[str, ToolSettings]) -> tuple[Tip, ...]:
    """The tips of all tools of a surface model, by their settings; none for a patch model. Raises Refused."""
    tips = (
        tip_for(model, tool.name, of.wanted, of.device, of.frame.scale)
        for tool in models.tools_of(model)
        if tool.friction is not None and (of := settings[tool.name])
    )
    return tuple(tip for tip in tips if tip is not None)


def tip_message(model: Model, name: str, settings: ToolSettings) -> dict[str, Any]:
    """The tip of a tool as messages state it, its stiffness at the device; nil in all for a tool of a patch model."""
    scale = settings.frame.scale
    tip = tip_for(model, name, settings.wanted, settings.device, scale)
    if tip is None:
        return dict.fromkeys(TipWanted._fields)
    return {
        "radius_m": tip.radius_m,
        "friction": tip.friction,
        "stiffness_n_per_m": tip.stiffness_n_per_m * scale**2,
    }


def tip_warnings(model: Model, name: str, wanted: TipWanted) -> list[str]:
    """What a tip that was asked for is too small for: the points of a surface model near the tool's start."""
    if not isinstance(model, SurfaceModel) or wanted.radius_m is None:
        return []
    home = next(tool.home_m for tool in model.tools if tool.name == name)
    nearest = np.argsort(np.linalg.norm(model.points - home, axis=1))[0]
    from_there = np.sort(np.linalg.norm(model.points - model.points[nearest], axis=1))
    text = small_tool_advice(name, wanted.radius_m, float(np.median(from_there[1 : 1 + _NEIGHBORS])))
    return [] if text is None else [text]
