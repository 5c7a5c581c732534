"""Where a simulated device pressed into a model stays stable, with passivity control off and on.

    python benchmarks/server_stability.py [MODEL.npz] [--device generic] [--out stability.png]

A handle of 0.05 to 0.2 kg with 0.1 to 2 N s/m, held by a hand (spring and damper), is pressed into the model at 1 kHz; the
force it renders is one to three ticks old, as after a round trip of up to three milliseconds. The model is made stiffer
and stiffer; its part is the server's own tick. A run counts as stable when the handle does not go on vibrating. Prints the
share of stable runs and draws the region.
"""

from __future__ import annotations

import argparse
import itertools
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from palpate.model import ReducedModel, load_model
from palpate_server import layout, loop
from palpate_server.devices import PROFILES
from palpate_server.image import make_image
from palpate_server.safety import Limits
from palpate_server.sample_model import spring_mass_model

MASSES_KG = (0.05, 0.1, 0.2)
DAMPINGS_N_S_PER_M = (0.1, 0.5, 1.0, 2.0)
STIFFNESSES_N_PER_M = np.geomspace(300.0, 12000.0, 9)
DELAYS = (1, 2, 3)  # ticks between a position and the force that answers it
HAND_N_PER_M, HAND_N_S_PER_M = 200.0, 0.3
REACH_M = 0.005
SECONDS, SUBSTEPS = 2.0, 10
REST_M = 5e-4  # a handle that moves less, and less and less, is coming to rest


def safe_up_to(stable: np.ndarray) -> float:
    """The stiffness, N/m, below which all is stable; (masses, stiffnesses)."""
    safe = np.cumprod(stable.all(axis=0)).astype(bool)
    return float(STIFFNESSES_N_PER_M[safe][-1]) if safe.any() else 0.0


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("model", nargs="?", type=Path, help="(default: a sample of some 500 N/m)")
    parser.add_argument("--device", choices=PROFILES, default="generic", help="its largest damping is used")
    parser.add_argument("--out", type=Path, help="picture to write")
    options = parser.parse_args()
    model = load_model(options.model) if options.model else spring_mass_model(n_modes=10)
    damping = PROFILES[options.device].max_damping_n_s_per_m
    own = float(np.linalg.norm(model.continuous.d[:3, :3], 2))
    print(f"{model.name}: instant stiffness {own:.0f} N/m, scaled; control off, and on with {damping} N s/m")
    stable = {}
    for controller in (0.0, damping):
        cases = itertools.product(DELAYS, MASSES_KG, STIFFNESSES_N_PER_M, DAMPINGS_N_S_PER_M)
        swings = [swing(stiffened(model, k / own), m, b, d, controller) for d, m, k, b in cases]
        shape = (len(DELAYS), len(MASSES_KG), len(STIFFNESSES_N_PER_M), len(DAMPINGS_N_S_PER_M))
        stable[controller] = np.array(swings).reshape(shape) < REST_M
        shares = ", ".join(
            f"{np.mean(part):.0%} at {d} ms" for part, d in zip(stable[controller], DELAYS, strict=True)
        )
        print(f"{'on ' if controller else 'off'}: stable {np.mean(stable[controller]):.0%} ({shares})")
        for part, delay in zip(stable[controller], DELAYS, strict=True):
            for b, damping_name in enumerate(DAMPINGS_N_S_PER_M):
                print(
                    f"     {delay} ms, {damping_name:g} N s/m: any of the masses up to {safe_up_to(part[:, :, b]):.0f} N/m"
                )
    lost = np.sum(stable[0.0] & ~stable[damping])
    print(f"stable without control and not with it: {lost} of {stable[0.0].size}")
    if options.out:
        draw(stable, options.out)


def stiffened(model: ReducedModel, factor: float) -> ReducedModel:
    discrete = model.discrete
    return replace(model, discrete=replace(discrete, c=factor * discrete.c, d=factor * discrete.d))


def swing(model: ReducedModel, mass: float, damping: float, delay: int, controller: float) -> float:
    """How much the handle still moves in the last quarter of the run, m."""
    contact = model.contacts[0]
    inwards = -np.array(contact.normal)
    period = model.period_s
    limits = Limits(1e3, 1e9, 1e3, 1.0, controller)
    memory = layout.make_memory(model.discrete, period, [limits] * len(model.contacts), 1.0)
    image = make_image(memory)
    position = velocity = 0.0
    rendered: list[float] = [0.0] * delay  # forces under way to the device, oldest first
    positions = []
    ticks = int(SECONDS / period)
    for k in range(ticks):
        now = time.monotonic_ns()
        memory.shared[layout.DEADLINE_NS] = now + memory.period_ns[0] // 4
        depth = max(position, 0.0)  # outside, the tip does not touch
        told = k - delay - 1 if k > delay else -1
        target = tuple(float(v) for v in depth * inwards)
        loop.write_command(memory.commands, 0, k, 0, now, told, 0, target, (0.0, 0.0, 0.0))
        loop.tick_on_arrival(image, now)
        rendered.append(float(memory.device_force[0] @ inwards))
        force = rendered.pop(0) if depth > 0 else 0.0 * rendered.pop(0)
        wanted = REACH_M * min(1.0, 5 * k / ticks)
        h = period / SUBSTEPS
        for _ in range(SUBSTEPS):  # the force is held, the handle moves on
            hand = HAND_N_PER_M * (wanted - position) - HAND_N_S_PER_M * velocity
            velocity += h / mass * (hand - force - damping * velocity)
            position += h * velocity
        if abs(position) > 1.0:
            return np.inf
        positions.append(position)
    return float(np.ptp(positions[-ticks // 4 :]))


def draw(stable: dict[float, np.ndarray], path: Path) -> None:
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(
        len(MASSES_KG), len(DELAYS), figsize=(10, 8), sharex=True, sharey=True, layout="constrained"
    )
    off, on = stable.values()
    for i, mass in enumerate(MASSES_KG):
        for j, delay in enumerate(DELAYS):
            axis = axes[i, j]
            for k, stiffness in enumerate(STIFFNESSES_N_PER_M):
                for n, damping in enumerate(DAMPINGS_N_S_PER_M):
                    without, with_control = off[j, i, k, n], on[j, i, k, n]
                    color = "tab:green" if without and with_control else "tab:blue"
                    if not with_control:
                        color = "tab:red" if not without else "tab:orange"
                    axis.plot(damping, stiffness, "o", color=color, markersize=9)
            axis.set_yscale("log")
            axis.set_title(f"{mass} kg, {delay} ms late", fontsize=10)
    for axis in axes[-1]:
        axis.set_xlabel("damping of the device (N s/m)")
    for axis in axes[:, 0]:
        axis.set_ylabel("instant stiffness (N/m)")
    figure.suptitle(
        "A handle pressed into the model. Green: stable; blue: stable with passivity control only;\n"
        "orange: without it only; red: vibrates either way"
    )
    figure.savefig(path, dpi=110)


if __name__ == "__main__":
    main()
