"""Whether a simulated handle pressed into a surface model stays stable, without passivity control.

    nice python benchmarks/surface_stability.py MODEL.npz [--tool NAME]

A handle of 0.05 to 0.2 kg with 0.1 to 2 N s/m, held by a hand (200 N/m, 0.3 N s/m), is pressed 5 mm into the model by one of its
tools, for 8 s, with forces that are exactly one, two and three ticks old. The spring between device and sphere is as stiff as
the server makes it for a device with the handle's damping and this round trip; and, beside it, as stiff as the device profile
alone would allow. `simulated_device.py` says how time is modeled and what counts as stable.
"""

from __future__ import annotations

import argparse
import itertools
from dataclasses import replace
from pathlib import Path

import numpy as np

from device_trace import steady_trace
from palpate.model_file import SurfaceModel, load_model
from palpate_server.coupling.models import tips_of_file
from palpate_server.session.devices import PROFILES, Device, coupling_stiffness
from server_stability import DAMPINGS_N_S_PER_M, LATE_TICKS, MASSES_KG, REACH_M, TICKS
from simulated_device import Handle, comes_to_rest, press


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("model", type=Path)
    parser.add_argument("--device", choices=PROFILES, default="generic")
    parser.add_argument("--tool", help="(default: the model's first)")
    options = parser.parse_args()
    model = load_model(options.model)
    if not isinstance(model, SurfaceModel):
        parser.error(f"{options.model} is no surface model")
    model = with_tool(model, options.tool)
    print("ms late | chosen: N/m, stable cases | the device's alone: N/m, stable cases")
    for late in LATE_TICKS:
        chosen, alone = [], []
        for mass, damping in itertools.product(MASSES_KG, DAMPINGS_N_S_PER_M):
            device = Device(PROFILES[options.device], late * 1e-3, damping)
            stiffness = coupling_stiffness(device, model.period_s)
            largest = device.profile.max_stiffness_n_per_m
            chosen.append((stiffness, is_stable(model, Handle(mass, damping), late, stiffness)))
            alone.append((largest, is_stable(model, Handle(mass, damping), late, largest)))
        print(f"{late:7d} | {told(chosen)} | {told(alone)}", flush=True)


def with_tool(model: SurfaceModel, name: str | None) -> SurfaceModel:
    """The model with one tool."""
    tool = next(tool for tool in model.tools if name in (None, tool.name))
    return replace(model, tools=(tool,))


def is_stable(model: SurfaceModel, handle: Handle, late: int, stiffness_n_per_m: float) -> bool:
    (tip,) = tips_of_file(model)
    tips = [tip._replace(stiffness_n_per_m=stiffness_n_per_m)]
    motion = press(model, handle, REACH_M, steady_trace(TICKS, late), 0.0, tips)
    return comes_to_rest(motion[:, 0])


def told(cases: list[tuple[float, bool]]) -> str:
    stiffnesses, stable = zip(*cases, strict=True)
    return f"{np.min(stiffnesses):.0f}-{np.max(stiffnesses):.0f}, {sum(stable)} of {len(stable)}"


if __name__ == "__main__":
    main()
