"""A simulated haptic device pressed into a model: a handle in a hand, a bridge between, and the server's own ticks.

Time goes as a Trace says, measured or made. At each of its ticks the device reads its position, sends it, and takes up the
newest force that has come, which it holds until its next tick. So when the round trip is shorter than the time between
two ticks, the force answers the position one tick before; with a late or a lost message, two or more before. The server's
ticks run in their order, each with the command that it used then: one that was superseded or lost was never felt by the
model, and a tick without a new one used the one before again. Between two of its ticks the handle moves on under the force
that it holds, by the exact solution.

Commands carry no velocity, which would hide some of the delay. The tip is in the tissue while the handle is beyond the
surface; outside, nothing is rendered. Nothing limits the forces, and the device never lets go.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from device_trace import Trace
from palpate_server.coupling.models import Model, make_running, tools_of
from palpate_server.coupling.running import Tip
from palpate_server.realtime import scheduler, shared_memory
from palpate_server.realtime.native_image import make_image
from palpate_server.realtime.safety import Limits

SHAKING_M = 1e-5  # what a hand hardly feels


@dataclass(frozen=True)
class Handle:
    """A mass with viscous damping that a hand, a spring and a damper, pulls along one line."""

    mass_kg: float
    damping_n_s_per_m: float
    hand_n_per_m: float = 200.0
    hand_n_s_per_m: float = 0.3

    def propagators(self, durations_s: NDArray[np.float64]) -> NDArray[np.float64]:
        """What becomes of the distance from equilibrium and the velocity under a constant force; (n,) to (n, 2, 2)."""
        damping = self.damping_n_s_per_m + self.hand_n_s_per_m
        rates = np.array([[0.0, 1.0], [-self.hand_n_per_m / self.mass_kg, -damping / self.mass_kg]])
        eigenvalues, vectors = np.linalg.eig(rates)
        waves = vectors * np.exp(np.multiply.outer(durations_s, eigenvalues))[:, None, :]
        return np.real(waves @ np.linalg.inv(vectors))


def press(
    model: Model,
    handle: Handle,
    reach_m: NDArray[np.float64],
    trace: Trace,
    max_damping_n_s_per_m: float,
    tips: Sequence[Tip] | None = None,
) -> NDArray[np.float64]:
    """The handle's position at the n ticks of the device, m from the surface and inwards, and velocity, m/s; (n, 2).

    reach_m (n,): where the hand would have the handle. max_damping_n_s_per_m: of passivity control, 0 for none. tips: of a
    surface model's tools, by default its file's. A handle
    that is a meter away is not followed further: the rest is infinite.
    """
    tools = tools_of(model)
    inwards = -np.array(tools[0].normal)
    limits = Limits(1e6, 1e12, 1e6, 1e3, max_damping_n_s_per_m)
    memory = shared_memory.make_memory(make_running(model, tips), model.period_s, [limits] * len(tools), 1.0)
    image = make_image(memory)
    incoming = memory.commands.incoming[0]
    propagators = handle.propagators(np.diff(trace.device_ns) * 1e-9).tolist()
    rendered, used = trace.rendered.tolist(), trace.used.tolist()
    server_ns, arrival_ns = trace.server_ns.tolist(), trace.arrival_ns.tolist()
    motion = np.full((len(reach_m), 2), np.inf)
    position = velocity = 0.0
    depths: list[float] = []
    forces: list[float] = []
    for k, wanted in enumerate(reach_m.tolist()):
        motion[k] = position, velocity
        depths.append(max(position, 0.0))
        for tick in range(len(forces), rendered[k] + 1):
            command = used[tick]
            if command >= 0:
                told = rendered[command - 1] if command > 0 else -1
                incoming["sequence"], incoming["arrival_ns"] = command, arrival_ns[tick]
                incoming["rendered_tick"], incoming["position_m"] = told, depths[command] * inwards
                scheduler.hand_over(image, 1)
            scheduler.repeat_tick(image, server_ns[tick], server_ns[tick], False)
            forces.append(-float(memory.ports["raw_force_n"][0] @ inwards))
        if k == len(propagators) or abs(position) > 1.0:
            break
        force = forces[rendered[k]] if position > 0 and rendered[k] >= 0 else 0.0
        equilibrium = wanted - force / handle.hand_n_per_m
        (xx, xv), (vx, vv) = propagators[k]
        away = position - equilibrium
        position = equilibrium + xx * away + xv * velocity
        velocity = vx * away + vv * velocity
    return motion


def comes_to_rest(position_m: NDArray[np.float64]) -> bool:
    """Whether a handle with these positions (n,), n a multiple of 64, in steps of even time, does not go on vibrating.

    How much it shakes is looked at in 64 windows: its largest way off a straight line, for a handle in tissue creeps; of 8
    windows the median, for a knock is no vibration. In one of the last five eighths of the time that has to be less than
    SHAKING_M, or less than half as much as in the third eighth: what vibrates does so all the time.
    """
    if not np.all(np.isfinite(position_m)):
        return False
    windows = position_m.reshape(64, -1)
    time = np.linspace(-1.0, 1.0, windows.shape[1])
    off = windows - windows.mean(axis=1, keepdims=True)
    off -= np.outer(off @ time / (time @ time), time)
    shaking = np.median(np.ptp(off, axis=1).reshape(8, 8), axis=1)
    return bool(shaking[3:].min() < max(SHAKING_M, 0.5 * shaking[2]))
